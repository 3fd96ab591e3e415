"""Execute the pages of docs/: write the files, run the commands of a page in one folder, and compare their output.

A comment before a fence gives its purpose. Forges and the book do not show it.

    <!-- file: tank.yaml -->    the fence is the content of that file
    <!-- clone: fieldtwin -->   without a fence: the folder `fieldtwin` is this checkout, as after `git clone`
    <!-- run -->                `$ ` lines are commands, the lines below each its output; `...` matches anything
    <!-- run: numbers -->       numbers, and the spaces around them, may differ from the page
    <!-- begin -->              a command that runs until the end of the page; its output must appear before the page continues
    <!-- end -->                without a fence: running commands are interrupted

Other fences are illustrations. Long blocks have `<!-- run: long -->` or `<!-- run: long numbers -->`: then the whole page
runs with the tests marked long. After a command `cd FOLDER` the page continues in that folder.
"""

from __future__ import annotations

import os
import re
import select
import signal
import subprocess
import sys
import tempfile
from dataclasses import dataclass, field
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PATIENCE_S = 30.0

_MARK = re.compile(
    r"^<!-- (file|clone|run|begin|end)(?:: ([\w./ -]+?))? -->\n(?:```[^\n]*\n(.*?)^```$)?", re.MULTILINE | re.DOTALL
)


@dataclass(frozen=True, slots=True)
class Block:
    """A marked fence: the action, the argument after the colon, its text, its line on the page."""

    does: str
    word: str
    text: str
    line: int


def blocks(page: Path) -> list[Block]:
    """Return the marked fences of a page, in order."""
    text = page.read_text("utf-8")
    return [
        Block(found[1], found[2] or "", found[3] or "", text.count("\n", 0, found.start()) + 1)
        for found in _MARK.finditer(text)
    ]


def is_long(page: Path) -> bool:
    return any("long" in block.word.split() and block.does in ("run", "begin") for block in blocks(page))


def commands(text: str) -> list[tuple[str, str]]:
    """Return each command of a console block with its output."""
    found: list[tuple[str, list[str]]] = []
    for line in text.splitlines():
        if line.startswith("$ "):
            found.append((line[2:], []))
        elif found:
            found[-1][1].append(line)
    return [(command, "\n".join(output)) for command, output in found]


def agrees(shown: str, seen: str, numbers: bool = False) -> bool:
    """Return whether `seen` matches the text shown; `...` matches anything, and spaces at line ends are ignored.

    With `numbers`, every number agrees with every other, because columns of a table have the width of their numbers also
    with different spaces around them.
    """
    if numbers:
        shown, seen = _without_numbers(shown), _without_numbers(seen)
    parts = [re.escape(part.strip("\n")) for part in _bare(shown).split("...")]
    return re.fullmatch(r"\s*" + r"(?s:.*?)".join(parts) + r"\s*", _bare(seen)) is not None


def _without_numbers(text: str) -> str:
    return re.sub(r" +", " ", re.sub(r"-?\d+(?:\.\d+)?(?:e[+-]?\d+)?", "0", text))


def _bare(text: str) -> str:
    return "\n".join(line.rstrip() for line in text.strip().splitlines())


@dataclass(slots=True)
class Reader:
    """A reader who executes a page in a separate folder, with `fieldtwin` on the path."""

    folder: Path
    going_on: list[subprocess.Popen[str]] = field(default_factory=list)
    below: str = ""  # the folder below `folder` that the page has changed into

    def does(self, block: Block) -> None:
        """Execute one block. Raise AssertionError with the command, the expected output and the actual output."""
        if block.does == "file":
            place = self.folder / self.below / block.word
            place.parent.mkdir(parents=True, exist_ok=True)
            place.write_text(block.text, "utf-8")
        elif block.does == "clone":
            (self.folder / block.word).symlink_to(ROOT)
        elif block.does == "end":
            self.ends()
        else:
            for command, shown in commands(block.text):
                if command.startswith("cd "):
                    self.below = os.path.normpath(Path(self.below) / command.removeprefix("cd "))
                    assert (self.folder / self.below).is_dir(), f"line {block.line}: {command}: no such folder"
                    continue
                seen = self._begins(command, shown) if block.does == "begin" else self._runs(command)
                alike = agrees(shown, seen, numbers="numbers" in block.word.split())
                assert alike, f"line {block.line}: {command}\n--- shown\n{shown}\n--- seen\n{seen}"

    def ends(self) -> None:
        """Interrupt running commands, as Ctrl-C does, the newest first."""
        while self.going_on:
            process = self.going_on.pop()
            os.killpg(process.pid, signal.SIGINT)
            try:
                process.communicate(timeout=PATIENCE_S)
            except subprocess.TimeoutExpired:
                os.killpg(process.pid, signal.SIGKILL)
                process.communicate()

    def _runs(self, command: str) -> str:
        process = self._started(command)
        try:
            out, _ = process.communicate(timeout=20 * PATIENCE_S)
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            out, _ = process.communicate()
        return out

    def _begins(self, command: str, shown: str) -> str:
        """Wait until the command has printed as many lines as shown."""
        process = self._started(command)
        self.going_on.append(process)
        assert process.stdout is not None
        seen = b""
        while seen.count(b"\n") < len(shown.splitlines()):
            ready, _, _ = select.select([process.stdout], [], [], PATIENCE_S)
            came = os.read(process.stdout.fileno(), 65536) if ready else b""  # more than the buffer of the stream
            if not came:
                break
            seen += came
        return "".join(seen.decode().splitlines(keepends=True)[: len(shown.splitlines())])

    def _started(self, command: str) -> subprocess.Popen[str]:
        bin_folder = self.folder / ".bin"
        if not bin_folder.exists():
            bin_folder.mkdir()
            for name, module in (("fieldtwin", "fieldtwin"), ("pytest", "pytest")):
                script = bin_folder / name
                script.write_text(f'#!/bin/sh\nexec {sys.executable} -m {module} "$@"\n')
                script.chmod(0o755)
        environment = {
            # pytest prints longer summaries where these are set, and the pages show what a user sees
            **{name: value for name, value in os.environ.items() if name not in ("CI", "BUILD_NUMBER")},
            "PATH": f"{bin_folder}:{Path(sys.executable).parent}:{os.environ['PATH']}",
            "PYTHONPATH": str(ROOT),
            "FIELDTWIN_RUN": str(self.folder / "r"),
            "COLUMNS": "120",
            "NO_COLOR": "1",
        }
        return subprocess.Popen(
            ["sh", "-c", command],
            cwd=self.folder / self.below,
            env=environment,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            start_new_session=True,
        )


def main() -> int:
    """Execute every page with only an installation (scripts/walk). Return 1 if a page shows wrong output."""
    wrong = 0
    for page in sorted((ROOT / "docs").rglob("*.md")):
        if not (todo := blocks(page)):
            continue
        with tempfile.TemporaryDirectory(prefix="pg", dir="/tmp") as folder:
            reader = Reader(Path(folder))
            try:
                for block in todo:
                    reader.does(block)
            except AssertionError as differs:
                wrong += 1
                print(f"wrong  {page.relative_to(ROOT)}, {differs}", flush=True)
            else:
                print(f"ok     {page.relative_to(ROOT)}", flush=True)
            finally:
                reader.ends()
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
