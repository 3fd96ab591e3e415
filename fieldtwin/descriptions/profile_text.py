"""Write a profile as YAML, in the form of the shipped profiles: a line for each key, and a line for each tag."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import yaml

from fieldtwin.gateway.core.files.profile import DeviceProfile
from fieldtwin.gateway.core.files.profile_file import resolve
from fieldtwin.gateway.core.files.profile_schema import ProfileForm
from fieldtwin.gateway.core.files.yaml_file import parse


def profile_text(form: ProfileForm, remark: str) -> str:
    """Return the YAML of a profile. `remark` is one line that becomes a comment at the start."""
    stated = form.model_dump(exclude_defaults=True)
    lines = [f"# {printable(remark)}"]
    for key, value in stated.items():
        if isinstance(value, Mapping) and key in ("tags", "functions", "messages", "behaviours"):
            lines.append(f"{key}:")
            lines += [f"  {_flow(name)}: {_flow(each)}" for name, each in value.items()]
        else:
            lines.append(f"{key}: {_flow(value)}")
    return "\n".join(lines) + "\n"


def checked_profile(text: str, path: str) -> DeviceProfile:
    """Load the text of a profile with the profile reader. Raises `FileInvalid` if the reader refuses it."""
    return resolve(parse(text, path))


def printable(text: str) -> str:
    """Return `text` in one line, with a space in place of each character that is not printed; a profile holds only such texts."""
    return " ".join("".join(c if c.isprintable() else " " for c in text).split())


def _flow(value: Any) -> str:
    """Return a value in one line of YAML."""
    text = yaml.safe_dump(
        _plain(value), default_flow_style=True, allow_unicode=True, sort_keys=False, width=float("inf")
    ).strip()
    return text.removesuffix("...").strip()


def _plain(value: Any) -> Any:
    """Return `value` with whole numbers as integers, because ``1`` is easier to read than ``1.0``."""
    if isinstance(value, Mapping):
        return {key: _plain(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(each) for each in value]
    return int(value) if isinstance(value, float) and value.is_integer() and abs(value) < 1e15 else value
