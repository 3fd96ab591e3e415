"""The last exchanges on the bus before a check failed, as lines of text. They are the evidence of a verdict that is not
PASSED.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence

from fieldtwin.capture.decoding.exchange import DecodedExchange
from fieldtwin.gateway.core.clock import NS_PER_S
from fieldtwin.results.model import CheckResult, Verdict

SECONDS = 5
"""Longest time in seconds between the end of a shown exchange and the failed check."""
MOST = 10
"""Largest number of exchanges that are shown: the last ones. The first line says how many were left out."""


def last_exchanges(exchanges: Iterable[DecodedExchange], check: CheckResult, devices: Collection[str]) -> list[str]:
    """Return the exchanges on the bus in the last `SECONDS` until `check` was decided, a heading first, ordered by
    the time of the request.

    If the check is about `devices`, only their exchanges are shown. If it names none of them, or those devices were
    silent, the exchanges of all devices are shown. Values of secret tags stay hidden, as in every decoded text.
    """
    at_ns = check.t_ns or 0
    near = [e for e in exchanges if e.t_ns <= at_ns and e.end_ns >= at_ns - SECONDS * NS_PER_S]
    about = sorted({device for name in check.names if (device := _device_of(name, devices))})
    of_these = [e for e in near if e.device in about]
    whose = f" with {', '.join(about)}" if of_these else ""
    found = sorted(of_these or near, key=lambda e: (e.t_ns, e.end_ns))
    left_out = len(found) - MOST
    more = f" ({left_out} earlier exchanges were left out)" if left_out > 0 else ""
    heading = f"exchanges{whose} in the {SECONDS} s before the failed check{more}:"
    if not found:
        return [f"no exchange in the {SECONDS} s before the failed check"]
    return [heading, *map(line_of, found[-MOST:])]


def line_of(exchange: DecodedExchange) -> str:
    """Return an exchange as ``12.340 s  ctd: read pressure -> ctd: pressure 1.2 dbar``, a message such as a PDO alone."""
    at = f"{exchange.t_ns / NS_PER_S:.3f} s"
    if exchange.is_stray:
        return f"{at}  {exchange.text}"
    reply = "no reply so far" if exchange.problem == "pending" else exchange.reply_text or exchange.problem
    return f"{at}  {exchange.text} -> {reply}" if reply else f"{at}  {exchange.text}"


def deciding(checks: Sequence[CheckResult], verdict: Verdict) -> CheckResult | None:
    """Return the check that gave a scenario its `verdict`, or None if no check decided it, because the scenario expected
    nothing.
    """
    return next((check for check in checks if check.verdict is verdict and check.t_ns is not None), None)


def _device_of(name: str, devices: Collection[str]) -> str:
    """Return the device to which a check's name (DEVICE, DEVICE.TAG or PROGRAM.VARIABLE) belongs; "" if there is none."""
    return next((part for part in (name, name.rpartition(".")[0]) if part in devices), "")
