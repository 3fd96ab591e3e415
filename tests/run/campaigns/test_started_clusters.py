"""`--on slurm` and `--on kubernetes`: the configuration files of the page, and SLURM's programs replaced by shell scripts.

SLURM itself needs a cluster. The scripts run the job script of dask-jobqueue as a process of this computer.
"""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
import yaml
from shed_site import write_shed

from fieldtwin.gateway.core.errors import UsageError
from fieldtwin.run.places.clusters import place_named

pytestmark = [pytest.mark.long, pytest.mark.timeout(600)]

PAGE = Path(__file__).resolve().parents[3] / "docs" / "how-to" / "many-computers.md"
RECIPES = dict(
    re.findall(r"^<!-- recipe: ([\w-]+) -->\n```\w+\n(.*?)^```$", PAGE.read_text("utf-8"), re.MULTILINE | re.DOTALL)
)
SBATCH = """#!/bin/sh
cp "$1" "jobs/$$.sh"
setsid sh "jobs/$$.sh" > "jobs/$$.log" 2>&1 &
echo $! > "jobs/$$.pid"
echo "Submitted batch job $$"
"""
SCANCEL = """#!/bin/sh
for job; do kill -9 -- -$(cat "jobs/$job.pid"); touch "jobs/$job.cancelled"; done
"""


@pytest.fixture
def site(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    write_shed(tmp_path)
    (tmp_path / "jobs").mkdir()
    (tmp_path / "bin").mkdir()
    for name, text in (("sbatch", SBATCH), ("scancel", SCANCEL)):
        (tmp_path / "bin" / name).write_text(text)
        (tmp_path / "bin" / name).chmod(0o755)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def simulate(site: Path, *options: str) -> subprocess.CompletedProcess[str]:
    words = ["simulate", "shed.yaml", "--for", "10s", "--seeds", "1..6", *options]
    path = f"{site / 'bin'}{os.pathsep}{os.environ['PATH']}"
    return subprocess.run(
        [sys.executable, "-m", "fieldtwin", *words],
        env=os.environ | {"PATH": path, "DASK_CONFIG": str(site / "config")},
        capture_output=True,
        text=True,
        timeout=300,
    )


def configure(site: Path, name: str, settings: dict[str, object]) -> None:
    (site / "config").mkdir()
    (site / "config" / name).write_text(yaml.safe_dump(settings))


def test_slurm_starts_workers_as_jobs_and_ends_them(site: Path) -> None:
    settings = yaml.safe_load(RECIPES["dask-slurm"])
    of = settings["jobqueue"]["slurm"]
    of |= {"python": sys.executable, "cores": 1, "processes": 1, "memory": "1GiB", "interface": "lo"}
    configure(site, "jobqueue.yaml", settings)
    done = simulate(site, "--on", "slurm", "--jobs", "2", "--json")
    assert done.returncode == 0, done.stderr
    result = json.loads(done.stdout)
    assert [one["seed"] for one in result["results"]] == [1, 2, 3, 4, 5, 6]
    assert result["failed"] == []
    scripts = sorted((site / "jobs").glob("*.sh"))
    assert len(scripts) == len(list((site / "jobs").glob("*.cancelled"))) == 2
    assert "#SBATCH --requeue" in scripts[0].read_text()
    assert "#SBATCH -t 04:00:00" in scripts[0].read_text()
    assert "Traceback" not in done.stderr
    assert "distributed" not in done.stderr


def test_slurm_without_a_configuration_is_an_error_that_names_the_file(site: Path) -> None:
    done = simulate(site, "--on", "slurm", "--jobs", "2")
    assert (done.returncode, done.stderr.count("\n")) == (2, 1), done.stderr
    assert "~/.config/dask/jobqueue.yaml" in done.stderr


@pytest.mark.parametrize(
    ("place", "package", "file"),
    [
        ("slurm", "dask_jobqueue", "~/.config/dask/jobqueue.yaml"),
        ("kubernetes", "dask_kubernetes.operator", "~/.config/dask/kubernetes.yaml"),
    ],
)
def test_a_missing_package_is_named_with_its_command_and_its_file(
    place: str, package: str, file: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, package.partition(".")[0], None)
    with pytest.raises(UsageError) as e:
        place_named(place, 4)
    distribution = package.partition(".")[0].replace("_", "-")
    assert f"pip install {distribution}" in str(e.value)
    assert file in str(e.value)
