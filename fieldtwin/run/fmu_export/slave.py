"""The part of an exported FMU that runs in the Python of the simulation tool.

`fieldtwin export fmu` copies this file into the FMU. It uses pythonfmu, which the FMU contains, and the standard library,
because the tool's Python may be an old one without fieldtwin. The prototype runs in a child process with the Python that has
fieldtwin, so that a crash, an endless loop and the replaced clocks of virtual time do not affect the tool.
"""

from __future__ import annotations

import ctypes
import json
import math
import os
import select
import subprocess
import weakref
from pathlib import Path
from typing import Any, NoReturn
from xml.etree.ElementTree import Element, SubElement

from pythonfmu import Boolean, Fmi2Causality, Fmi2Slave, Fmi2Variability, Integer, Real, String
from pythonfmu.enums import Fmi2Status

CHILD = "fieldtwin.run.fmu_export.child_process"
PYTHON = "FIELDTWIN_PYTHON"
"""The environment variable that replaces the Python of the export."""
HINT = f"set {PYTHON} to a Python that has fieldtwin"
START_LIMIT_S = 120.0
END_LIMIT_S = 30.0
STEP_LIMIT_S = 300.0
"""The real time in seconds that a step may take, unless the tool sets the parameter `step_limit`."""
MAX_ANSWER = 16 << 20
"""The largest answer of the child process, in bytes."""
TOLERANCE_S = 1e-6
"""The largest difference in seconds between the end of a step and the beginning of the next, for rounding in the tool."""
_KINDS = {"real": Real, "integer": Integer, "boolean": Boolean, "string": String}


class Failed(Exception):
    """Raised when the prototype cannot run on. pythonfmu returns the status fmi2Fatal and logs the text."""


class Child:
    """The child process. ``ask(request, limit_s)`` sends a request and returns the answer. Raises `Failed`."""

    def __init__(self, python: str, folder: Path) -> None:
        argv = [python, "-E", "-P", "-m", CHILD, str(folder)]  # -E: PYTHONHOME and PYTHONPATH are those of the tool
        environment = {name: value for name, value in os.environ.items() if name != "LD_PRELOAD"}
        try:
            self._process = subprocess.Popen(
                argv,
                bufsize=0,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
                env=environment,
                start_new_session=True,  # Ctrl-C reaches the tool, which ends the FMU
            )
        except OSError as e:
            text = f"the Python of fieldtwin cannot be started: {python}: {e.strerror}; {HINT}"
            raise Failed(text) from e
        self._python = python
        self._rest = b""

    def ask(self, request: dict[str, Any], limit_s: float, doing: str) -> dict[str, Any]:
        """Return the answer to a request. `doing` says in errors what the prototype was asked to do."""
        assert self._process.stdin is not None
        try:
            self._process.stdin.write(json.dumps(request).encode() + b"\n")
        except OSError:
            raise Failed(self._ended(doing)) from None
        answer = json.loads(self._line(limit_s, doing))
        if answer.get("error"):
            raise Failed(f"{doing} failed: {answer['error']}")
        return answer  # type: ignore[no-any-return]

    def close(self) -> None:
        """End the process. It may be called several times."""
        for stream in (self._process.stdin, self._process.stdout):
            if stream is not None:
                stream.close()
        self._process.kill()
        self._process.wait()

    def _line(self, limit_s: float, doing: str) -> bytes:
        assert self._process.stdout is not None
        end = self._process.stdout.fileno()
        while b"\n" not in self._rest:
            if not select.select([end], [], [], limit_s)[0]:
                raise Failed(f"{doing} took more than {limit_s:g} s of real time (parameter step_limit)")
            data = os.read(end, 1 << 16)
            if not data or len(self._rest) > MAX_ANSWER:
                raise Failed(self._ended(doing))
            self._rest += data
        line, _, self._rest = self._rest.partition(b"\n")
        return line

    def _ended(self, doing: str) -> str:
        try:
            code = str(self._process.wait(END_LIMIT_S))
        except subprocess.TimeoutExpired:
            code = "none"
        text = f"the process of fieldtwin has ended during {doing}, exit code {code}"
        return f"{text}; try: {self._python} -m fieldtwin --version; {HINT}"


class ExportedSystem(Fmi2Slave):  # type: ignore[misc]
    """The FMU. Its inputs set what devices hold, its outputs are tags and variables, each with a variable NAME.good."""

    def __init__(self, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self._folder = Path(self.resources)
        said = self._said = json.loads((self._folder / "interface.json").read_text(encoding="utf-8"))
        self.modelName = said["identifier"]
        self.guid = said["guid"]
        self.description = said["text"]
        self.version = said["version"]
        self._ports = said["interface"]["outputs"]
        self._parameters = {"seed": said["seed"], "trace": "", "step_limit": STEP_LIMIT_S}
        self._inputs: dict[str, Any] = {}
        self._set: set[str] = set()  # the inputs that the tool has set; the others keep the device's own value
        self._sent: dict[str, Any] = {}
        self._outputs = [_of_kind(port["kind"], 0) for port in self._ports]
        self._good = [False] * len(self._ports)
        self._units: dict[str, str] = {}
        self._start_s = self._end_s = 0.0
        self._child: Child | None = None
        self._declare()

    def _declare(self) -> None:
        # The variables must not keep this object alive: pythonfmu resets an FMU by dropping it, and that ends the child process.
        me = weakref.proxy(self)
        self._add({"name": "seed", "kind": "integer", "text": "the same seed gives the same run"}, me._parameters)
        self._add({"name": "trace", "kind": "string", "text": "a file for every event, or empty"}, me._parameters)
        limit = {"name": "step_limit", "kind": "real", "text": "the longest real time of a step", "unit": "s"}
        self._add(limit, me._parameters)
        for port in self._said["interface"]["inputs"]:
            self._inputs[port["name"]] = _of_kind(port["kind"], port["start"])
            self._add(port, self._inputs, Fmi2Causality.input)
        for place, port in enumerate(self._ports):
            self._add_output(port, lambda place=place: me._outputs[place])
            text = "the value is good; otherwise it is the last good one"
            good = {"name": port["name"] + ".good", "kind": "boolean", "text": text}
            self._add_output(good, lambda place=place: me._good[place])

    def _add(self, port: dict[str, Any], values: dict[str, Any], causality: Any = Fmi2Causality.parameter) -> None:
        me = weakref.proxy(self)
        name, is_input, were_set = port["name"], causality is Fmi2Causality.input, self._set

        def put(value: Any) -> None:
            if isinstance(value, float) and not math.isfinite(value):
                me._fail(f"the value of {name} is {value!r}, which is not a number")
            values[name] = value
            were_set.add(name)

        changes = Fmi2Variability.continuous if port["kind"] == "real" else Fmi2Variability.discrete
        self._register(port, causality, changes if is_input else Fmi2Variability.fixed, lambda: values[name], put)

    def _add_output(self, port: dict[str, Any], getter: Any) -> None:
        me = weakref.proxy(self)

        def refuse(value: Any) -> None:
            me._fail(f"{port['name']} is an output")

        self._register(port, Fmi2Causality.output, Fmi2Variability.discrete, getter, refuse)

    def _register(self, port: dict[str, Any], causality: Any, variability: Any, getter: Any, setter: Any) -> None:
        variable = _KINDS[port["kind"]](
            port["name"],
            causality=causality,
            variability=variability,
            description=port["text"],
            getter=getter,
            setter=setter,
        )
        if port["kind"] == "real" and port.get("unit"):
            self._units[port["name"]] = port["unit"]
        self.register_variable(variable, nested=False)

    def to_xml(self, model_options: dict[str, str] = {}) -> Element:  # noqa: B006 - as pythonfmu declares it
        """Return the model description of pythonfmu with units, and without the time of its generation."""
        root: Element = super().to_xml(model_options)
        root.attrib.pop("generationDateAndTime", None)
        if self._units:
            units = Element("UnitDefinitions")
            for unit in sorted(set(self._units.values())):
                SubElement(units, "Unit", {"name": unit})
            root.insert(1, units)
        for variable in root.iter("ScalarVariable"):
            unit_of = self._units.get(variable.attrib["name"])
            if unit_of:
                variable[0].set("unit", unit_of)
        outputs, structure = root.find("ModelStructure/Outputs"), root.find("ModelStructure")
        if outputs is not None and structure is not None:  # FMI 2.0.4, 2.2.8: outputs without an exact start value
            initial = SubElement(structure, "InitialUnknowns")
            initial.extend(list(outputs))
        return root

    def setup_experiment(self, start_time: float, stop_time: Any, tolerance: Any) -> None:
        self._start_s = start_time

    def exit_initialization_mode(self) -> None:
        python = os.environ.get(PYTHON) or self._said["python"]
        try:
            self._child = Child(python, self._folder)
        except Failed as e:
            self._fail(str(e))
        weakref.finalize(self, self._child.close)
        begin = {"seed": self._parameters["seed"], "trace": self._parameters["trace"]}
        answer = self._ask(begin, START_LIMIT_S, "the start of the prototype")
        if answer["version"] != self._said["version"]:
            text = f"the FMU was exported by fieldtwin {self._said['version']} and runs with {answer['version']}"
            self.log(f"{text}, so its results may differ", Fmi2Status.warning)
        self._end_s = self._start_s
        self._take(answer)

    def do_step(self, current_time: float, step_size: float) -> bool:
        if abs(current_time - self._end_s) > TOLERANCE_S or step_size < 0:
            text = f"a step of {step_size!r} s at {current_time!r} s is impossible"
            self._fail(f"{text}: the last step ended at {self._end_s!r} s, and steps cannot be repeated")
        end_s = current_time + step_size
        given = {name: value for name, value in self._inputs.items() if name in self._set}
        news = {name: value for name, value in given.items() if name not in self._sent or value != self._sent[name]}
        request = {
            "until_ns": round((end_s - self._start_s) * 1e9),
            "set": {name: float(value) for name, value in news.items()},
        }
        self._take(self._ask(request, self._parameters["step_limit"], f"the step to {end_s:.9g} s"))
        self._sent.update(news)
        self._end_s = end_s
        return True

    def terminate(self) -> None:
        if self._child is not None:
            answer = self._ask({"end": True}, self._parameters["step_limit"], "the end of the run")
            self.log(answer["result"], Fmi2Status.ok)
            self._close()

    def _take(self, answer: dict[str, Any]) -> None:
        self._good = answer["good"]
        for place, value in enumerate(answer["values"]):
            if value is not None:
                self._outputs[place] = _of_kind(self._ports[place]["kind"], value)

    def _ask(self, request: dict[str, Any], limit_s: float, doing: str) -> dict[str, Any]:
        if self._child is None:
            self._fail(f"{doing}: the prototype does not run")
        try:
            return self._child.ask(request, limit_s, doing)
        except Failed as e:
            self._fail(str(e))

    def _fail(self, text: str) -> NoReturn:
        """End the child process and raise `Failed`, which gives the status fmi2Fatal.

        With the other status that pythonfmu has, fmi2Discard, some tools try the same step again without end.
        """
        self._close()
        # pythonfmu 0.7 releases these three objects after an exception, and again when the instance is freed, which crashes
        # the tool.
        for twice in (type(self), self, self.log_queue):
            ctypes.pythonapi.Py_IncRef(ctypes.py_object(twice))
        raise Failed(text)

    def _close(self) -> None:
        if self._child is not None:
            self._child.close()
            self._child = None


def _of_kind(kind: str, value: Any) -> Any:
    """Return a value in the Python type of a kind of variable. The number 0 is the empty text."""
    if kind == "string":
        return str(value) if value else ""
    return {"real": float, "integer": int, "boolean": bool}[kind](value)
