"""Processes that serve many devices raise their limit of open files as far as permitted."""

from __future__ import annotations

import resource
import subprocess
import sys

import pytest

SHOW = "import resource\nfrom fieldtwin.twin.plant import child\nchild.MOST_FILES = {most}\nchild.allow_open_files()\n"
SHOW += "print(*resource.getrlimit(resource.RLIMIT_NOFILE))"


@pytest.mark.parametrize(
    ("limits", "most", "expected"),
    [((256, 512), 65_536, (512, 512)), ((256, 512), 400, (400, 512)), ((500, 512), 400, (500, 512))],
    ids=["up to the hard limit", "no more than needed", "never lowered"],
)
def test_the_soft_limit_is_raised(limits: tuple[int, int], most: int, expected: tuple[int, int]) -> None:
    done = subprocess.run(
        [sys.executable, "-c", SHOW.format(most=most)],
        capture_output=True,
        text=True,
        check=True,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_NOFILE, limits),
    )
    assert tuple(map(int, done.stdout.split())) == expected
