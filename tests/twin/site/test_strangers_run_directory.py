"""A run directory that a different user created first is refused, both when an instance runs and when one is queried.

Defect: only the owner of the instance's own directory was checked. Another user who had created /tmp/fieldtwin-UID could
replace the directories in it, and the control channels with them.
"""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from fieldtwin.gateway.core.errors import Unreachable
from fieldtwin.twin.plant import instance
from fieldtwin.twin.plant.instance import Instance, runtime_root

STRANGER = 65534
needs_root = pytest.mark.skipif(os.getuid() != 0, reason="only root can give a folder to another user")


@pytest.fixture
def default(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The default folder of run directories, which does not exist yet."""
    monkeypatch.delenv("FIELDTWIN_RUN", raising=False)
    monkeypatch.delenv("XDG_RUNTIME_DIR", raising=False)
    monkeypatch.setattr(instance, "TEMPORARY", tmp_path)
    return tmp_path / f"fieldtwin-{os.getuid()}"


def test_the_users_own_folder_is_taken(default: Path) -> None:
    with Instance("a") as made:
        assert made.dir.parent == default
    assert runtime_root() == default
    assert default.stat().st_mode & 0o777 == 0o700


@needs_root
def test_a_folder_of_another_user_is_refused(default: Path) -> None:
    default.mkdir(mode=0o777)
    os.chown(default, STRANGER, STRANGER)
    with pytest.raises(Unreachable, match="other users have access"):
        Instance("a")
    with pytest.raises(Unreachable, match="other users have access"):
        runtime_root()


@pytest.mark.parametrize("mode", [0o770, 0o707, 0o1777])
def test_a_folder_that_other_users_may_write_to_is_refused(default: Path, mode: int) -> None:
    default.mkdir()
    default.chmod(mode)
    with pytest.raises(Unreachable, match="other users have access"):
        runtime_root()


def test_a_link_or_a_file_in_its_place_is_refused(default: Path, tmp_path: Path) -> None:
    (tmp_path / "elsewhere").mkdir(mode=0o700)
    default.symlink_to(tmp_path / "elsewhere")
    with pytest.raises(Unreachable, match="other users have access"):
        runtime_root()
    default.unlink()
    default.write_text("")
    with pytest.raises(Unreachable, match="other users have access"):
        runtime_root()


@needs_root
def test_the_directory_of_an_instance_of_another_user_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a").mkdir(mode=0o777)
    os.chown(tmp_path / "a", STRANGER, STRANGER)
    with pytest.raises(Unreachable, match="a different user"), Instance("a", tmp_path):
        pass


def test_a_link_in_place_of_an_instances_directory_is_refused(tmp_path: Path) -> None:
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "a").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(Unreachable, match="a different user"), Instance("a", tmp_path):
        pass
