"""Endless logic: a limit per scan in Structured Text, in real and in virtual time, and signals in virtual time.

Defect: an endless loop blocked a run in virtual time forever, and SIGTERM did not end it.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from st_bench import program, run, scan

from fieldtwin.gateway.core.image.image import INPUTS
from fieldtwin.plc.binding import image_for
from fieldtwin.plc.cycle.task import StopReason
from fieldtwin.plc.program import ProgramFailed, ProgramStuck, ScanTooLong
from fieldtwin.plc.prove import Proof, prove
from fieldtwin.plc.runtime.config import PlcConfig, ProgramConfig
from fieldtwin.plc.runtime.runner import TaskRunner
from fieldtwin.plc.st.context import MAX_STEPS
from fieldtwin.testing.worker.stepped_program import SteppedProgram

ENDLESS = {
    "WHILE": "WHILE go DO\nn := n + 1;\nEND_WHILE",
    "REPEAT": "REPEAT\nn := n + 1;\nUNTIL NOT go END_REPEAT",
    "FOR": "IF go THEN FOR k := 1 TO 2000000000 DO\nn := n + 1;\nEND_FOR END_IF",
    "CONTINUE": "WHILE go DO\nCONTINUE; END_WHILE",
    "nested": "FOR k := 1 TO 10000 DO\nIF go THEN FOR l := 1 TO 10000 DO ; END_FOR END_IF END_FOR",
}
HEAD = "PROGRAM p VAR_OUTPUT n : DINT; END_VAR VAR go : BOOL := TRUE; k, l : DINT; END_VAR\n"


@pytest.mark.parametrize("loop", sorted(ENDLESS))
def test_a_loop_without_an_end_stops_the_plc_and_names_file_and_line(tmp_path: Path, loop: str) -> None:
    (tmp_path / "endless.st").write_text(f"{HEAD}\n{ENDLESS[loop]}\nEND_PROGRAM")
    config = ProgramConfig("p", "endless.st")
    layout = image_for([config.bind((str(tmp_path),))], {})
    memory = memoryview(bytearray(layout.size))
    layout.format(memory)
    image = layout.attach(memory)
    image.writer(INPUTS).publish([], 0)
    now = [0]
    plc = PlcConfig("", layout.describe(), "", (config,), python_path=(str(tmp_path),), max_restarts=0)
    runner = TaskRunner(plc, image, lambda: now[0])  # no wall clock and no timer signal, as in virtual time
    runner.start()
    now[0] = runner.deadline_ns
    runner.run_once()
    assert runner.stop_reason is StopReason.STUCK
    assert isinstance(runner.error, ProgramStuck)
    assert f"{tmp_path / 'endless.st'}:" in str(runner.error)
    assert 3 <= runner.error.line <= 5
    assert f"more than {MAX_STEPS:,} loop iterations and calls in one scan" in str(runner.error)


def test_calls_that_multiply_are_counted_too() -> None:
    chain = "FUNCTION f0 : INT f0 := 1; END_FUNCTION\n" + "\n".join(
        f"FUNCTION f{n} : INT f{n} := f{n - 1}() + f{n - 1}(); END_FUNCTION" for n in range(1, 40)
    )
    with pytest.raises(ScanTooLong):
        run("r : INT;", "r := f39();", chain)


def test_the_limit_is_of_each_scan_alone() -> None:
    made = program(f"PROGRAM p VAR i, n : DINT; END_VAR FOR i := 1 TO {MAX_STEPS} DO n := n + 1; END_FOR END_PROGRAM")
    for number in (1, 2):
        scan(made, number)
    assert made.st_body.v_n == 2 * MAX_STEPS


def test_a_test_that_steps_a_program_fails_with_file_and_line(tmp_path: Path) -> None:
    (tmp_path / "endless.st").write_text(f"{HEAD}\n{ENDLESS['WHILE']}\nEND_PROGRAM")
    stepped = SteppedProgram("endless.st", (str(tmp_path),), 10)
    with pytest.raises(ProgramFailed, match=r"endless\.st:[345]"):
        stepped.scan(1)


def test_the_prover_reports_it() -> None:
    proof = Proof(lambda: program(f"{HEAD}{ENDLESS['WHILE']} END_PROGRAM"), {}, {"any": lambda p: True})
    assert "loop iterations and calls in one scan" in prove(proof).broken


SPINS = """
import asyncio, signal, sys
from fieldtwin.emulators.virtual.loop import VirtualLoop

def told(number, frame):
    sys.exit(128 + number)

signal.signal(signal.SIGTERM, told)

async def main():
    print("spinning", flush=True)
    while True:
        pass

VirtualLoop().run_until_complete(main())
"""


@pytest.mark.long
def test_sigterm_ends_a_virtual_run_whose_callback_never_ends() -> None:
    """One signal is sufficient: logic in Python has no separate limit."""
    with subprocess.Popen([sys.executable, "-c", SPINS], stdout=subprocess.PIPE, text=True) as child:
        assert child.stdout is not None
        assert child.stdout.readline() == "spinning\n"
        os.kill(child.pid, signal.SIGTERM)
        try:
            assert child.wait(60) == 128 + signal.SIGTERM
        finally:
            child.kill()
