"""The pytest plugin: emulated devices, field simulators, programs and scenarios as fixtures; `*.scenario.yaml` files as tests.

pytest loads this module in every test run if fieldtwin is installed. So it imports only pytest until a test requests a
fixture, and then only `fieldtwin.testing`, neither pymodbus nor canopen. Emulated devices run in a separate process
(docs/how-to/pytest.md).
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterator
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

if TYPE_CHECKING:
    from fieldtwin.testing.handles import DeviceHandle, Plc, PrototypeHandle
    from fieldtwin.testing.outcome import ScenarioOutcome
    from fieldtwin.testing.results import Results
    from fieldtwin.testing.runner import WorkerProcess
    from fieldtwin.testing.running_plc import RunningPlc
    from fieldtwin.testing.scenario_file import ScenarioFile
    from fieldtwin.testing.wire import RecordedTraffic

MARKER = "fieldtwin"
_RUNNER: pytest.StashKey[WorkerProcess] = pytest.StashKey()
_RESULTS: pytest.StashKey[Results] = pytest.StashKey()
_WIRES: pytest.StashKey[list[RecordedTraffic]] = pytest.StashKey()
_OUTCOMES: pytest.StashKey[list[ScenarioOutcome]] = pytest.StashKey()
_SHOWN = 20


def pytest_addoption(parser: pytest.Parser) -> None:
    group = parser.getgroup("fieldtwin", "fieldtwin: emulated field devices")
    group.addoption(
        "--fieldtwin-command",
        default="",
        metavar="CMD",
        help="command that runs fieldtwin, such as /opt/fieldtwin/bin/fieldtwin; default: FIELDTWIN_COMMAND, else this Python",
    )
    group.addoption(
        "--fieldtwin-target", default="", metavar="TARGET", help="target on which scenarios run; default: virtual"
    )
    group.addoption("--fieldtwin-seed", type=int, default=None, metavar="N", help="seed for all scenarios and faults")
    group.addoption("--fieldtwin-trust", action="store_true", help="also run code from templates")
    group.addoption(
        "--fieldtwin-html",
        default="",
        metavar="FILE",
        help="write an HTML page with verdicts and the requirement matrix to this file",
    )
    parser.addini("fieldtwin_scenarios", "collect *.scenario.yaml as tests", type="bool", default=True)
    parser.addini("fieldtwin_profiles", "folders with devices/ and systems/", type="paths", default=[])


def pytest_configure(config: pytest.Config) -> None:
    config.addinivalue_line(
        "markers",
        "fieldtwin(device=, on=, unit=, values=, recording=, system=, plc=, ...): what the fixtures device, prototype and plc "
        "are (docs/reference/pytest-plugin.md)",
    )
    config.addinivalue_line("markers", "requirement(*ids): requirements that the test covers")
    # with xdist, the report is written once for all workers
    if config.getoption("--fieldtwin-html") and not hasattr(config, "workerinput"):
        from fieldtwin.testing.results import Results

        config.stash[_RESULTS] = Results(config)
        config.pluginmanager.register(config.stash[_RESULTS], "fieldtwin results")


def pytest_unconfigure(config: pytest.Config) -> None:
    runner = config.stash.get(_RUNNER, None)
    if runner is not None:
        runner.close()
        del config.stash[_RUNNER]


def pytest_collect_file(file_path: Path, parent: pytest.Collector) -> ScenarioFile | None:
    if file_path.suffix != ".yaml" or not parent.config.getini("fieldtwin_scenarios"):
        return None
    from fieldtwin.scenarios.language.file_name import SUFFIX

    if not file_path.name.endswith(SUFFIX):
        return None
    from fieldtwin.testing.scenario_file import ScenarioFile

    made: ScenarioFile = ScenarioFile.from_parent(parent, path=file_path)
    return made


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item: pytest.Item) -> None:
    """Add the requirements as properties of the test, because JUnit XML contains properties and xdist transfers them."""
    for marker in item.iter_markers("requirement"):
        for id in marker.args:
            note = ("requirement", str(id))
            if note not in item.user_properties:
                item.user_properties.append(note)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """Add the observed traffic to the report of a failed test."""
    report = yield
    if report.failed and report.when == "call" and (wires := item.stash.get(_WIRES, None)):
        from fieldtwin.testing.runner import FieldtwinRefused, FieldtwinUnavailable

        try:
            seen = [str(e) for wire in wires for e in wire.exchanges(strays=True)]
        except (FieldtwinRefused, FieldtwinUnavailable) as e:
            seen = [f"not available: {e}"]
        left_out = [f"({len(seen) - _SHOWN} before)"] if len(seen) > _SHOWN else []
        report.sections.append(("on the wire", "\n".join(left_out + seen[-_SHOWN:]) or "nothing"))
    if report.failed and report.when == "call":
        for outcome in item.stash.get(_OUTCOMES, []):
            if not outcome.passed:
                _add_to_text(report, f"scenario {outcome.name}", str(outcome))
    return report


def _add_to_text(report: pytest.TestReport, title: str, content: str) -> None:
    """Add a section to the text of a failure, which JUnit files also contain. If pytest has produced no text that takes
    sections, add the section to the report after the text.
    """
    add = getattr(report.longrepr, "addsection", None)
    if add is None:  # --tb=native, or a plugin with a different text
        report.sections.append((title, content))
    else:
        add(title, content)


# -- fixtures -----------------------------------------------------------------------------------------------------------


def _runner(config: pytest.Config) -> WorkerProcess:
    """Return the worker process, which is started when a test first needs it."""
    if _RUNNER not in config.stash:
        from fieldtwin.testing.runner import WorkerProcess, command_of

        config.stash[_RUNNER] = WorkerProcess(
            command_of(config.getoption("--fieldtwin-command")), trust=config.getoption("--fieldtwin-trust")
        )
    return config.stash[_RUNNER]


def _said(request: pytest.FixtureRequest) -> dict[str, Any]:
    """Return the arguments of the test's markers; markers of the test take precedence over those of its class and module."""
    said: dict[str, Any] = {}
    for marker in request.node.iter_markers(MARKER):
        for key, value in marker.kwargs.items():
            said.setdefault(key, value)
        if marker.args:
            pytest.fail(f"@pytest.mark.{MARKER} takes names: device=..., system=..., plc=...", pytrace=False)
    return said


def _or_fail(make: Callable[[], Any]) -> Any:
    """Return the result of `make`. If it fails, fail the test with the reason in one line."""
    from fieldtwin.testing.runner import FieldtwinRefused, FieldtwinUnavailable

    try:
        return make()
    except (FieldtwinRefused, FieldtwinUnavailable) as e:
        why = str(e)
    pytest.fail(
        f"fieldtwin: {why}", pytrace=False
    )  # raised outside of the exception handler, so that pytest does not show "during handling of"


@pytest.fixture
def emulate(request: pytest.FixtureRequest) -> Iterator[Callable[..., DeviceHandle]]:
    """A function that emulates devices: ``emulate("ctd-reference", on="tcp", unit=3)``. The devices end with the test."""
    runner, made = _runner(request.config), list[int]()

    def make(device: str, **more: Any) -> DeviceHandle:
        from fieldtwin.testing.handles import DeviceHandle

        said = {"seed": request.config.getoption("--fieldtwin-seed"), **_places(request), **more}
        answer = _or_fail(lambda: runner.call("device", device=device, **said))
        made.append(answer["id"])
        found = DeviceHandle(runner, answer["id"], "device", answer)
        request.node.stash.setdefault(_WIRES, []).append(found.wire)
        return found

    yield make
    for id in made:
        _or_fail(partial(runner.call, "end", id=id))


def _places(request: pytest.FixtureRequest) -> dict[str, Any]:
    profiles = [str(p) for p in request.config.getini("fieldtwin_profiles")]
    return {"beside": str(request.node.path.parent), "profiles": profiles}


@pytest.fixture
def device(request: pytest.FixtureRequest, emulate: Callable[..., DeviceHandle]) -> DeviceHandle:
    """The device that ``@pytest.mark.fieldtwin(device=...)`` names, on a separate bus."""
    said = {key: value for key, value in _said(request).items() if key not in ("system", "prototype", "listen", "plc")}
    if "device" not in said:
        pytest.fail('which device? @pytest.mark.fieldtwin(device="ctd-reference")', pytrace=False)
    return emulate(said.pop("device"), **said)


@pytest.fixture
def prototype(request: pytest.FixtureRequest) -> Iterator[PrototypeHandle]:
    """The simulated field devices of the system that ``@pytest.mark.fieldtwin(system=...)`` names; no gateway, no PLC."""
    from fieldtwin.testing.handles import PrototypeHandle

    said, runner = _said(request), _runner(request.config)
    if "system" not in said:
        pytest.fail('the system is missing: @pytest.mark.fieldtwin(system="observatory")', pytrace=False)
    keys = ("system", "prototype", "recordings", "speed", "listen", "seed")
    args = {"seed": request.config.getoption("--fieldtwin-seed"), **{key: said[key] for key in keys if key in said}}
    answer = _or_fail(lambda: runner.call("system", **_places(request), **args))
    made = PrototypeHandle(runner, answer)
    request.node.stash.setdefault(_WIRES, []).append(made.wire)
    yield made
    _or_fail(lambda: runner.call("end", id=answer["id"]))


@pytest.fixture
def wire(request: pytest.FixtureRequest) -> RecordedTraffic:
    """The recorded traffic on the bus of `device`, or on all buses of `prototype`."""
    if "system" in _said(request) or "prototype" in request.fixturenames:
        whole: PrototypeHandle = request.getfixturevalue("prototype")
        return whole.wire
    one: DeviceHandle = request.getfixturevalue("device")
    return one.wire


@pytest.fixture
def plc(request: pytest.FixtureRequest) -> Iterator[Plc | RunningPlc]:
    """The program that ``@pytest.mark.fieldtwin(plc=...)`` names: a source as in a system file, with a path relative to the
    test's folder; with ``system=``, a program of that system. Without ``plc=``, the gateway and PLC of `prototype`, as they
    run.
    """
    from fieldtwin.testing.handles import Plc
    from fieldtwin.testing.running_plc import RunningPlc

    said, runner = _said(request), _runner(request.config)
    if "plc" not in said and "system" in said:
        whole: PrototypeHandle = request.getfixturevalue("prototype")
        places = _places(request)
        yield _or_fail(lambda: RunningPlc(runner, whole.id, places["profiles"]))
        return  # gateway and PLC end together with the field simulator
    if "plc" not in said:
        pytest.fail(
            'the program is missing: @pytest.mark.fieldtwin(plc="pump.st"), or system="observatory"', pytrace=False
        )
    folders = (str(request.node.path.parent),)
    made: Plc = _or_fail(
        lambda: Plc(runner, said["plc"], folders, said.get("cycle_ms", 10.0), system=said.get("system", ""))
    )
    yield made
    _or_fail(lambda: runner.call("end", id=made.id))


@pytest.fixture
def scenario(request: pytest.FixtureRequest) -> Callable[..., ScenarioOutcome]:
    """A function that runs scenario files of the test's folder: ``assert scenario("pump.scenario.yaml", seed=3)``."""

    def run(path: str | Path, seed: int | None = None, target: str = "") -> ScenarioOutcome:
        from fieldtwin.testing.outcome import run_scenario

        config = request.config
        outcome = run_scenario(
            _runner(config).command,
            request.node.path.parent / path,
            seed=config.getoption("--fieldtwin-seed") if seed is None else seed,
            target=target or config.getoption("--fieldtwin-target"),
            profiles=[str(p) for p in config.getini("fieldtwin_profiles")],
            trust=config.getoption("--fieldtwin-trust"),
        )
        request.node.stash.setdefault(_OUTCOMES, []).append(outcome)
        return outcome

    return run
