"""The PLC process: an image file, programs, their tasks on the wall clock, and a control channel.

Commands on the control channel (fieldtwin.gateway.core.control, on the configured Unix socket):

    ready     {"ready": true, "state": ...}: the image is attached and the tasks were started
    get       all that a display shows: state, error, statistics, forces; unless {"brief": true}, also every tag's value and the
              retained variables, which with thousands of tags takes longer than the time between two scans; {"brief": true,
              "buckets": true} adds the distribution of scan times, at most 30 numbers each
    image     {"tags": [...]}, at most 64: of each tag value, quality, time, age, unit, limits, force, and what programs see;
              without tags, the names of all tags
    force     {"tag": ..., "value": ..., "by": ...}: until `unforce` {"tag": ...}, or all with {"all": true}
    pause     stop executing, outputs keep their values; `go` continues; `step` {"count": n} executes n scans while paused
    why       {"tag": ...}: which program last changed it, when, and what it saw; what that program waits for before it starts
    origin    {"tag": ..., "value": ...}: the program and the line of its source that set the tag to this value
    limits    {"tags": {name: [low, high] or null}}: limits in place of those in the image's layout, after a reload
    restart   create the programs again: {"cold": true} without retained variables
    prepare_change
              compile the programs in Structured Text whose files changed since the PLC read them, and answer with what their
              replacement would do; {"back": true}: with the programs before the last replacement
    apply_change
              {"number": ...}: replace the programs as prepared, between two scans, all or none (fieldtwin.plc.runtime.online)
    about     of each program: variables, states with transitions, and the text of its source; this changes only when programs
              are replaced or restarted
    debug     requests of the Debug Adapter Protocol, and the messages for the editor (fieldtwin.plc.runtime.debugging)
    trace_begin
              {"names": [...], "before": n, "after": n, "when": ...}: record variables after each scan in a ring, if wanted around
              the first scan in which a condition in Structured Text is TRUE (fieldtwin.plc.runtime.variable_trace)
    trace_read
              {"number": ..., "since": row}: the next rows of a trace: number, scan, time and values; `trace_end` removes it
    drawings  of each program: its charts, ladder and function block diagrams as SVG
    drawn     {"program": ..., "number": ...}: the present values of one drawing
    stop      set the outputs to their safe values, then end the process

The actions of users (force to restart, and apply_change) are recorded before they are carried out; each of these commands takes
"by".

SIGTERM and SIGINT act like stop. The process ends within a second, with its outputs region flagged stopped. When a task stopped
by itself for good (a program that raised an error, an input that tripped, restarts used up), the process keeps running with its
outputs at their safe values, so that its status can be read.
"""

from __future__ import annotations

import asyncio
import mmap
import os
import signal
from contextlib import suppress
from pathlib import Path
from typing import Any

from msgspec import structs

from fieldtwin.gateway.core.control import ControlServer
from fieldtwin.gateway.core.errors import FileInvalid, Unreachable, UsageError
from fieldtwin.gateway.core.image.image import Image
from fieldtwin.plc.cycle.task import StopReason
from fieldtwin.plc.runtime.about import describe_programs
from fieldtwin.plc.runtime.acts import Acts
from fieldtwin.plc.runtime.config import PlcConfig
from fieldtwin.plc.runtime.debugging import Debugging, DebugGuard, Waiting
from fieldtwin.plc.runtime.drawings import drawings_of_programs, present_values
from fieldtwin.plc.runtime.online.changes import OnlineChanges
from fieldtwin.plc.runtime.realtime import RealtimeReport, StuckAlarm, monotonic_ns, prepare, run_task, utc_ns
from fieldtwin.plc.runtime.runner import TaskRunner
from fieldtwin.plc.runtime.tag_view import TagView
from fieldtwin.plc.runtime.tracing import Traces
from fieldtwin.plc.status import PlcStatus, WholePlcStatus

MAX_STEPS = 10_000


class PlcProcess:
    """One PLC: assembled by the constructor, run once by `run`, which blocks. Raises `FileInvalid`, `Unreachable`."""

    def __init__(self, config: PlcConfig, image: Image) -> None:
        self._config = config
        self._alarm = StuckAlarm(config.stuck_ms) if config.stuck_ms and hasattr(signal, "setitimer") else None
        self._guard = DebugGuard(self._alarm)
        self._runner = TaskRunner(config, image, monotonic_ns, self._guard)
        self._view = TagView(image, self._runner)
        self._acts = Acts(config.audit_path)
        self._changing = OnlineChanges(self._runner, self._note)
        self._traces = Traces(self._runner, monotonic_ns)
        self._loop = asyncio.new_event_loop()
        self._debugging = Debugging(
            self._runner, self._guard, Waiting(self._loop, monotonic_ns, lambda: self._stopping), self._note
        )
        self._server = ControlServer(
            {
                "ready": self._ready,
                "get": self._get,
                "image": self._tags,
                "stop": self._stop,
                "force": self._force,
                "unforce": self._unforce,
                "pause": self._pause,
                "go": self._go,
                "step": self._step,
                "why": self._why,
                "origin": self._origin,
                "limits": self._limits,
                "restart": self._restart,
                "prepare_change": self._changing.prepare,
                "apply_change": self._apply_change,
                "about": self._about,
                "debug": self._debugging.command,
                "trace_begin": self._traces.begin,
                "trace_read": self._traces.read,
                "trace_end": self._traces.end,
                "drawings": self._drawings,
                "drawn": self._drawn,
            }
        )
        self._realtime = RealtimeReport((), ())
        drawings_of_programs(self._runner.programs)  # made before the first scan, which they would delay
        self._stopping = False

    def run(self) -> int:
        """Run until requested to stop. Return the exit code: 0, or the error's when a task stopped by itself."""
        before = {s: signal.signal(s, self._on_signal) for s in (signal.SIGTERM, signal.SIGINT)}
        try:
            self._loop.run_until_complete(self._server.listen_unix(Path(self._config.control_path)))
            self._realtime = prepare(self._config.priority)
            run_task(self._runner, self._loop, lambda: self._stopping)
        finally:
            self._loop.run_until_complete(self._close())
            self._loop.close()
            self._runner.close()
            self._acts.close()
            if self._alarm is not None:
                self._alarm.close()
            for number, handler in before.items():
                signal.signal(number, handler)
        error = self._runner.error
        return error.exit_code if error is not None and self._runner.stop_reason is not StopReason.REQUESTED else 0

    async def _close(self) -> None:
        await self._server.aclose()
        rest = asyncio.all_tasks() - {asyncio.current_task()}
        if rest:
            await asyncio.wait(rest, timeout=0.3)
        Path(self._config.control_path).unlink(missing_ok=True)

    def _on_signal(self, number: int, frame: object) -> None:
        self._stopping = True

    # -- commands ---------------------------------------------------------------------------------------------------

    async def _ready(self, args: dict[str, Any]) -> dict[str, Any]:
        return {"ready": True, "state": self._runner.status().state, "pid": os.getpid()}

    async def _stop(self, args: dict[str, Any]) -> dict[str, Any]:
        self._runner.stop()  # stop before the answer, because the client may rely on it
        self._loop.call_later(0.02, self._end)  # end after the answer, so that it is sent
        return {"state": self._runner.status().state}

    def _end(self) -> None:
        self._stopping = True
        self._loop.stop()

    async def _get(self, args: dict[str, Any]) -> PlcStatus:
        now_ns, runner = monotonic_ns(), self._runner
        is_brief, first = args.get("brief") is True, runner.entries[0].task
        with_buckets = not is_brief or args.get("buckets") is True
        brief = structs.replace(
            runner.status(),
            pid=os.getpid(),
            realtime=self._realtime.status(),
            acts=dict(self._acts.counts),
            debugger=self._debugging.status,
            programs={p.name: type(p.program).__name__ for p in runner.programs},
            changes=self._changing.status,
            duration_buckets=first.duration.buckets_us() if with_buckets else [],
            lateness_buckets=first.lateness.buckets_us() if with_buckets else [],
        )
        if is_brief:
            return brief
        outputs, hidden = runner.outputs.last(), runner.hidden_tags()
        return WholePlcStatus(
            **structs.asdict(brief),
            retained=runner.retained.values(),
            inputs={tag: value.describe(now_ns) for tag, value in runner.inputs().items() if tag not in hidden},
            outputs={tag: value for tag, value in outputs.items() if tag not in hidden},
            variables={f"{p.name}.{v.name}": outputs[tag] for p in runner.programs for v, tag in p.published()},
        )

    async def _tags(self, args: dict[str, Any]) -> dict[str, Any]:
        if "tags" not in args:
            return {"names": self._view.names(), "internal": self._view.internal_names()}
        names = args["tags"]
        if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
            raise UsageError("which tags", expected='a list such as ["ctd.pressure"]', got=repr(names))
        return {"tags": self._view.describe(names, monotonic_ns(), utc_ns())}

    def _note(self, action: str, args: dict[str, Any], **details: Any) -> None:
        self._acts.note(action, _by(args), utc_ns(), **details)

    async def _force(self, args: dict[str, Any]) -> dict[str, Any]:
        tag, value, by = _text(args, "tag"), args.get("value", ""), _by(args)
        try:
            self._runner.force(
                tag, value, by, record=lambda old, new: self._note("force", args, tag=tag, old=old, new=new)
            )
        except UsageError as e:
            with suppress(Unreachable):  # the action is refused, whether or not it could be recorded
                self._note("refuse", args, tag=tag, new=value, result=str(e))
            raise
        return {"forces": self._runner.forces.describe(monotonic_ns())}

    async def _unforce(self, args: dict[str, Any]) -> dict[str, Any]:
        forces = self._runner.forces
        there = forces.describe(monotonic_ns())
        tags = list(there) if args.get("all") is True else [_text(args, "tag")]
        for tag in tags:
            if tag not in there:
                raise UsageError(
                    f"{tag} is not forced", expected=", ".join(there) or "a forced tag, but no tag is forced"
                )
            self._note("unforce", args, tag=tag, old=there[tag]["value"], new=None)
            forces.unforce(tag)
        return {"removed": len(tags), "forces": forces.describe(monotonic_ns())}

    async def _pause(self, args: dict[str, Any]) -> dict[str, Any]:
        self._note("pause", args)
        self._runner.pause(True)
        return {"paused": True}

    async def _go(self, args: dict[str, Any]) -> dict[str, Any]:
        self._note("go", args)
        self._runner.pause(False)
        return {"paused": False}

    async def _step(self, args: dict[str, Any]) -> dict[str, Any]:
        count = args.get("count", 1)
        if type(count) is not int or not 1 <= count <= MAX_STEPS:
            raise UsageError("how many scans", expected=f"1 to {MAX_STEPS}", got=repr(count))
        self._runner.check_step()
        self._note("step", args, count=count)
        return {"steps": count, "scans": self._runner.step(count)}

    async def _why(self, args: dict[str, Any]) -> dict[str, Any]:
        tag = _text(args, "tag")
        return {"changes": self._runner.why(tag), "waits_for": self._runner.waits(tag)}

    async def _origin(self, args: dict[str, Any]) -> dict[str, Any]:
        value = args.get("value")
        program, place = self._runner.origin(_text(args, "tag"), value if isinstance(value, int | float) else None)
        return {"program": program, "place": place}

    async def _limits(self, args: dict[str, Any]) -> dict[str, Any]:
        tags = args.get("tags")
        if not isinstance(tags, dict) or not all(limits is None or _is_pair(limits) for limits in tags.values()):
            raise UsageError(
                "limits of tags", expected='{"ctd.period": [0, 60]}, or null for none', got=repr(tags)[:80]
            )
        self._runner.limit({str(tag): tuple(limits) if limits else None for tag, limits in tags.items()})
        return {"limited": len(tags)}

    async def _about(self, args: dict[str, Any]) -> dict[str, Any]:
        return {"programs": describe_programs(self._runner.programs, self._runner.sources)}

    async def _drawings(self, args: dict[str, Any]) -> dict[str, Any]:
        return {"drawings": drawings_of_programs(self._runner.programs)}

    async def _drawn(self, args: dict[str, Any]) -> dict[str, Any]:
        return present_values(self._runner.programs, args.get("program"), args.get("number"))

    async def _apply_change(self, args: dict[str, Any]) -> dict[str, Any]:
        done = await self._changing.apply(args)
        self._debugging.programs_changed()
        return done

    async def _restart(self, args: dict[str, Any]) -> dict[str, Any]:
        cold = args.get("cold") is True
        self._debugging.refuse_in_a_scan("a restart")
        self._note("restart", args, cold=cold)
        self._runner.restart(cold=cold)
        self._changing.forget()
        self._debugging.programs_changed()
        self._loop.call_soon(self._loop.stop)  # a wait that began while no task ran is too long now
        return {"start": self._runner.retained.start}


def _is_pair(limits: Any) -> bool:
    numbers = isinstance(limits, list) and len(limits) == 2 and all(type(n) in (int, float) for n in limits)
    return numbers and limits[0] <= limits[1]


def _by(args: dict[str, Any]) -> str:
    return str(args.get("by", ""))[:64]


def _text(args: dict[str, Any], name: str) -> str:
    value = args.get(name)
    if not isinstance(value, str) or not value:
        raise UsageError(f"{name} is missing", expected="the name of a tag")
    return value


def plc_main(config: PlcConfig) -> int:
    """Attach to the image, run until requested to stop, and return the exit code.

    Raises `FileInvalid` or `Unreachable` before the first scan."""
    try:
        fd = os.open(config.image_path, os.O_RDWR | os.O_CLOEXEC)
    except OSError as e:
        raise Unreachable(f"no process image: {e.strerror or e}", where=config.image_path) from e
    try:
        mapped = mmap.mmap(fd, 0)
    except (OSError, ValueError) as e:
        raise FileInvalid(f"not a process image: {e}", path=config.image_path) from e
    finally:
        os.close(fd)
    with mapped, memoryview(mapped) as memory, config.image_layout().attach(memory) as image:
        return PlcProcess(config, image).run()
