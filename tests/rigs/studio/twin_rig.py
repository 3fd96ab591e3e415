"""The observatory's prototype with a digital thread, a twin that is connected to it, and a Studio that shows both."""

from __future__ import annotations

import os
import shlex
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from studio_rig import VIEW, Studio, studio, until

TWINS = "/instances/observatory/twins"
PLANNER = '''
from fieldtwin.gateway.core.values import COMMAND


class Planner:
    """Answer a report of ACTIVE with a command that is none."""

    def plan(self, data, model):
        if data.finding == "agree" and data.text.startswith("ACTIVE"):
            return COMMAND(b"\\x01")
'''


@dataclass
class TwinSite:
    """The running parts. `twin` is started with the command line that Studio proposes."""

    studio: Studio
    root: Path
    stack: ExitStack
    proposed: list[dict[str, str]] = field(default_factory=list)

    def twins(self) -> dict[str, Any]:
        """Return what Studio has about the shadows and twins."""
        with self.studio.client(VIEW) as client:
            answer = client.get(TWINS)
        answer.raise_for_status()
        found: dict[str, Any] = answer.json()
        return found

    def twin(self) -> dict[str, Any]:
        """Return the only follower."""
        [follower] = self.twins()["followers"]
        return dict(follower)

    def variables(self) -> dict[str, dict[str, Any]]:
        """Return the compared variables by name."""
        return {v["name"]: v for v in self.twin()["variables"]}

    def start_twin(self) -> None:
        """Start the twin with the command line that Studio proposes, and a planner whose command is refused."""
        program, *arguments = shlex.split(self.proposed[1]["command"])
        assert program == "fieldtwin"
        (self.root / "planner.py").write_text(PLANNER)
        self.start(*arguments, "--plan", "python: planner:Planner")
        until(lambda: _follows(self), "the twin follows the plant")

    def start(self, *arguments: str) -> subprocess.Popen[bytes]:
        """Start ``fieldtwin ARGUMENTS`` until the end of the test."""
        environment = os.environ | {"FIELDTWIN_RUN": str(self.studio.run_root)}
        process = subprocess.Popen(
            [sys.executable, "-m", "fieldtwin", *arguments],
            env=environment, cwd=self.root, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )  # fmt: skip
        self.stack.callback(_stop, process)
        return process


def _stop(process: subprocess.Popen[bytes]) -> None:
    process.send_signal(signal.SIGINT)
    try:
        process.wait(20)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


@contextmanager
def twin_site(root: Path, *, follow: bool = True) -> Iterator[TwinSite]:
    """Start the plant and Studio, and unless `follow` is false a twin whose planner plans a command that is refused."""
    with ExitStack() as stack:
        site = TwinSite(stack.enter_context(studio(root=root, folder=root)), root, stack)
        site.start("run", "observatory", "--prototype", "--commands", "none", "--thread", "tcp://127.0.0.1:0")
        until(lambda: _runs(site), "the plant has a digital thread")
        site.proposed = site.twins()["start"]
        if follow:
            site.start_twin()
        yield site


def _runs(site: TwinSite) -> bool:
    with site.studio.client(VIEW) as client:
        answer = client.get(TWINS)
    return answer.status_code == 200 and answer.json()["plant_thread"] is not None


def _follows(site: TwinSite) -> bool:
    found = site.twins()["followers"]
    return bool(found) and bool(found[0]["status"]) and found[0]["status"]["state"] == "ACTIVE"
