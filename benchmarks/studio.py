#!/usr/bin/env python3
"""Studio's bus view in headless Chromium: the time from a frame to the screen, and a million frames at hand.

    benchmarks/studio.py [--quick] [--rate 5000] [--seconds 20] [--frames 1000000]

First part: Studio starts with a capture of a million frames of the observatory. Measured are the time until it serves its page,
the time until all frames are indexed, the memory of the server, and the time until the rows at random positions are drawn.
Second part: another process appends frames to a capture at the given rate; the page follows them. For each frame, the time from
its time stamp until its row, or a later one, is drawn. Nothing else is compared: no peer shows the frames of such a run.

Needs `chromium` and `chromedriver` (Debian: chromium-driver) and selenium. Absolute times: a quiet machine of 2 cores.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import shutil
import subprocess
import sys
import tempfile
import time
import urllib.error
import urllib.request
from itertools import pairwise
from pathlib import Path
from statistics import median
from typing import Any, TextIO

from peers import Goals, Missing, free_port, peak_mb, python, stop

SCREEN_MS, MEMORY_MB, SHOWN_MS, FIRST_PAGE_S = 250, 400, 200, 2.0
FOLLOWED = 0.85
"""Share of the appended frames that must reach the screen, because a page that stops following has no late frames. The
measurement ends half a second before the last frame."""
MOST_STEAL = 0.02
NAME = "bench"
BATCH_S = 0.01
INDEXED_WITHIN_S = 900
PLACES = 40
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
        """Wait until so many frames are indexed; return the seconds that it took."""
        begun = time.monotonic()
        while self.total() < total:
            if time.monotonic() - begun > INDEXED_WITHIN_S:
                raise SystemExit(f"only {self.total()} of {total} frames were indexed in {INDEXED_WITHIN_S} s")
            time.sleep(0.5)
        return time.monotonic() - begun

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


def percentile(values: list[float], share: float) -> float:
    return sorted(values)[min(len(values) - 1, int(len(values) * share))]


def cpu_ticks() -> tuple[int, int]:
    """Return the stolen ticks and all ticks of the CPUs since boot."""
    fields = [int(n) for n in Path("/proc/stat").read_text().split("\n", 1)[0].split()[1:]]
    return fields[7], sum(fields[:8])


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--rate", type=int, default=5000)
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--frames", type=int, default=1_000_000)
    parser.add_argument("--append", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.append is not None:
        append(options.append, options.rate, options.seconds)
        return 0
    frames, seconds = (50_000, 6.0) if options.quick else (options.frames, options.seconds)
    before = cpu_ticks()
    folder = Path(tempfile.mkdtemp(prefix="fieldtwin-bench-"))
    server = None
    try:
        ages = to_screen(folder / "live", options.rate, seconds)
        server, indexed_s, jumps = a_million(folder / "many", frames)
        memory, first_page_s = peak_mb(server.process.pid), server.first_page_s
    except Missing as e:
        print(f"left out: {e} is not installed")
        return 2
    finally:
        if server is not None:
            server.close()
        shutil.rmtree(folder, ignore_errors=True)
    stolen, spent = (b - a for a, b in zip(before, cpu_ticks(), strict=True))
    steal = stolen / max(spent, 1)
    late = percentile(ages, 0.95)
    slow = percentile(jumps, 0.95) if len(jumps) == PLACES else float("inf")
    print(
        f"{options.rate} frames/s, {seconds:g} s: {len(ages)} on the screen after {median(ages):.0f} ms, 95 % {late:.0f} ms"
    )
    print(
        f"{frames} frames: indexed in {indexed_s:.1f} s, {frames / indexed_s:.0f} frames/s; server {memory:.0f} MB at most"
    )
    print(f"a random place: {median(jumps):.0f} ms, 95 % {slow:.0f} ms, worst {max(jumps):.0f} ms of {len(jumps)}")
    print(f"load {os.getloadavg()[0]:.1f} on {os.cpu_count()} CPUs, steal {steal:.1%}\n")
    if steal > MOST_STEAL:
        print(f"INCONCLUSIVE: the host took {steal:.1%} of the CPU time away (at most {MOST_STEAL:.0%})")
        return 3
    goals = Goals()
    goals.least("share of the appended frames that reached the screen", len(ages) / (options.rate * seconds), FOLLOWED)
    goals.most("frame to screen, 95 %", late, SCREEN_MS, "ms")
    goals.most("memory of the server", memory, MEMORY_MB, "MB")
    goals.most("any frame on the screen, 95 %", slow, SHOWN_MS, "ms")
    goals.most("first page after the start", first_page_s, FIRST_PAGE_S, "s")
    return goals.verdict()


if __name__ == "__main__":
    sys.exit(main())
