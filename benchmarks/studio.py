#!/usr/bin/env python3
"""Studio's bus view in headless Chromium: the time from a frame to the screen, and a million frames at hand.

    benchmarks/studio.py [--quick] [--rate 5000] [--seconds 20] [--frames 1000000] [--pairs 5] [--only PART]

First part: Studio starts with a capture of a million frames of the observatory. Measured are the time until it serves its page,
the time until all frames are indexed, the memory of the server, and the time until the rows at random positions are drawn.
Second part: another process appends frames to a capture at the given rate; the page follows them. For each frame, the time from
its time stamp until its row, or a later one, is drawn. Nothing else is compared: no peer shows the frames of such a run.
Third part, in pairs without and with Studio: the lateness of the scans of a running system with 5,000 tags, and the CPU time of
its PLC and its gateway. Studio observes the system, and the devices view is open in Chromium. `--only` runs one part.

Needs `chromium` and `chromedriver` (Debian: chromium-driver) and selenium. Absolute times: a quiet machine of 2 cores.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
import urllib.error
import urllib.request
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from statistics import median
from typing import Any, TextIO

from peers import Goals, Missing, cpu_s, free_port, peak_mb, python, stop

SCREEN_MS, MEMORY_MB, SHOWN_MS, FIRST_PAGE_S = 250, 400, 200, 2.0
FOLLOWED = 0.85
"""Share of the appended frames that must reach the screen, because a page that stops following has no late frames. The
measurement ends half a second before the last frame."""
NAME = "bench"
BATCH_S = 0.01
INDEXED_WITHIN_S = 900
PLACES = 40
TAGS = 5000
PART_S = 10.0
LATE_MORE_US = 100
CPU_MORE = 0.05
"""The share of a CPU that Studio may cost the gateway, and the PLC."""
REQUEST, REPLY = "010300010001d5ca", "01030200057847"


class Capture:
    """A capture of the observatory: requests and replies of the sensor, and PDOs of the inclinometer, in turn."""

    def __init__(self, path: Path) -> None:
        from fieldtwin.twin.site.system import load_system

        system = load_system("observatory")
        self.line, self.can = str(system.buses["line1"].endpoint), str(system.buses["can0"].endpoint)
        self.path = path

    def write(self, file: TextIO, count: int, t_ns: int, step_ns: int) -> None:
        """Append `count` frames from `t_ns` on."""
        for n in range(count):
            common = f'{{"t_ns":{t_ns + n * step_ns},"endpoint":'
            match n % 4:
                case 0:
                    file.write(f'{common}"{self.line}","direction":"sent","hex":"{REQUEST}"}}\n')
                case 1:
                    file.write(f'{common}"{self.line}","direction":"received","hex":"{REPLY}"}}\n')
                case _:
                    value = (n & 0xFFFF).to_bytes(2, "little").hex()
                    frame = f'"hex":"{value}1cff","frame":"185#{value.upper()}1CFF"'
                    file.write(f'{common}"{self.can}","direction":"received",{frame}}}\n')
        file.flush()


def make_run(root: Path, started_ns: int) -> Path:
    """Make the directory of a finished run with an empty capture, and return the capture's path."""
    from fieldtwin.run.processes.run_record import SYSTEM_FILE, RunRecord, write_record
    from fieldtwin.twin.site.resolved import write_resolved
    from fieldtwin.twin.site.system import load_system

    folder = root / NAME
    folder.mkdir(parents=True, mode=0o700)
    root.chmod(0o700)
    system = load_system("observatory")
    write_resolved(folder / SYSTEM_FILE, system)
    capture = folder / "capture.jsonl"
    capture.touch()
    utc_ns = time.time_ns() - time.monotonic_ns() + started_ns
    write_record(
        folder,
        RunRecord(
            system="observatory",
            path=str(system.path),
            prototype=True,
            allow_writes=True,
            started_utc_ns=utc_ns,
            started_ns=started_ns,
            pid=os.getpid(),
            capture=str(capture),
        ),
    )
    return capture


def append(path: Path, rate: int, seconds: float) -> None:
    """Append frames at a steady rate, each batch when its last frame is due. This is the body of the other process."""
    capture, size = Capture(path), int(rate * BATCH_S) // 4 * 4
    step_ns = round(1e9 / rate)
    print("ready", flush=True)
    with path.open("a", encoding="ascii") as file:
        start_ns = time.monotonic_ns()
        for batch in range(int(seconds * rate / size)):
            due_ns = start_ns + (batch + 1) * size * step_ns
            time.sleep(max(0.0, (due_ns - time.monotonic_ns()) / 1e9))
            capture.write(file, size, due_ns - size * step_ns, step_ns)


class Server:
    """A process of Studio, with its start measured."""

    def __init__(self, root: Path) -> None:
        self.url = f"http://127.0.0.1:{free_port()}/"
        command = [python(), "-m", "fieldtwin", "studio", "--no-browser", "--no-token", "--listen", self.url[7:-1]]
        self._log = (root / "studio.log").open("wb")
        begun = time.monotonic()
        self.process: subprocess.Popen[Any] = subprocess.Popen(
            command, stdout=self._log, stderr=self._log, env=os.environ | {"FIELDTWIN_RUN": str(root)}
        )
        while True:
            try:
                with urllib.request.urlopen(self.url, timeout=5) as page:
                    page.read()
                break
            except (urllib.error.URLError, ConnectionError) as e:
                if self.process.poll() is not None or time.monotonic() - begun > 60:
                    raise Missing(f"Studio (the extra `studio`): {(root / 'studio.log').read_text()[-300:]}") from e
                time.sleep(0.01)
        self.first_page_s = time.monotonic() - begun

    def total(self) -> int:
        """Return the number of indexed frames."""
        with urllib.request.urlopen(f"{self.url}api/v1/instances/{NAME}/frames?count=1", timeout=30) as answer:
            found: int = json.load(answer)["total"]
            return found

    def wait_for(self, total: int) -> float:
        """Wait until this number of frames is indexed; return the duration in seconds."""
        begun = time.monotonic()
        while self.total() < total:
            if time.monotonic() - begun > INDEXED_WITHIN_S:
                raise SystemExit(f"only {self.total()} of {total} frames were indexed in {INDEXED_WITHIN_S} s")
            time.sleep(0.5)
        return time.monotonic() - begun

    def wait_until_all_values(self, instance: str) -> None:
        """Wait until Studio has the values of all tags from the gateway and from the process image."""
        begun = time.monotonic()
        while time.monotonic() - begun < 60:
            with urllib.request.urlopen(f"{self.url}api/v1/instances/{instance}/status", timeout=30) as answer:
                status = json.load(answer)
            if (
                status["gateway"]
                and status["plc"]
                and min(len(status["gateway"]["tags"]), len(status["plc"]["inputs"])) >= TAGS
            ):
                return
            time.sleep(0.5)
        raise SystemExit(f"Studio does not have all values: {status['troubles']}")

    def close(self) -> None:
        stop(self.process)
        self._log.close()


def browser() -> Any:
    """Return a headless Chromium."""
    try:
        from selenium import webdriver
        from selenium.webdriver.chrome.options import Options
        from selenium.webdriver.chrome.service import Service
    except ImportError as e:
        raise Missing("selenium (pip install selenium)") from e
    chromium, driver = shutil.which("chromium"), shutil.which("chromedriver")
    if chromium is None or driver is None:
        raise Missing("Chromium (Debian: chromium, chromium-driver)")
    options = Options()
    options.binary_location = chromium
    for argument in (
        "--headless=new",
        "--no-sandbox",
        "--disable-gpu",
        "--disable-dev-shm-usage",
        "--window-size=1280,720",
    ):
        options.add_argument(argument)
    return webdriver.Chrome(options=options, service=Service(driver))


JUMPS = """
const [places, done] = arguments;
const view = document.querySelector(".frames .view");
const took = [];
const next = () => {
  if (took.length === places.length) return done(took);
  const begun = performance.now();
  view.scrollTop = places[took.length] * (view.scrollHeight - view.clientHeight);
  const look = () => {
    const top = view.scrollTop, rows = [...document.querySelectorAll(".row.item")];
    const near = rows.some((r) => Math.abs(parseFloat(r.style.top) - top) < 100);
    if (near && !document.querySelector(".row.soft")) { took.push(performance.now() - begun); next(); }
    else if (performance.now() - begun > 20000) done(took);
    else requestAnimationFrame(look);
  };
  requestAnimationFrame(() => requestAnimationFrame(look));
};
next();
"""

WATCH = """
const [startedWallMs, milliseconds, done] = arguments;
const seen = [], begun = performance.now();
let last = "";
const look = () => {
  const rows = [...document.querySelectorAll(".row.item")];
  let newest = "", lowest = -1;
  for (const row of rows) {
    if (parseFloat(row.style.top) <= lowest) continue;
    lowest = parseFloat(row.style.top);
    newest = row.firstElementChild.textContent;
  }
  if (newest && newest !== last) {
    last = newest;
    const t = newest.split(":").reduce((sum, part) => sum * 60 + Number(part), 0) * 1000;
    seen.push([t, performance.timeOrigin + performance.now() - startedWallMs]);
  }
  if (performance.now() - begun < milliseconds) requestAnimationFrame(look);
  else done(seen);
};
requestAnimationFrame(look);
"""


def a_million(root: Path, frames: int) -> tuple[Server, float, list[float]]:
    """Return the server with the frames indexed, the seconds that this took, and the milliseconds of each jump."""
    now_ns = time.monotonic_ns()
    path = make_run(root, now_ns - frames * 200_000)
    with path.open("a", encoding="ascii") as file:
        Capture(path).write(file, frames, now_ns - frames * 200_000, 200_000)
    server = Server(root)
    indexed_s = server.wait_for(frames)
    driver = browser()
    try:
        driver.set_script_timeout(600)
        open_bus(driver, server.url)
        driver.execute_script("[...document.querySelectorAll('button')].find((b) => b.textContent === 'Pause').click()")
        chosen = random.Random(1)
        took: list[float] = driver.execute_async_script(JUMPS, [chosen.random() for _ in range(PLACES)])
    finally:
        driver.quit()
    return server, indexed_s, took


def open_bus(driver: Any, url: str) -> None:
    """Open the bus view and wait for rows."""
    from selenium.webdriver.support.ui import WebDriverWait

    driver.get(f"{url}#/{NAME}/bus")
    WebDriverWait(driver, 60).until(
        lambda d: d.execute_script("return document.querySelectorAll('.row.item .mono').length > 3")
    )


def to_screen(root: Path, rate: int, seconds: float) -> list[float]:
    """Return the milliseconds from frames to the screen while they are appended."""
    started_ns = time.monotonic_ns()
    path = make_run(root, started_ns)
    with path.open("a", encoding="ascii") as file:
        Capture(path).write(file, 100, started_ns, 10_000)
    server = Server(root)
    driver = browser()
    writer: subprocess.Popen[str] | None = None
    try:
        driver.set_script_timeout(seconds + 60)
        open_bus(driver, server.url)
        command = [python(), __file__, "--append", str(path), "--rate", str(rate), "--seconds", str(seconds)]
        writer = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        assert writer.stdout is not None
        writer.stdout.readline()
        wall_ms = (time.time_ns() - time.monotonic_ns() + started_ns) / 1e6
        seen: list[tuple[float, float]] = driver.execute_async_script(WATCH, wall_ms, round((seconds - 0.5) * 1000))
    finally:
        driver.quit()
        if writer is not None:
            stop(writer)
        server.close()
    ages = []
    for (before, _), (newest, shown) in pairwise(seen[1:]):
        frames = max(1, round((newest - before) * rate / 1000))
        ages += [shown - (before + (newest - before) * (n + 1) / frames) for n in range(frames)]
    return ages


LOAD_PROFILE = """device: bench/many
source: "this benchmark"
protocol: modbus
defaults: {{poll: all}}
tags:
{tags}
"""
LOAD_SYSTEM = """fieldtwin: 1
system: many
buses: {{lan: {{url: "tcp://127.0.0.1:502"}}}}
devices:
{devices}
plc: {{cycle_ms: 10, watchdog: {{late_ms: 1000}}, programs: {{copy: {{source: copy.st, inputs: {{x: {{tag: d0.t0}}}}}}}}}}
"""
LOAD_PROTOTYPE = """prototype_of: many.yaml
buses: {{lan: {{listen: "tcp://127.0.0.1:0"}}}}
devices:
{devices}
"""
LOAD_PROGRAM = """PROGRAM copy
  VAR_INPUT x : REAL; END_VAR
  VAR y : REAL; END_VAR
  y := x + 1.0;
END_PROGRAM
"""


def write_plant(folder: Path) -> None:
    """Write a system with `TAGS` tags: devices of 100 registers, each of which is read every 500 ms."""
    devices = range(TAGS // 100)
    tags = "\n".join(f"  t{n}: {{at: {30001 + n}, type: uint16}}" for n in range(100))
    poll = "poll: {all: {every_ms: 500}}"
    named = "\n".join(f"  d{n}: {{profile: many_device.yaml, bus: lan, unit: {n + 1}, {poll}}}" for n in devices)
    values = "\n".join(f"  d{n}: {{model: profile, values: {{t0: {n}}}}}" for n in devices)
    (folder / "many_device.yaml").write_text(LOAD_PROFILE.format(tags=tags))
    (folder / "many.yaml").write_text(LOAD_SYSTEM.format(devices=named))
    (folder / "many.prototype.yaml").write_text(LOAD_PROTOTYPE.format(devices=values))
    (folder / "copy.st").write_text(LOAD_PROGRAM)


@dataclass
class Cost:
    """The figures of one part of a pair: shares of a CPU, and how late scans began, in us."""

    gateway: float
    plc: float
    p50: float
    p99: float


class Plant:
    """A running prototype with `TAGS` tags."""

    def __init__(self, root: Path) -> None:
        write_plant(root)
        self.root, self.run_dir = root, root / "run" / "many"
        self._log = (root / "run.log").open("wb")
        command = [
            python(),
            "-m",
            "fieldtwin",
            "run",
            "many.yaml",
            "--prototype",
            "--commands",
            "none",
            "--log",
            "text",
        ]
        environment = os.environ | {"FIELDTWIN_RUN": str(root / "run")}
        self.process = subprocess.Popen(command, cwd=root, stdout=self._log, stderr=self._log, env=environment)
        deadline = time.monotonic() + 90
        while not (self.run_dir / "run.json").exists() or self.plc()["state"] != "running":
            if self.process.poll() is not None or time.monotonic() > deadline:
                raise SystemExit(f"the plant did not start: {(root / 'run.log').read_text()[-500:]}")
            time.sleep(0.2)

    def plc(self) -> dict[str, Any]:
        """Return the brief status of the PLC with the distribution of the lateness."""
        try:
            return asked(self.run_dir / "plc.sock")
        except OSError:
            return {"state": "absent"}

    def cost(self, seconds: float) -> Cost:
        """Measure for some seconds. The lateness is that of the scans of this time only."""
        pids = {name: child_pid(self.process.pid, name) for name in ("fieldtwin.plc", "controller")}
        before, spent = self.plc(), {name: cpu_s(pid) for name, pid in pids.items()}
        time.sleep(seconds)
        after = self.plc()
        used = {name: (cpu_s(pid) - spent[name]) / seconds for name, pid in pids.items()}
        late = difference(before["lateness_buckets"], after["lateness_buckets"])
        return Cost(used["controller"], used["fieldtwin.plc"], quantile_us(late, 0.5), quantile_us(late, 0.99))

    def close(self) -> None:
        self.process.send_signal(signal.SIGINT)
        self.process.wait(30)
        self._log.close()


def asked(path: Path) -> dict[str, Any]:
    """Return the PLC's brief status."""
    with socket.socket(socket.AF_UNIX) as s:
        s.settimeout(10)
        s.connect(str(path))
        s.sendall(b'{"v": 1, "id": 1, "command": "get", "args": {"brief": true, "buckets": true}}\n')
        with s.makefile("rb") as lines:
            found: dict[str, Any] = json.loads(lines.readline())["result"]
    return found


def child_pid(parent: int, part: str) -> int:
    """Return the child process whose command line contains `part`."""
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            stat = (folder / "stat").read_text().rpartition(")")[2].split()
            if int(stat[1]) == parent and part in (folder / "cmdline").read_text().replace("\0", " "):
                return int(folder.name)
        except OSError:
            continue
    raise SystemExit(f"the plant has no process {part}")


def difference(before: list[tuple[float, int]], after: list[tuple[float, int]]) -> list[tuple[float, float]]:
    """Return the counts of the time between two distributions."""
    known = dict(before)
    return [(limit, count - known.get(limit, 0)) for limit, count in after]


def quantile_us(buckets: list[tuple[float, float]], share: float) -> float:
    """Return the upper limit of the bucket that contains a quantile, interpolated within it."""
    total, seen, low = sum(count for _, count in buckets), 0.0, 0.0
    for limit, count in buckets:
        if count and seen + count >= total * share:
            return low + (limit - low) * (total * share - seen) / count
        seen, low = seen + count, limit
    return low


def load(root: Path, pairs: int, seconds: float) -> list[tuple[Cost, Cost]]:
    """Return the costs of the plant without and with Studio, pair by pair."""
    root.mkdir(parents=True)
    plant, found = Plant(root), []
    try:
        time.sleep(3)
        for _ in range(pairs):
            without = plant.cost(seconds)
            server, driver = Server(root / "run"), browser()
            try:
                driver.get(f"{server.url}#/many/devices")
                server.wait_until_all_values("many")
                found.append((without, plant.cost(seconds)))
            finally:
                driver.quit()
                server.close()
            time.sleep(1)
    finally:
        plant.close()
    return found


def percentile(values: list[float], share: float) -> float:
    return sorted(values)[min(len(values) - 1, int(len(values) * share))]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--rate", type=int, default=5000)
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--frames", type=int, default=1_000_000)
    parser.add_argument("--pairs", type=int, default=5)
    parser.add_argument("--only", choices=("screen", "many", "load"))
    parser.add_argument("--append", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.append is not None:
        append(options.append, options.rate, options.seconds)
        return 0
    frames, seconds, pairs, part_s = (
        (50_000, 6.0, 2, 5.0) if options.quick else (options.frames, options.seconds, options.pairs, PART_S)
    )
    wanted = {options.only} if options.only else {"screen", "many", "load"}
    goals = Goals()
    folder = Path(tempfile.mkdtemp(prefix="fieldtwin-bench-"))
    reports: list[Callable[[], None]] = []
    try:
        if "screen" in wanted:
            ages = to_screen(folder / "live", options.rate, seconds)
            reports.append(lambda: report_screen(goals, ages, options.rate, seconds))
        if "many" in wanted:
            server, indexed_s, jumps = a_million(folder / "many", frames)
            memory, first_page_s = peak_mb(server.process.pid), server.first_page_s
            server.close()
            reports.append(lambda: report_many(goals, frames, indexed_s, jumps, memory, first_page_s))
        if "load" in wanted:
            costs = load(folder / "load", pairs, part_s)
            reports.append(lambda: report_load(goals, costs))
    except Missing as e:
        print(f"left out: {e} is not installed")
        return 2
    finally:
        shutil.rmtree(folder, ignore_errors=True)
    for report in reports:
        report()
    return goals.verdict()


def report_screen(goals: Goals, ages: list[float], rate: int, seconds: float) -> None:
    late = percentile(ages, 0.95)
    print(f"{rate} frames/s, {seconds:g} s: {len(ages)} on the screen after {median(ages):.0f} ms, 95 % {late:.0f} ms")
    goals.least("share of the appended frames that reached the screen", len(ages) / (rate * seconds), FOLLOWED)
    goals.most("frame to screen, 95 %", late, SCREEN_MS, "ms")


def report_many(
    goals: Goals, frames: int, indexed_s: float, jumps: list[float], memory: float, first_page_s: float
) -> None:
    slow = percentile(jumps, 0.95) if len(jumps) == PLACES else float("inf")
    print(
        f"{frames} frames: indexed in {indexed_s:.1f} s, {frames / indexed_s:.0f} frames/s; server {memory:.0f} MB at most"
    )
    print(f"a random place: {median(jumps):.0f} ms, 95 % {slow:.0f} ms, worst {max(jumps):.0f} ms of {len(jumps)}")
    goals.most("memory of the server", memory, MEMORY_MB, "MB")
    goals.most("any frame on the screen, 95 %", slow, SHOWN_MS, "ms")
    goals.most("first page after the start", first_page_s, FIRST_PAGE_S, "s")


def report_load(goals: Goals, costs: list[tuple[Cost, Cost]]) -> None:
    print(f"{TAGS} tags, {len(costs)} pairs              without Studio   with Studio   difference of pairs")
    for name, text, scale, unit in (
        ("p50", "scan late, median", 1, "us"),
        ("p99", "scan late, 99 %", 1, "us"),
        ("plc", "CPU of the PLC", 100, "%"),
        ("gateway", "CPU of the gateway", 100, "%"),
    ):
        without, with_studio = ([getattr(part, name) * scale for part in side] for side in zip(*costs, strict=True))
        more = [b - a for a, b in zip(without, with_studio, strict=True)]
        print(
            f"  {text:<28} {median(without):>11.1f} {unit:<2} {median(with_studio):>10.1f} {unit:<2}"
            f" {median(more):>+9.1f} ({min(more):+.1f} to {max(more):+.1f})"
        )
    goals.most("scan late with Studio, 99 %, more", median(b.p99 - a.p99 for a, b in costs), LATE_MORE_US, "us")
    goals.most("CPU of the PLC with Studio, more", median(b.plc - a.plc for a, b in costs), CPU_MORE, "of a CPU")
    goals.most(
        "CPU of the gateway with Studio, more", median(b.gateway - a.gateway for a, b in costs), CPU_MORE, "of a CPU"
    )


if __name__ == "__main__":
    sys.exit(main())
