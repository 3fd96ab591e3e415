"""The stacks and entries of scripts/league.toml: where they are installed, and the command of each entry's program."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
PYTHON = str(ROOT / ".venv/bin/python")
PROGRAMS, CACHE = ROOT / "scripts/league_programs", ROOT / "build/league"
INSTALL_LIMIT_S = 300
KINDS = {
    "modbus-clients": ["check", "modbus-client"],
    "modbus-devices": ["check", "modbus"],
    "canopen-clients": ["check", "canopen-master"],
    "canopen-devices": ["check", "canopen"],
}


@dataclass(frozen=True)
class Entry:
    """An entry of the league: a class or program of a stack on one kind of bus."""

    kind: str
    name: str
    stack: str
    wire: str
    api: str
    run: tuple[str, ...]
    timeout_s: float = 0.15

    @property
    def is_client(self) -> bool:
        return self.kind.endswith("clients")


def load() -> tuple[dict[str, Any], list[Entry]]:
    """Return the lock file and its entries."""
    lock = tomllib.loads((ROOT / "scripts/league.toml").read_text())
    return lock, [
        Entry(kind, name, **{**e, "run": tuple(e["run"])}) for kind in KINDS for name, e in lock[kind].items()
    ]


def install(name: str, stack: dict[str, Any]) -> Path:
    """Install the stack in its exact versions below the cache, unless it exists; return its folder."""
    folder = CACHE / name
    stamp, wanted = folder / "installed.json", json.dumps(stack, sort_keys=True)
    if stamp.is_file() and stamp.read_text() == wanted:
        return folder
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    packages, needs = stack["packages"], stack.get("needs", [])
    if stack["from"] == "npm":
        words = ["npm", "install", "--no-audit", "--no-fund", "--silent", *packages]
        call([*words, *([] if stack.get("scripts", True) else ["--ignore-scripts", "--omit=optional"])], folder)
    else:
        call([sys.executable, "-m", "venv", "venv"], folder)
        needs = packages if stack["from"] == "PyPI" else needs
        if needs:
            call(["venv/bin/python", "-m", "pip", "install", "--quiet", "--disable-pip-version-check", *needs], folder)
    if stack["from"].startswith("Debian"):
        call(["apt-get", "download", *packages], folder)
        for package in folder.glob("*.deb"):
            call(["dpkg", "-x", package.name, "root"], folder)
        if (folder / "root/usr/include/modbus").is_dir():
            library = next((folder / "root/usr/lib").glob("*/libmodbus.so")).parent
            call(
                ["gcc", "-O2", f"-I{folder}/root/usr/include/modbus", str(PROGRAMS / "libmodbus.c"), "-o", "libmodbus",
                 f"-L{library}", "-lmodbus", f"-Wl,-rpath,{library}"], folder,
            )  # fmt: skip
    stamp.write_text(wanted)
    return folder


def call(words: Sequence[str], folder: Path) -> None:
    """Run an installation step, and end the league with its output if it fails."""
    done = subprocess.run(words, cwd=folder, capture_output=True, text=True, timeout=INSTALL_LIMIT_S)
    if done.returncode:
        sys.exit(f"{' '.join(words)} failed in {folder}:\n{done.stdout}{done.stderr}")


def program(entry: Entry, folder: Path) -> list[str]:
    """Return the command of the entry's program. It may hold the words LINE, PORT and EDS."""
    name, *rest = entry.run
    root = folder / "root/usr"
    if name.endswith(".js"):
        return ["env", f"NODE_PATH={folder}/node_modules", "node", str(PROGRAMS / name), *rest]
    if name.endswith(".py"):
        packages = root / "lib/python3/dist-packages"
        search = ["env", f"PYTHONPATH={packages}"] if packages.is_dir() else []
        return [*search, str(folder / "venv/bin/python"), str(PROGRAMS / name), *rest]
    if name == "libmodbus":
        return [str(folder / "libmodbus"), *rest]
    library = next((root / "lib").glob("*/libmodbus.so")).parent
    return ["env", f"LD_LIBRARY_PATH={library}", "stdbuf", "-oL", str(root / "bin" / name), *rest]


def version(stack: dict[str, Any]) -> str:
    """Return the exact version of the stack's first package, without Debian's revision."""
    named = stack["packages"][0]
    return str(named.replace("==", "=").rpartition("@" if stack["from"] == "npm" else "=")[2].partition("-")[0])
