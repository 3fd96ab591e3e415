"""Results of the league: confirm failures without fieldtwin, and write docs/reference/league.json."""

from __future__ import annotations

import fcntl
import json
import subprocess
import tempfile
from collections.abc import Sequence
from datetime import date
from pathlib import Path
from typing import Any

from stacks import CACHE, PYTHON, ROOT, Entry, install, load, version

CONFIRM, RESULTS = ROOT / "scripts/league_confirm", ROOT / "docs/reference/league.json"
FRAMES = 8
"""Lines of evidence that the results keep for a failed case."""


def confirm(entry: Entry, words: list[str], failed: Sequence[str]) -> dict[str, dict[str, Any]]:
    """Repeat failed cases with the program that does not use fieldtwin; return what it observed, by case."""
    script = CONFIRM / f"{entry.kind.replace('-', '_')[:-1]}.py"
    found: dict[str, dict[str, Any]] = {}
    for id in failed:
        try:
            done = subprocess.run(
                [PYTHON, str(script), id, entry.wire, *words],
                capture_output=True,
                text=True,
                timeout=60,
                start_new_session=True,
            )
        except subprocess.TimeoutExpired:
            continue
        if done.returncode == 0:
            found[id] = json.loads(done.stdout)
        elif done.returncode != 3:  # 3: the program has no such case
            print(f"  {id}: {done.stderr.strip()[-300:]}", flush=True)
    return found


def evidence(case: dict[str, Any]) -> list[str]:
    """Return the frames of a case as lines, from the first one that matters."""
    frames = [f for f in case.get("wire", case.get("frames", [])) if f.get("t_ms", 0) >= 0]
    return [
        " ".join(str(f[key]) for key in ("t_ms", "by", "direction", "data", "text") if f.get(key) not in (None, ""))
        for f in frames[:FRAMES]
    ]


def row(
    entry: Entry, lock: dict[str, Any], cases: list[dict[str, Any]], seen: dict[str, dict[str, Any]]
) -> dict[str, Any]:
    """Return the entry of the results."""
    stack = lock["stacks"][entry.stack]
    by = {verdict: [c["id"] for c in cases if c["verdict"] == verdict] for verdict in ("passed", "skipped")}
    return {
        "kind": entry.kind, "name": entry.name, "stack": stack.get("title", entry.stack), "version": version(stack),
        "from": stack["from"], "wire": entry.wire, "api": entry.api, "date": date.today().isoformat(),
        "passed": by["passed"], "skipped": by["skipped"],
        "inconclusive": {c["id"]: c["reason"] for c in cases if c["verdict"] in ("inconclusive", "error")},
        "failed": {
            c["id"]: {
                "basis": c["basis"], "reason": c["reason"], "frames": evidence(c),
                "confirmed": bool(seen.get(c["id"], {}).get("confirmed")),
                **{key: seen[c["id"]][key] for key in ("sent", "observed") if c["id"] in seen},
            }
            for c in cases if c["verdict"] == "failed"
        },
    }  # fmt: skip


def save(rows: Sequence[dict[str, Any]]) -> None:
    """Put the rows into the results, in the order of the lock file; rows that were not run keep their results."""
    RESULTS.parent.mkdir(parents=True, exist_ok=True)
    with (CACHE / "lock").open("w") as lock:  # several runs may write at the same time
        fcntl.flock(lock, fcntl.LOCK_EX)
        merge(rows)


def merge(rows: Sequence[dict[str, Any]]) -> None:
    held = json.loads(RESULTS.read_text()) if RESULTS.is_file() else {"entries": []}
    by = {(e["kind"], e["name"]): e for e in [*held["entries"], *rows]}
    _, entries = load()
    held["entries"] = [by[key] for e in entries if (key := (e.kind, e.name)) in by]
    RESULTS.write_text(json.dumps(held, indent=1, ensure_ascii=False) + "\n")


def dead_units(lock: dict[str, Any]) -> int:
    """Measure which share of its polls one live unit among 30 dead ones keeps, with each poller; put it into the results."""
    pythons = {
        name: install(name, lock["stacks"][name]) / "venv/bin/python"
        for name in ("pymodbus", "minimalmodbus", "modbus_tk")
    }
    peers = ",".join(f"{name}={python}" for name, python in pythons.items())
    with tempfile.TemporaryDirectory(prefix="ftl", dir="/tmp") as folder:
        shares = Path(folder) / "shares.json"
        words = [PYTHON, "benchmarks/dead_units.py", "--peers", peers, "--json", str(shares)]
        done = subprocess.run(words, cwd=ROOT, timeout=900)
        measured = json.loads(shares.read_text())
    for each in measured:
        known = lock["stacks"].get(each["name"])
        each["version"] = version(known) if known else "this version"
    held = json.loads(RESULTS.read_text())
    RESULTS.write_text(json.dumps({**held, "dead_units": measured}, indent=1, ensure_ascii=False) + "\n")
    return done.returncode
