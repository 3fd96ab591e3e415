"""A simulation tool for tests of exported FMUs: FMPy in its own process, because an FMU is native code in the tool's process."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

from click.testing import CliRunner, Result
from fmu_rig import EXAMPLE

from fieldtwin.cli.main import cli

PREAMBLE = """
import json, os, signal, sys
from pathlib import Path
from fmpy import extract, read_model_description
from fmpy.fmi2 import FMU2Slave

said = read_model_description("plc.fmu", validate_variable_names=True, validate_model_structure=True)
references = {v.name: (v.valueReference, v.type) for v in said.modelVariables}
folder = extract("plc.fmu", unzipdir=os.getcwd() + "/unpacked")

class Instance:
    def __init__(self, name="one", start_s=0.0, begin=True, **start):
        self.fmu = FMU2Slave(
            guid=said.guid, unzipDirectory=folder, modelIdentifier=said.coSimulation.modelIdentifier, instanceName=name
        )
        self.fmu.instantiate(loggingOn=True)
        for one, value in start.items():
            self.set(one, value)
        if begin:
            self.begin(start_s)
    def begin(self, start_s=0.0):
        self.fmu.setupExperiment(startTime=start_s)
        self.fmu.enterInitializationMode()
        self.fmu.exitInitializationMode()
    def get(self, name):
        reference, kind = references[name]
        [value] = getattr(self.fmu, "get" + kind)([reference])
        return value.decode() if isinstance(value, bytes) else bool(value) if kind == "Boolean" else value
    def set(self, name, value):
        reference, kind = references[name]
        getattr(self.fmu, "set" + kind)([reference], [value])
    def step(self, t, dt):
        self.fmu.doStep(t, dt)
    def refusal(self, work):
        try:
            work()
        except Exception as e:
            return str(e)

def children():
    return [int(p.name) for p in Path("/proc").glob("[0-9]*") if is_child(p)]

def is_child(process):
    try:
        state, parent = (process / "stat").read_text().rpartition(")")[2].split()[:2]
    except OSError:
        return False
    return int(parent) == os.getpid() and state != "Z"
"""


def drive_site(folder: Path) -> Path:
    """Copy the example with a prototype whose level a tool sets, and return the system file."""
    folder.mkdir(parents=True, exist_ok=True)
    for file in EXAMPLE.iterdir():
        if file.suffix in (".yaml", ".st"):
            shutil.copy(file, folder / file.name)
    shutil.move(folder / "drive.prototype.yaml", folder / "tank.prototype.yaml")
    return folder / "tank.yaml"


def export(system: Path | str, out: Path, *options: str) -> Result:
    """Call ``fieldtwin export fmu``."""
    return CliRunner().invoke(cli, ["export", "fmu", str(system), "-o", str(out), *options])


def in_tool(folder: Path, code: str, **environment: str) -> tuple[Any, str]:
    """Run `code` in the tool, whose current folder has ``plc.fmu``.

    Return the value that it assigns to ``result``, and the messages of the FMU.
    """
    script = f"{PREAMBLE}\n{code}\nPath('result.json').write_text(json.dumps(result))\n"
    done = subprocess.run(
        [sys.executable, "-c", script],
        cwd=folder,
        env={**os.environ, **environment},
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert done.returncode == 0, f"{done.returncode}: {done.stdout}{done.stderr}"
    return json.loads((folder / "result.json").read_text()), done.stdout + done.stderr
