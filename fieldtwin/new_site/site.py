"""Make the files of a new site from the user's choices and the templates in the folder ``templates``.

`site_files` returns the text of all files and writes none of them.
"""

from __future__ import annotations

import json
import re
from dataclasses import dataclass
from functools import cache
from typing import Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined

from fieldtwin import installation
from fieldtwin.__about__ import __version__
from fieldtwin.emulators.models.modbus.sampled_sensor import sampled_tags
from fieldtwin.gateway.core.errors import UsageError
from fieldtwin.gateway.core.files.profile import Tag
from fieldtwin.new_site.devices import TEMPLATES, SiteBus, SiteDevice
from fieldtwin.new_site.limits import Limits, Output
from fieldtwin.new_site.served import ServedValue, served_values
from fieldtwin.new_site.wishes import Ci, Control, Wishes
from fieldtwin.site.schemas import SCHEMAS, shipped

SCHEMA_FOLDER = ".fieldtwin"
"""The folder of the JSON schemas in a site. The first line of each YAML file names one of them."""
_CI_FILES = {
    Ci.GITHUB: ("github.yml.j2", ".github/workflows/fieldtwin.yml"),
    Ci.GITLAB: ("gitlab.yml.j2", ".gitlab-ci.yml"),
}
_HEADER = "# yaml-language-server: $schema="


@dataclass(frozen=True, slots=True)
class ProgramFile:
    """The program of a new site: its file, its template, and its source as the system file names it."""

    file: str
    template: str
    source: str


class DeviceView:
    """The properties of a device that the templates use; some depend on whether a program controls the device."""

    def __init__(self, device: SiteDevice, controlled: bool) -> None:
        self.name, self.reference, self.bus, self.address = device.name, device.reference, device.bus, device.address
        self.is_canopen, self.is_example = device.is_canopen, device.is_example
        self.polled, self.in_tpdo = device.polled, device.in_tpdo
        self._device = device
        self._controlled = controlled

    @property
    def watched(self) -> Tag | None:
        return self._device.watched

    @property
    def limits(self) -> Limits | None:
        return self._device.limits

    @property
    def output(self) -> Output | None:
        return self._device.output if self._controlled else None

    def served(self, place: int) -> list[ServedValue]:
        """Return the values of device number `place` that an HMI reads: with a program the supervised one, else all polled."""
        if self._controlled:
            return served_values([self._number], place)
        return served_values((t for t in self._device.profile.tags.values() if t.poll in self.polled), place)

    @property
    def sampling(self) -> bool:
        return self.output is not None and self.output.samples

    @property
    def switching(self) -> bool:
        return self.output is not None and not self.output.samples

    @property
    def tag(self) -> str:
        return f"{self.name}.{self._number.name}"

    @property
    def _number(self) -> Tag:
        assert self.watched is not None  # templates use this property of supervised devices only
        return self.watched

    @property
    def variable(self) -> str:
        """Return the program's variable of the supervised value. Structured Text allows no two underscores in a row."""
        return _identifier(f"{self.name}_{self._number.name}")

    @property
    def kind(self) -> str:
        return "BOOL" if self._number.type == "bool" else "REAL"

    @property
    def output_variable(self) -> str:
        assert self.output is not None
        return _identifier(f"{self.name}_{self.output.tag.name}")

    @property
    def output_kind(self) -> str:
        assert self.output is not None
        return "INT" if self.output.tag.is_integer else "REAL"

    @property
    def on_above(self) -> float:
        assert self.limits is not None
        return (self.limits.usual + self.limits.high) / 2

    @property
    def off_below(self) -> float:
        assert self.limits is not None
        return (self.limits.usual + self.limits.low) / 2

    @property
    def writable(self) -> list[str]:
        """Return the tags that the gateway may write: the output, the trigger of a measurement, and mailboxes."""
        profile = self._device.profile
        trigger = [profile.form.trigger.tag] if profile.form.trigger is not None else []
        return trigger + ([self.output.tag.name] if self.output is not None else [])

    @property
    def is_simulated(self) -> bool:
        """Return whether a formula in the prototype file computes the supervised value. No formula computes a value with named
        states, a bit, or a value whose scale factor is in a separate register."""
        tag, profile = self.watched, self._device.profile
        return (
            tag is not None and not tag.values and tag.type != "bool" and tag.scale_by is None and profile.inbox is None
        )

    @property
    def silence(self) -> str:
        """Return the name of the fault that makes the device stop answering."""
        return "lost-frame" if self.is_canopen else "silence"

    @property
    def formulas(self) -> dict[str, str]:
        """Return, by tag, a formula for the supervised value, and for every other value that the device samples."""
        assert self.limits is not None
        swing = (self.limits.high - self.limits.usual) / 5
        usual = number(self.limits.usual)
        formulas = {self._number.name: f"sine({usual}, {number(round(swing, 6))}, 60)" if swing else usual}
        if self._device.profile.sampled is not None:
            others = sampled_tags(self._device.profile, ())
            formulas |= {tag.name: "10" for tag in others if tag.name not in formulas}
        return formulas

    @property
    def emulated(self) -> str:
        """Return the device's entry in the prototype file, as YAML."""
        if self._device.profile.inbox is not None:
            return '{model: mailbox, far: "tcp://127.0.0.1:0"}'
        source = f"simulation: {self.name}" if self.is_simulated else "model: profile"
        values = self._values()
        return f"{{{source}, values: {{{values}}}}}" if values else f"{{{source}}}"

    def _values(self) -> str:
        """Return the initial values of the registers that no formula computes, as YAML."""
        found = []
        sampled = self._device.profile.sampled
        if sampled is not None and not self._controlled:
            found.append(f"{sampled.period}: 1")
        if not self.is_simulated and not self.is_canopen and self.watched is not None and self.limits is not None:
            found.append(f"{self.watched.name}: {number(self.limits.usual)}")
        return ", ".join(found)


def site_files(wishes: Wishes, devices: list[SiteDevice]) -> dict[str, str]:
    """Return the text of every file of the new site by its path in the folder, those that the user should read first at the
    beginning.
    """
    program = _program(wishes)
    views = [DeviceView(device, program is not None) for device in devices]
    files: dict[str, tuple[str, str]] = {
        f"{wishes.system}.yaml": ("system.yaml.j2", "the system: buses, devices" + (", program" if program else "")),
        f"{wishes.system}.prototype.yaml": ("prototype.yaml.j2", "the simulated devices (digital twin prototype)"),
        "silence.scenario.yaml": ("silence.scenario.yaml.j2", "a test: each device falls silent and returns"),
    }
    if program is not None:
        files["limits.scenario.yaml"] = ("limits.scenario.yaml.j2", "a test: each value leaves its limits and returns")
        files[program.file] = (program.template, "the program")
    if wishes.compose:
        files["compose.yaml"] = ("compose.yaml.j2", "the simulation in containers")
    if wishes.ci in _CI_FILES:
        template, path = _CI_FILES[wishes.ci]
        files[path] = (template, "checks and tests after each change")
    context = _context(wishes, views, program)
    copied = {f"profiles/{name}": text for device in devices for name, text in device.files.items()}
    shown = [(path, about) for path, (_, about) in files.items()]
    shown += [(path, "the registers or objects of a device, from its manual") for path in copied]
    shown.append((f"{SCHEMA_FOLDER}/", "JSON schemas, with which an editor completes keys and marks errors"))
    texts = {path: _render(template, context) for path, (template, _) in files.items()}
    texts["README.md"] = _render("README.md.j2", context | {"files": shown})
    texts[".gitignore"] = "out/\n__pycache__/\n"
    texts |= {path: _with_header(path, text) for path, text in copied.items()}
    return texts | {f"{SCHEMA_FOLDER}/{shipped(kind).name}": shipped(kind).read_text("utf-8") for kind in SCHEMAS}


def _program(wishes: Wishes) -> ProgramFile | None:
    if wishes.control is Control.PYTHON:
        module = f"{wishes.system}_control"
        return ProgramFile(f"{module}.py", "control.py.j2", f"python: {module}:Control")
    if wishes.control is Control.ST:
        return ProgramFile(f"{wishes.system}.st", "control.st.j2", f"{wishes.system}.st")
    return None


def _context(wishes: Wishes, views: list[DeviceView], program: ProgramFile | None) -> dict[str, Any]:
    supervised = [view for view in views if view.watched is not None]
    _refuse_equal_variables(supervised)
    buses: dict[str, SiteBus] = {view.bus.name: view.bus for view in views}
    return {
        "title": wishes.title,
        "system": wishes.system,
        "devices": views,
        "supervised": supervised,
        "outputs": [view for view in supervised if view.output is not None],
        "sampling": any(view.sampling for view in views),
        "numeric": any(view.kind != "BOOL" for view in supervised),
        "simulated": [view for view in views if view.is_simulated],
        "buses": list(buses.values()),
        "program": program,
        "own": wishes.control is Control.OWN,
        "served": [view for view in supervised if wishes.control is not Control.OWN],
        "canopen": any(view.is_canopen for view in views),
        "compose": wishes.compose,
        "ci": wishes.ci is not Ci.NONE,
        "ci_file": _CI_FILES[wishes.ci][1] if wishes.ci in _CI_FILES else "",
        "version": __version__,
        "published": installation.PUBLISHED,
        "install": installation.install_command(source=installation.WHEEL),
    }


def _refuse_equal_variables(views: list[DeviceView]) -> None:
    """Raise `UsageError` if the names of two devices and their tags give the same variable."""
    seen: dict[str, str] = {}
    for view in views:
        names = {view.variable, _identifier(f"{view.name}_alarm"), _identifier(f"{view.name}_delay"), view.name}
        for name in names | ({view.output_variable} if view.output is not None else set()):
            other = seen.setdefault(name.lower(), view.name)
            if other != view.name:
                raise UsageError(
                    f"the devices {other!r} and {view.name!r} give the same variable {name!r}", hint="rename one"
                )


def _identifier(text: str) -> str:
    return re.sub(r"_+", "_", text).strip("_")


def _with_header(path: str, text: str) -> str:
    """Return a copied profile with the line that names its schema."""
    if not path.endswith(".yaml") or text.startswith(_HEADER):
        return text
    return f"{_HEADER}../{SCHEMA_FOLDER}/{shipped('profile').name}\n{text}"


def number(value: float) -> str:
    """Return a number as text, without a decimal point if it is a whole number."""
    return f"{value:.10g}"


def _real(value: float) -> str:
    """Return a number as a REAL literal of Structured Text and Python: with a decimal point."""
    text = number(value)
    if "e" in text:
        mantissa, _, exponent = text.partition("e")
        return f"{mantissa if '.' in mantissa else mantissa + '.0'}e{int(exponent)}"
    return text if "." in text else f"{text}.0"


def _render(template: str, context: dict[str, Any]) -> str:
    return _environment().get_template(template).render(context)


@cache
def _environment() -> Environment:
    made = Environment(
        loader=FileSystemLoader(TEMPLATES),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
        autoescape=False,  # the results are YAML, Python and Structured Text, not HTML
    )
    made.filters |= {"number": number, "real": _real, "quoted": lambda text: json.dumps(text, ensure_ascii=False)}
    return made
