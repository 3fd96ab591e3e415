"""The objects that fixtures return: a device, a field simulator (prototype), a stepped program.

The objects themselves are in the worker process (`fieldtwin.testing.runner`). This module imports only the standard library.
"""

from __future__ import annotations

from contextlib import AbstractContextManager
from typing import Any

from fieldtwin.testing.runner import FieldtwinRefused, WorkerProcess
from fieldtwin.testing.wire import RecordedTraffic


class EndpointHandle:
    """The address of a device or bus.

    It has `url`, and where they apply `path` (serial port), `host` and `port`, `interface` and `channel` (python-can),
    `baudrate` and `frame`. A virtual serial port has no parity: some libraries must be configured with 8N1.
    """

    def __init__(self, words: dict[str, Any]) -> None:
        self.url: str = words["url"]
        self._words = words

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_"):
            raise AttributeError(name)
        __tracebackhide__ = True
        try:
            return self._words[name]
        except KeyError:
            there = ", ".join(self._words)
            raise AttributeError(f"{self.url} has no {name}; it has {there}") from None

    def __repr__(self) -> str:
        return f"<{self.url}>"


class DeviceHandle:
    """An emulated device.

    `endpoint` is its address, whose parts are attributes of the device as well: `device.path`, `device.port`; `unit` is
    its unit ID or node ID.
    """

    def __init__(self, runner: WorkerProcess, bench: int, name: str, description: dict[str, Any]) -> None:
        facts = description["devices"][name]
        self.name = name
        self.unit: int = facts["unit"]
        self.node: int = facts["unit"]
        self.profile: str = facts["profile"]
        self.tags: tuple[str, ...] = tuple(facts["tags"])
        self.endpoint = EndpointHandle(description["buses"][facts["bus"]])
        far = description["far"].get(name)
        self.far = EndpointHandle(far) if far else None
        """The remote end of a transmitter's link."""
        self.wire = RecordedTraffic(runner, bench, name)
        self._runner = runner
        self._bench = bench

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_") or name == "endpoint":
            raise AttributeError(name)
        return getattr(self.endpoint, name)

    def set(self, tag: str, value: float | str | bool | None) -> None:
        """Set `tag` in the device to `value`, in engineering units, instead of its recorded or simulated values; None restores
        these.
        """
        __tracebackhide__ = True
        self._runner.call("set", id=self._bench, device=self.name, tag=tag, value=value)

    def held(self, tag: str) -> Any:
        """Return the device's value in engineering units, including one that a driver has written.

        For a device that samples or replays a recording, this is its latest value. None: it has no value yet.
        """
        __tracebackhide__ = True
        return self._runner.call("held", id=self._bench, device=self.name, tag=tag)

    def fault(self, name: str, **more: Any) -> AbstractContextManager[str]:
        """Inject a fault: ``with device.fault("silence"):``; see `RecordedTraffic.fault`."""
        return self.wire.fault(name, **more)

    def __repr__(self) -> str:
        return f"<{self.name}: {self.profile} at {self.endpoint.url}, unit {self.unit}>"


class PrototypeHandle:
    """The field simulator of a system. ``prototype["ctd"]`` is a `DeviceHandle`; `buses` holds the
    endpoints of the buses, `far` those of the remote ends of transmitters' links.
    """

    def __init__(self, runner: WorkerProcess, description: dict[str, Any]) -> None:
        self.id: int = description["id"]
        self.system: str = description["system"]
        self.file: str = description["file"]
        self.buses = {name: EndpointHandle(words) for name, words in description["buses"].items()}
        self.far = {name: EndpointHandle(words) for name, words in description["far"].items()}
        self.wire = RecordedTraffic(runner, description["id"])
        self._devices = {
            name: DeviceHandle(runner, description["id"], name, description) for name in description["devices"]
        }

    def __getitem__(self, name: str) -> DeviceHandle:
        """Return a device by its name in the system file."""
        __tracebackhide__ = True
        try:
            return self._devices[name]
        except KeyError:
            raise KeyError(f"no emulated device {name!r}; there are {', '.join(self._devices)}") from None

    def __iter__(self) -> Any:
        return iter(self._devices)

    def __len__(self) -> int:
        return len(self._devices)

    def fault(self, name: str, **more: Any) -> AbstractContextManager[str]:
        """Inject a fault: ``with prototype.fault("silence", device="ctd"):``; see `RecordedTraffic.fault`."""
        return self.wire.fault(name, **more)


class Plc:
    """A PLC program that is stepped. It has its own time: 10 s of program time take milliseconds.

    ``plc.set(level=10.0)`` sets inputs (None: bad), ``plc.scan()`` runs one scan, ``plc.run(2.5)`` runs scans for 2.5
    seconds; ``plc["valve"]`` is a variable after the last scan, for a message output the list of sent messages.
    """

    def __init__(
        self,
        runner: WorkerProcess,
        source: str,
        folders: tuple[str, ...] = (),
        cycle_ms: float = 10.0,
        *,
        system: str = "",
    ) -> None:
        """Load a program.

        `source` is as in a system file, searched in `folders`; with `system`, it names one of its programs.
        """
        answer = runner.call("program", source=source, folders=list(folders), cycle_ms=cycle_ms, system=system)
        self.id: int = answer["id"]
        self.values: dict[str, Any] = answer["values"]
        self.scans = 0
        self.t_s = 0.0
        self._runner = runner

    def set(self, quality: str = "good", **inputs: Any) -> Plc:
        """Set inputs from the next scan on; they keep their values, except messages, which are present for one scan."""
        __tracebackhide__ = True
        self._runner.call("input", id=self.id, values=inputs, quality=quality)
        return self

    def scan(self, scans: int = 1) -> Plc:
        """Run `scans` scans."""
        __tracebackhide__ = True
        return self._took(self._runner.call("scan", id=self.id, scans=scans))

    def run(self, seconds: float) -> Plc:
        """Run the number of scans that take `seconds` at the program's cycle."""
        __tracebackhide__ = True
        return self._took(self._runner.call("scan", id=self.id, seconds=seconds))

    def _took(self, answer: dict[str, Any]) -> Plc:
        self.values, self.scans, self.t_s = answer["values"], answer["scans"], answer["t_s"]
        return self

    def __getitem__(self, name: str) -> Any:
        __tracebackhide__ = True
        try:
            return self.values[name]
        except KeyError:
            raise KeyError(f"no variable {name!r}; there are {', '.join(self.values)}") from None


__all__ = ["DeviceHandle", "EndpointHandle", "FieldtwinRefused", "Plc", "PrototypeHandle"]
