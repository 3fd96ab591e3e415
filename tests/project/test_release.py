"""`scripts/release`: the states that it refuses, and a dry run that builds and tries everything."""

from __future__ import annotations

import importlib.util
import os
import shutil
import subprocess
import sys
from importlib.machinery import SourceFileLoader
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture
def release() -> ModuleType:
    loader = SourceFileLoader("release_script", str(ROOT / "scripts" / "release"))
    spec = importlib.util.spec_from_loader("release_script", loader)
    assert spec is not None
    module = importlib.util.module_from_spec(spec)
    loader.exec_module(module)
    return module


def git(root: Path, *words: str) -> None:
    who = ["-c", "user.name=test", "-c", "user.email=test@example.com"]
    subprocess.run(["git", *who, *words], cwd=root, check=True, capture_output=True)


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    """A repository that is ready to be released as 0.1.0."""
    root = tmp_path / "checkout"
    (root / "fieldtwin").mkdir(parents=True)
    (root / "scripts").mkdir()
    shutil.copy(ROOT / "scripts" / "installation", root / "scripts")
    shutil.copy(ROOT / "fieldtwin" / "__about__.py", root / "fieldtwin")
    settings = (
        (ROOT / "fieldtwin" / "installation.py").read_text("utf-8").replace("PUBLISHED = False", "PUBLISHED = True")
    )
    (root / "fieldtwin" / "installation.py").write_text(settings, "utf-8")
    (root / "CHANGELOG.md").write_text("# Changelog\n\n## 0.1.0 (2026-12-01)\n")
    (root / "README.md").write_text("`pip install fieldtwin`\n")
    (root / ".gitignore").write_text("__pycache__/\n")
    git(root, "init")
    git(root, "add", ".")
    git(root, "commit", "-m", "all")
    git(root, "tag", "-m", "0.1.0", "v0.1.0")
    return root


def test_a_tagged_commit_with_a_dated_changelog_is_ready(release: ModuleType, checkout: Path) -> None:
    assert release.contradictions(checkout) == release.unfinished(checkout) == []


def test_a_tag_of_another_version_is_refused(release: ModuleType, checkout: Path) -> None:
    git(checkout, "tag", "-d", "v0.1.0")
    git(checkout, "tag", "-m", "0.2.0", "v0.2.0")
    assert release.contradictions(checkout) == [
        "fieldtwin/__about__.py has version 0.1.0, but the tag of this commit is v0.2.0"
    ]


def test_a_changelog_without_the_version_is_refused(release: ModuleType, checkout: Path) -> None:
    (checkout / "CHANGELOG.md").write_text("# Changelog\n\n## 0.0.9 (2026-01-01)\n")
    assert release.contradictions(checkout) == ["CHANGELOG.md has no section '## 0.1.0'"]


def test_a_page_that_installs_in_another_way_is_refused(release: ModuleType, checkout: Path) -> None:
    (checkout / "README.md").write_text("`pip install './fieldtwin[mqtt]'`\n")
    [wrong] = release.contradictions(checkout)
    assert wrong.startswith("README.md:1:")


def test_remaining_release_steps_are_named(release: ModuleType, checkout: Path) -> None:
    git(checkout, "tag", "-d", "v0.1.0")
    (checkout / "CHANGELOG.md").write_text("# Changelog\n\n## 0.1.0 (unreleased)\n")
    tag, changes, date = release.unfinished(checkout)
    assert "no tag v0.1.0" in tag
    assert "not committed" in changes
    assert "has no date" in date


def test_a_release_that_is_not_ready_builds_nothing(release: ModuleType, capsys: pytest.CaptureFixture[str]) -> None:
    if not release.unfinished(ROOT):
        pytest.skip("this commit is ready to be released")
    assert release.main([]) == 1
    assert "test-wheel" not in capsys.readouterr().err


@pytest.mark.long
@pytest.mark.timeout(600)
def test_a_dry_run_builds_and_tries_everything_and_uploads_nothing(tmp_path: Path) -> None:
    programs = tmp_path / "bin"
    programs.mkdir()
    twine = programs / "twine"  # a program that would be noticed
    twine.write_text(f"#!/bin/sh\ntouch {tmp_path}/uploaded\n")
    twine.chmod(0o755)
    path = f"{programs}{os.pathsep}{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    done = subprocess.run(
        ["scripts/release", "--dry-run"], cwd=ROOT, env={**os.environ, "PATH": path}, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert "test-wheel: a shipped scenario" in done.stderr
    assert "release: a release would then run\n    twine upload dist/" in done.stderr
    assert not (tmp_path / "uploaded").exists()
    assert {file.suffix for file in (ROOT / "dist").iterdir()} == {".whl", ".gz"}
