"""The kinds of errors that fieldtwin prints, and its exit codes."""

from __future__ import annotations

from fieldtwin.explain.explanation import Explanation
from fieldtwin.gateway.core import errors as e

_SOURCE = "docs/explanation/design.md"
_TODO: dict[type[e.FieldtwinError], str] = {
    e.CheckFailed: "Read which test case failed; `fieldtwin explain MB-015` explains a case.",
    e.UsageError: "Correct the command line. The text names what was expected, and often the nearest known word.",
    e.NotAllowed: "Decide whether it should be permitted: `writable:` and `limits:` in the system file, `--allow-writes` for a "
    "plant, `--allow` for tests.",
    e.OutOfLimits: "Write a value inside the limits that the message names, or correct `limits:` or the type of the tag "
    "in its profile.",
    e.FileInvalid: "Correct the file at the line and column that the message names. Each further error has its own line.",
    e.CommandListMismatch: "Use the profile that fits the device's firmware, so that both sides know the same commands.",
    e.Bug: "Please report it with the file that the message names: the fault is in fieldtwin.",
    e.Unreachable: "Check the endpoint, the device's power and the cable. `fieldtwin doctor` checks this computer.",
    e.EndpointBusy: "Find the process that uses the port: `fuser /dev/ttyUSB0`, `ss -ltnp`. Stop it, or use another port.",
    e.ConnectionLost: "The gateway connects again by itself. If it recurs, check the cable, the switch, and idle timeouts.",
    e.WireError: "Look at the frames: `fieldtwin record`, or `fieldtwin trace --problems` after a run.",
    e.ReplyTimeout: "Check power, wiring, unit ID or node ID, baud rate and parity; `fieldtwin scan` tries them. A slow device "
    "needs a longer timeout.",
    e.CrcError: "Check termination, biasing, A and B, ground, baud rate and parity; `fieldtwin line` listens for such faults.",
    e.Desync: "Two clients on one line, a late reply to an earlier request, or a gateway that mixes up its clients cause this. "
    "Look at the frames before it.",
    e.WrongSize: "The device sends another number of registers than was requested. Read fewer at a time, and report it to "
    "the manufacturer.",
    e.DeviceRefused: "The message has the device's reason; `fieldtwin explain` knows the codes of both protocols.",
    e.ModbusExceptionReply: "`fieldtwin explain exception 02` explains a code.",
    e.SdoAborted: "`fieldtwin explain abort 06020000` explains a code.",
    e.UnknownCommand: "Use a command of the device's command list, which its profile states.",
    e.VerifyFailed: "The device rounded, limited or ignored the value, or something else writes to it too. Compare the range in "
    "the manual.",
    e.WrongDevice: "Compare `fieldtwin identify` with the profile: a device was exchanged, or two have swapped addresses.",
}
_EXITS: dict[int, tuple[str, str, str]] = {
    0: ("ok", "The command did what was asked, and every verdict is good.", "Nothing."),
    1: (
        "a check failed",
        "The command ran to its end, and a check, test or comparison failed or stayed undecided.",
        "Read the verdict above; `--json` and the reports have the evidence.",
    ),
    2: (
        "usage",
        "The command line makes no sense, or the request is not permitted.",
        "Read the message; `--help` lists the options.",
    ),
    3: (
        "a file is invalid",
        "A file that you wrote or recorded cannot be used as it is.",
        "Correct the place that the message names.",
    ),
    4: (
        "unreachable",
        "An endpoint cannot be opened or does not answer; for `dump` and `compare`: too much stayed unknown for a "
        "verdict.",
        "Check the endpoint, power and wiring; `fieldtwin doctor` checks this computer.",
    ),
    5: (
        "the device refused",
        "The device understood the request and refused it.",
        "`fieldtwin explain` knows the code in the message.",
    ),
    70: ("our bug", "fieldtwin has failed.", "Please report it with the file that the message names."),
    130: (
        "interrupted",
        "You or a service manager ended the command before its time.",
        "Nothing; outputs have their safe values.",
    ),
}


_MEANINGS: dict[type[e.FieldtwinError], str] = {
    e.ModbusExceptionReply: "The device answered with a Modbus exception.",
    e.WrongSize: "A complete reply arrived, but with another number of registers than was requested.",
    e.CommandListMismatch: "The driver and the device do not accept the same commands.",
    e.UnknownCommand: "The command is not in the device's command list.",
    e.FileInvalid: "A file that a user wrote or recorded cannot be used as it is.",
}
"""The meanings of the kinds of errors whose docstring is written for programmers."""


def _meaning(kind: type[e.FieldtwinError]) -> str:
    """Return what an error of this kind means: its text in `_MEANINGS`, else the first paragraph of its docstring."""
    return _MEANINGS.get(kind) or " ".join((kind.__doc__ or "").partition("\n\n")[0].split())


ERRORS: tuple[Explanation, ...] = (
    *(
        Explanation(
            kind.__name__,
            "error",
            f"{kind.blame.value} is at fault; exit code {kind.exit_code}",
            _meaning(kind),
            todo,
            _SOURCE,
        )
        for kind, todo in _TODO.items()
    ),
    *(
        Explanation(f"exit {code}", "exit code", title, meaning, todo, _SOURCE, (f"exit code {code}",))
        for code, (title, meaning, todo) in _EXITS.items()
    ),
)
