"""Every command that would run code of an untrusted template, or open a resource named by its prototype, asks first; in one
place."""

from __future__ import annotations

import asyncio
import json
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from click.testing import CliRunner, Result
from template_rig import own_system, packed, with_python

from fieldtwin.cli.main import cli
from fieldtwin.gateway.core.errors import NotAllowed
from fieldtwin.run.targets.template_scenarios import agree_to_scenario
from fieldtwin.run.template import ForeignParts, agree, system_file
from fieldtwin.testing.worker.host import Host
from fieldtwin.twin.site.system import load_system
from fieldtwin.twin.template.package import open_package, unpack

CODE = ("systems/helper.py", "systems/site_logic.py")
SCENARIO = "scenario: the tilt\nsystem: SYSTEM\nsteps:\n  - pause: 1s\n"


class Site:
    """An unpacked untrusted template: its control logic leaves a mark, and its prototype would open the plant's bus."""

    def __init__(self, folder: Path) -> None:
        own = own_system(folder / "site")
        self.mark = folder / "it ran"
        with_python(own, self.mark)
        prototype = own.with_name("dam.prototype.yaml")
        prototype.write_text(prototype.read_text().replace("can:fieldtwin/127.0.0.1:0", "can:socketcan/can0"))
        packed(own, folder / "T.zip")
        self.zip, self.folder = folder / "T.zip", folder / "T"
        with open_package(self.zip) as package:
            unpack(package, self.folder)
        self.system = self.folder / "systems" / "dam.yaml"
        self.inside = self.folder / "systems" / "tilt.scenario.yaml"
        self.outside = folder / "tilt.scenario.yaml"
        self.outside.write_text(SCENARIO.replace("SYSTEM", str(self.system)))
        self.network = folder / "sea.yaml"

    def ran(self) -> bool:
        return self.mark.exists() or any(name in sys.modules for name in ("helper", "site_logic"))


@pytest.fixture
def site(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Site]:
    monkeypatch.setenv("FIELDTWIN_RUN", str(tmp_path / "run"))
    monkeypatch.chdir(tmp_path)
    yield Site(tmp_path)
    for name in ("helper", "site_logic", "site_logic_proof"):
        sys.modules.pop(name, None)


def fieldtwin(*words: object) -> Result:
    """Our command line, without a user at a terminal."""
    return CliRunner().invoke(cli, [str(word) for word in words], standalone_mode=False)


COMMANDS = {
    "run --prototype": ("run", "X", "--prototype"),
    "simulate": ("simulate", "X", "--for", "1s"),
    "run --plant": ("run", "X", "--plant"),
    "emulate": ("emulate", "X"),
    "with": ("with", "X", "--", "true"),
    "plc prove": ("plc", "prove", "X"),
    "plc diagram": ("plc", "diagram", "X"),
    "trace --vcd": ("trace", "x.jsonl", "X", "--vcd", "x.vcd"),
    "twin --plan": ("twin", "X", "--from", "tcp://127.0.0.1:1", "--plan", "python: site_logic:Blinker"),
    "twin --what-if": (
        "twin",
        "X",
        "--from",
        "tcp://127.0.0.1:1",
        "--what-if",
        "1min",
        "--require",
        "tilt.slope_long < 9",
    ),
    "what-if": ("what-if", "X", "--horizon", "1min"),
}
OPENS_NOTHING = {
    "simulate",
    "run --plant",
    "plc prove",
    "plc diagram",
    "trace --vcd",
    "what-if",
    "twin --plan",
    "twin --what-if",
}


@pytest.mark.parametrize("form", ["a file inside", "a folder", "a zip"])
@pytest.mark.parametrize("command", list(COMMANDS))
def test_every_command_asks_before_anything_of_a_template_is_run_or_opened(site: Site, command: str, form: str) -> None:
    named = {"a file inside": site.system, "a folder": site.folder, "a zip": site.zip}[form]
    done = fieldtwin(*(named if word == "X" else word for word in COMMANDS[command]))
    assert isinstance(done.exception, NotAllowed), (done.output, done.exception)
    assert "nothing of this template was run" in str(done.exception)
    assert ", ".join(CODE) in done.stderr.replace("\n", " ")
    assert ("it sends on can:socketcan/can0" in done.stderr) is (command not in OPENS_NOTHING)
    assert not site.ran()


@pytest.mark.parametrize("target", ["virtual", "local", "compose", "real"])
@pytest.mark.parametrize("where", ["inside", "outside"])
def test_a_scenario_of_a_template_is_asked_about_wherever_it_lies(site: Site, where: str, target: str) -> None:
    """Reading it would already import its system's programs."""
    site.inside.write_text(SCENARIO.replace("SYSTEM", "dam.yaml"))
    done = fieldtwin("test", getattr(site, where), "--target", target)
    assert isinstance(done.exception, NotAllowed), (done.output, done.exception)
    assert ("it sends on can:socketcan/can0" in done.stderr) is (target in ("local", "compose"))
    assert not site.ran()


def test_a_probe_of_an_untrusted_scenario_is_named(site: Site) -> None:
    probe = "probes:\n  crane: {endpoint: 'tcp://192.0.2.7:502', unit: 1, registers: {height: {at: 30001}}}\n"
    site.inside.write_text(SCENARIO.replace("SYSTEM", "observatory") + probe)
    told: list[ForeignParts] = []

    def asked(template: ForeignParts) -> bool:
        told.append(template)
        return True

    agree_to_scenario(asked, site.inside)
    assert told.pop().reach[-1] == "it asks tcp://192.0.2.7:502 (probe crane)"
    agree_to_scenario(asked, site.inside, virtual=True)
    assert told.pop().reach == ()
    site.outside.write_text(site.inside.read_text())
    agree_to_scenario(asked, site.outside)
    assert not told, "one's own"


def test_a_yes_beforehand_lets_each_of_them_run(site: Site) -> None:
    prototype = site.system.with_name("dam.prototype.yaml")
    prototype.write_text(prototype.read_text().replace("can:socketcan/can0", "can:fieldtwin/127.0.0.1:0"))
    assert fieldtwin("simulate", site.system, "--for", "1s", "--trust").exit_code == 0
    assert site.ran()
    assert fieldtwin("test", site.outside, "--trust").exit_code == 0
    unproved = fieldtwin("plc", "prove", site.system, "--trust")
    assert "no program has a proof" in str(unproved.exception), "it was looked for"


def test_a_network_with_an_untrusted_system_is_asked_about(site: Site) -> None:
    observatory = load_system("observatory")
    packed(observatory.path, site.folder.with_name("O"))
    site.network.write_text(
        "fieldtwin: 1\nnetwork: sea\nwater: {range_m: 5000}\nsystems:\n"
        + "".join(
            f"  {name}: {{system: O/systems/observatory.yaml, modem: modem, at_m: [{at_m}, 0]}}\n"
            for name, at_m in (("a", 0), ("b", 9000))
        )
    )
    assert fieldtwin("simulate", site.network, "--for", "1s").exit_code in (0, 1), "it keeps to itself"
    (site.folder.with_name("O") / "systems" / "evil.py").write_text("")
    done = fieldtwin("simulate", site.network, "--for", "1s")
    assert isinstance(done.exception, NotAllowed), done.exception
    assert "systems/evil.py" in done.stderr


def test_nested_searched_and_prototype_only_files_are_untrusted_too(site: Site, tmp_path: Path) -> None:
    told: list[ForeignParts] = []

    def asked(template: ForeignParts) -> bool:
        told.append(template)
        return False

    deeper = site.folder / "systems" / "more" / "below" / "dam.yaml"
    deeper.parent.mkdir(parents=True)
    deeper.write_text(site.system.read_text().replace("../devices", "../../../devices"))
    for name in (str(deeper), "dam"):
        with pytest.raises(NotAllowed):
            system_file(name, asked, virtual=True, profiles=[site.folder])
        assert told.pop().code[:2] == CODE
    own = tmp_path / "site" / "plant" / "dam.yaml"
    assert system_file(str(own), asked) == str(own)
    with pytest.raises(NotAllowed):
        system_file(str(own), asked, prototype_file=site.system.with_name("dam.prototype.yaml"))
    assert told.pop().reach == ("it sends on can:socketcan/can0, an interface of this computer (bus can0)",)


def test_code_from_elsewhere_that_an_unpacked_template_names_is_asked_about(site: Site, tmp_path: Path) -> None:
    """No packed file does so; a file changed since then may."""
    for name in CODE:
        (site.folder / name).unlink()
    told: list[ForeignParts] = []

    def asked(template: ForeignParts) -> bool:
        told.append(template)
        return False

    with pytest.raises(NotAllowed):
        agree(asked, site.system, [(load_system(str(site.system)), None)], virtual=True)
    assert told.pop().code == ("the module site_logic",)
    (tmp_path / "hill.py").write_text("")
    prototype = site.system.with_name("dam.prototype.yaml")
    text = prototype.read_text().replace("{recording: ../systems/tilt.jsonl, at_end: loop}", "{simulation: hill}")
    text = text.replace("{recording: tilt.jsonl, at_end: loop}", "{simulation: hill}")
    prototype.write_text(text + "simulations: {hill: {python: '../../hill.py:Hill'}}\n")
    with pytest.raises(NotAllowed):
        agree(asked, site.system, [(load_system(str(site.system)), None)], virtual=True)
    assert told.pop().code == ("the module site_logic", str(tmp_path / "hill.py"))


def test_commands_that_run_and_open_nothing_do_not_ask(site: Site) -> None:
    drawn = fieldtwin("draw", site.zip, "--prototype", "--json")
    assert drawn.exit_code == 0, drawn.exception
    assert json.loads(drawn.stdout)
    shadow = fieldtwin("shadow", site.zip, "--from", "tcp://127.0.0.1:1", "--for", "0.1s")
    assert "the plant's thread" in str(shadow.exception)
    assert not site.ran()


@pytest.mark.parametrize("command", ["system", "program"])
def test_a_test_run_has_no_user_to_ask_and_needs_an_option(site: Site, command: str) -> None:
    args = {"system": str(site.system), "source": "count", "folders": [str(site.system.parent)]}
    with pytest.raises(NotAllowed, match="nothing of this template was run"):
        asyncio.run(Host().commands()[command](args))
    assert not site.ran()
    if command == "program":
        answer = asyncio.run(Host(trust=True).commands()[command](args))
        assert answer["id"] == 1
