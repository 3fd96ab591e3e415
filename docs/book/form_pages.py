"""Generate reference pages of files, faults and shipped profiles, from the schemas and lists that the program itself uses."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from fieldtwin.emulators.faults.registry import FAULTS
from fieldtwin.gateway.core.files.profile_file import load_profile
from fieldtwin.site.schemas import SCHEMAS

KINDS = {
    "system": "The plant: buses, devices, programs. `NAME.yaml`",
    "prototype": "The devices of a plant that are simulated, and with what. `NAME.prototype.yaml`",
    "network": "Several systems whose modems share an acoustic channel, as prototypes.",
    "profile": "A device: its registers or objects.",
    "scenario": "Actions, and the results that are expected. `NAME.scenario.yaml`",
    "faults": "Injected faults, for `run --faults` and `link --faults`.",
    "waivers": "Accepted failures, for `check` and `test`.",
    "rules": "The commands of a digital twin for its findings, for `twin --plan`.",
}
PROFILES = Path(__file__).resolve().parents[2] / "profiles" / "devices"


def form_pages() -> dict[str, str]:
    """Return Markdown by path in the book."""
    return {
        "reference/forms.md": _forms(),
        "reference/faults.md": _faults(),
        "reference/profiles.md": _profiles(),
    }


def _forms() -> str:
    parts = [
        "# Forms\n",
        "Every key of every kind of file, as `fieldtwin schema KIND` has them. What they mean, with examples, is in"
        " [files](files.md), [scenarios](scenarios.md), [fault files](fault-files.md) and"
        " [conformance tests](../how-to/check-a-client.md).\n",
    ]
    for kind, about in KINDS.items():
        schema = SCHEMAS[kind]()
        parts += [f"## {kind}\n", f"{about}\n", _table(schema)]
        for name, part in sorted(schema.get("$defs", {}).items()):
            if part.get("properties") and not _is_a_fault(part):
                parts += [
                    f"### {kind}: {_spoken(name)}\n",
                    part.get("description", "").split("\n\n")[0] + "\n",
                    _table(part),
                ]
    return "\n".join(parts)


def _is_a_fault(part: dict[str, Any]) -> bool:
    """These have a separate page."""
    return part["properties"].get("name", {}).get("const") in FAULTS


def _table(schema: dict[str, Any]) -> str:
    required = schema.get("required", [])
    rows = [
        (f"`{key}`", _type(form), "required" if key in required else _default(form), form.get("description", ""))
        for key, form in schema.get("properties", {}).items()
    ]
    told = any(row[3] for row in rows)
    head = ("key", "is", "default", "meaning")[: 4 if told else 3]
    lines = [_row(head), _row(["---"] * len(head))] + [_row(row[: len(head)]) for row in rows]
    return "\n".join(lines) + "\n"


def _row(cells: Any) -> str:
    return "| " + " | ".join(str(cell).replace("|", "\\|").replace("\n", " ") for cell in cells) + " |"


def _default(form: dict[str, Any]) -> str:
    value = form.get("default")
    return "" if value is None or value in ([], {}) else f"`{json.dumps(value)}`"


def _type(form: dict[str, Any]) -> str:
    """Describe a JSON schema in a few words."""
    if "$ref" in form:
        return _spoken(form["$ref"].rsplit("/", 1)[1])
    if "const" in form:
        return f"`{form['const']}`"
    if "enum" in form:
        return ", ".join(f"`{value}`" for value in form["enum"])
    for several in ("anyOf", "oneOf"):
        if several in form:
            return " or ".join(dict.fromkeys(_type(one) for one in form[several] if one.get("type") != "null"))
    if form.get("type") == "array":
        return f"list of {_type(form.get('items', {}))}"
    if form.get("type") == "object":
        below = next(iter(form.get("patternProperties", {}).values()), form.get("additionalProperties"))
        return f"by name: {_type(below)}" if isinstance(below, dict) else "keys and values"
    return str(form.get("type", "anything")) + _bounds(form)


def _bounds(form: dict[str, Any]) -> str:
    words = {
        "minimum": "at least",
        "exclusiveMinimum": "more than",
        "maximum": "at most",
        "exclusiveMaximum": "less than",
    }
    said = [f"{word} {form[key]:g}" for key, word in words.items() if key in form]
    return f" ({', '.join(said)})" if said else ""


def _spoken(name: str) -> str:
    """SerialLineForm: serial line."""
    name = name.removesuffix("Form")
    return "".join(f" {c.lower()}" if c.isupper() and i else c.lower() for i, c in enumerate(name))


def _faults() -> str:
    parts = [
        "# Faults, one by one\n",
        "What `fieldtwin faults` lists, of this version. How they are put in and what each of them takes:"
        " [faults](../how-to/faults.md).\n",
    ]
    for on in dict.fromkeys(kind.kind for kind in FAULTS.values()):
        parts += [f"## {on.value}\n", _row(("name", "is", "may be told")), _row(["---"] * 3)]
        for kind in FAULTS.values():
            if kind.kind is on:
                own = kind.form.model_json_schema().get("properties", {})
                told = ", ".join(f"`{name}: {json.dumps(form.get('default'))}`" for name, form in own.items())
                parts.append(_row((f"`{kind.name}`", kind.summary, told)))
        parts.append("")
    return "\n".join(parts)


def _profiles() -> str:
    parts = [
        "# Shipped device profiles\n",
        "`fieldtwin emulate NAME --on ENDPOINT` emulates one where its profile or a shipped recording gives it something to"
        " answer; a system file names it as `profile: NAME`. Those of `fieldtwin/` are reference devices of this project: no such"
        " products exist.\n",
        _row(("name", "device", "protocol", "tags", "facts from")),
        _row(["---"] * 5),
    ]
    for path in sorted(PROFILES.glob("*.yaml")):
        profile = load_profile(path)
        parts.append(
            _row((f"`{path.stem}`", profile.form.device, profile.form.protocol, len(profile.tags), profile.form.source))
        )
    return "\n".join(parts) + "\n"
