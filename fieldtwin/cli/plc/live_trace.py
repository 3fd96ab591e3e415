"""A trace of variables in a running instance: begin it, read its rows as they come, and show them on a terminal."""

from __future__ import annotations

import asyncio
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rich.live import Live

from fieldtwin.cli.plc.trace_view import trace_table
from fieldtwin.console import stderr
from fieldtwin.gateway.core.control import ControlClient
from fieldtwin.plc.runtime.variable_trace import TraceRow, TraceSize
from fieldtwin.results.scan_trace import ScanTrace, TraceColumn

READ_S = 0.25
"""The time in seconds between two reads of new rows."""


class LiveTrace:
    """One recording. It ends when it is complete: after the scans after the trigger, after `duration_s`, or without both after
    the wanted number of scans; and when the user interrupts it.
    """

    def __init__(self, names: Sequence[str], size: TraceSize, when: str, duration_s: float | None) -> None:
        self._names, self._size, self._when, self._duration_s = names, size, when, duration_s
        self._first_ns = 0
        self._found = ScanTrace((), 1)

    async def run(self, path: Path) -> ScanTrace:
        """Record in the PLC whose control channel is at `path`, and return the trace."""
        client = await ControlClient.connect_unix(path)
        try:
            begun = await client.call(
                "trace_begin",
                names=list(self._names),
                before=self._size.before,
                after=self._size.after,
                when=self._when,
            )
            columns = [TraceColumn(v["name"], v["type"], v["unit"]) for v in begun["variables"]]
            self._found = ScanTrace(columns, self._size.before + self._size.after)
            try:
                await self._follow(client, begun["number"])
            except asyncio.CancelledError:
                pass  # Ctrl-C ends the recording, not the command
            await client.call("trace_end", number=begun["number"])
        finally:
            await client.aclose()
        return self._found

    async def _follow(self, client: ControlClient, number: int) -> None:
        with Live(console=stderr, auto_refresh=False, transient=True) as live:
            while True:
                answer = await self._read(client, number)
                if stderr.is_terminal:
                    live.update(trace_table(self._found, stderr.width, self._state(answer)), refresh=True)
                if self._is_complete(answer):
                    return
                await asyncio.sleep(READ_S)

    async def _read(self, client: ControlClient, number: int) -> dict[str, Any]:
        """Read all rows that exist, a limited number at a time."""
        found = self._found
        while True:
            answer: dict[str, Any] = await client.call("trace_read", number=number, since=found.next_row)
            found.triggered = answer["triggered_row"]
            for row_number, scan, t_ns, *values in answer["rows"]:
                self._first_ns = self._first_ns or t_ns
                found.add(TraceRow(row_number, scan, t_ns, tuple(values)))
            if found.next_row >= answer["next_row"]:
                return answer

    def _is_complete(self, answer: dict[str, Any]) -> bool:
        if answer["state"] == "complete":
            return True
        if self._duration_s is not None:
            return self._first_ns > 0 and answer["now_ns"] - self._first_ns >= self._duration_s * 1e9
        return not self._when and len(self._found.rows) >= self._size.before

    def _state(self, answer: dict[str, Any]) -> str:
        """Return the state of the recording in words."""
        if answer["state"] == "waiting":
            error = f" ({answer['error']})" if answer["error"] else ""
            return f"waits until {self._when}{error}"
        kept = len(self._found.rows)
        return f"{answer['state']}, {kept} scans"
