"""YAML as users mean it, and errors that point at the spot.

Scalars follow YAML 1.2's core schema: only ``true`` and ``false`` are booleans and nothing is sexagesimal, so ``OFF`` and
``1017:00`` stay strings (PyYAML's 1.1 reads them as False and 61020). Stricter than 1.2 in one thing: a float has a point, so
that ``8E1`` is a frame and not 80. Duplicate keys are refused. The line and
column of every key and value are kept, so that a validation error can name them.

`load` reads a file, `validate` turns it into a pydantic model; both raise `FileInvalid` and nothing else.
"""

from __future__ import annotations

import difflib
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import yaml
from pydantic import BaseModel, ValidationError

from gateway.core.errors import FileInvalid

MAX_BYTES = 8 * 1024 * 1024
"""A configuration file larger than this is a mistake (a recording given as a system file, say)."""

MAX_VALUES = 100_000

Key = str | int
Position = tuple[int, int]
M = TypeVar("M", bound=BaseModel)


class _Loader(yaml.SafeLoader):
    """SafeLoader with YAML 1.2 core scalars."""


_Loader.yaml_implicit_resolvers = {}
for _tag, _pattern, _first in (
    ("tag:yaml.org,2002:bool", r"^(?:true|false)$", "tf"),
    ("tag:yaml.org,2002:null", r"^(?:~|null|)$", ["~", "n", ""]),
    ("tag:yaml.org,2002:int", r"^[-+]?(?:0|[1-9][0-9]*|0x[0-9a-fA-F]+)$", "-+0123456789"),
    ("tag:yaml.org,2002:float", r"^[-+]?(?:[0-9]+\.[0-9]*|\.[0-9]+)(?:[eE][-+]?[0-9]+)?$", "-+.0123456789"),
):
    _Loader.add_implicit_resolver(_tag, re.compile(_pattern), list(_first))


_OTHER_FILES = (
    (b"PK\x03\x04", "a zip; if it is a template: fieldtwin template unpack"),
    (b"\xff\xfe", "it looks like UTF-16: save it as UTF-8"),
    (b"\xfe\xff", "it looks like UTF-16: save it as UTF-8"),
)
"""What people give instead, by its first bytes."""


@dataclass(frozen=True)
class YamlFile:
    """A parsed file: plain data, and where each path of keys stands (line and column from 1)."""

    path: str
    data: dict[str, Any]
    positions: dict[tuple[Key, ...], Position]

    def line(self, loc: tuple[Key, ...]) -> int:
        """Where `loc` stands, or its nearest parent that does."""
        return self._place(loc)[0]

    def _place(self, loc: tuple[Key, ...]) -> Position:
        while loc and loc not in self.positions:
            loc = loc[:-1]
        return self.positions.get(loc, (1, 1))

    def error(
        self, loc: tuple[Key, ...], message: str, *, expected: str = "", got: str = "", hint: str = ""
    ) -> FileInvalid:
        """A `FileInvalid` at the spot of `loc`, or of its nearest parent that stands in the file."""
        line, column = self._place(loc)
        return FileInvalid(message, path=self.path, line=line, column=column, expected=expected, got=got, hint=hint)


def load(path: Path) -> YamlFile:
    """Read and parse `path`. The top must be a mapping."""
    try:
        if path.stat().st_size > MAX_BYTES:
            raise FileInvalid("the file is too large", path=str(path), expected=f"at most {MAX_BYTES} bytes")
        raw = path.read_bytes()
        text = raw.decode("utf-8")
    except OSError as e:
        raise FileInvalid(f"cannot read the file: {e.strerror or e}", path=str(path)) from e
    except UnicodeDecodeError as e:
        hint = next((told for begins, told in _OTHER_FILES if e.object.startswith(begins)), "")
        got = f"byte {e.object[e.start]:02X}h"
        raise FileInvalid("the file is not UTF-8 text", path=str(path), got=got, hint=hint) from e
    return parse(text, str(path))


def parse(text: str, path: str) -> YamlFile:
    """Parse YAML text; `path` is for messages."""
    loader: _Loader | None = None
    try:
        loader = _Loader(text)
        node = loader.get_single_node()
        positions: dict[tuple[Key, ...], Position] = {}
        if not isinstance(node, yaml.MappingNode):
            raise FileInvalid("the file holds no keys", path=path, line=1, expected="a mapping such as `key: value`")
        _note_positions(loader, node, (), positions, path)
        data = loader.construct_document(node)
    except yaml.MarkedYAMLError as e:
        mark = e.problem_mark or e.context_mark
        line, column = (mark.line + 1, mark.column + 1) if mark else (1, 1)
        problem = f"{e.context}, {e.problem}" if e.context else str(e.problem)
        hint = "YAML indents with spaces, never tabs" if "\\t" in problem else ""
        raise FileInvalid(f"not YAML: {problem}", path=path, line=line, column=column, hint=hint) from e
    except yaml.YAMLError as e:
        raise FileInvalid(f"not YAML: {e}", path=path, line=1) from e
    except RecursionError as e:
        raise FileInvalid("the file is nested too deeply", path=path, line=1) from e
    finally:
        if loader is not None:
            loader.dispose()
    return YamlFile(path, data, positions)


def _note_positions(
    loader: _Loader, node: yaml.Node, loc: tuple[Key, ...], out: dict[tuple[Key, ...], Position], path: str
) -> None:
    """Walk the node tree: remember where each value stands, refuse duplicate keys."""
    out.setdefault(loc, (node.start_mark.line + 1, node.start_mark.column + 1))
    if len(out) > MAX_VALUES:  # a few aliases of aliases are millions of values
        raise FileInvalid("the file holds too many values", path=path, line=1, expected=f"at most {MAX_VALUES}")
    if isinstance(node, yaml.SequenceNode):
        for i, child in enumerate(node.value):
            _note_positions(loader, child, (*loc, i), out, path)
    elif isinstance(node, yaml.MappingNode):
        seen: dict[Any, int] = {}
        for key_node, value_node in node.value:
            line, column = key_node.start_mark.line + 1, key_node.start_mark.column + 1
            if not isinstance(key_node, yaml.ScalarNode):
                raise FileInvalid("a key must be a plain word", path=path, line=line, column=column)
            key = loader.construct_object(key_node)
            if key in seen:
                raise FileInvalid(
                    f"the key {key!r} stands twice",
                    path=path,
                    line=line,
                    column=column,
                    hint=f"first at line {seen[key]}",
                )
            seen[key] = line
            out[(*loc, key)] = (line, column)
            _note_positions(loader, value_node, (*loc, key), out, path)


def validate(file: YamlFile, model: type[M]) -> M:
    """The file as a `model`; the first thing wrong is named with its line, what was expected and what came."""
    try:
        return model.model_validate(file.data)
    except ValidationError as e:
        raise _translate(file, model, e) from e


def _translate(file: YamlFile, model: type[BaseModel], e: ValidationError) -> FileInvalid:
    errors = sorted(e.errors(), key=lambda d: d["type"] != "extra_forbidden")  # a misspelt key explains a missing one
    first = errors[0]
    loc = _in_file(file, first["loc"])
    name = ".".join(str(part) for part in loc)
    more = f"; {len(errors) - 1} more" if len(errors) > 1 else ""
    if first["type"] == "extra_forbidden":
        known = _known_keys(model, first["loc"][:-1])
        near = difflib.get_close_matches(str(loc[-1]), known, n=1, cutoff=0.5)
        expected = "one of " + ", ".join(sorted(known))
        hint = f"did you mean {near[0]!r}?" if near else ""
        return file.error(loc, f"unknown key {str(loc[-1])!r}{_inside(loc)}{more}", expected=expected, hint=hint)
    if first["type"] == "missing":
        missing = str(first["loc"][-1])
        return file.error(loc, f"the key {missing!r} is missing{_inside((*loc, missing))}{more}")
    if first["type"] == "too_short" and not first["input"]:
        return file.error(loc, f"{name} is empty{more}")
    got = "" if first["type"] == "value_error" else repr(first["input"])[:80]
    if first["type"] == "literal_error":
        known = re.findall(r"'([^']*)'", str(first["ctx"]["expected"]))
        near = difflib.get_close_matches(str(first["input"]), known, n=1, cutoff=0.5)
        hint = f"did you mean {near[0]!r}?" if near else ""
        return file.error(loc, f"{name}{more}", expected=" or ".join(known), got=got, hint=hint)
    return file.error(loc, f"{name}: {first['msg'].removeprefix('Value error, ')}{more}", got=got)


def _inside(loc: tuple[Key, ...]) -> str:
    return f" in {'.'.join(str(part) for part in loc[:-1])!r}" if len(loc) > 1 else ""


def _in_file(file: YamlFile, loc: tuple[Key, ...]) -> tuple[Key, ...]:
    """Pydantic's location without the parts that are not in the file (union tags, "[key]")."""
    out: tuple[Key, ...] = ()
    for part in loc:
        if (*out, part) in file.positions:
            out = (*out, part)
    return out


def _known_keys(model: type[BaseModel], loc: tuple[Key, ...]) -> list[str]:
    """The keys that the model at `loc` knows, by walking annotations; those of the top where that fails."""
    current: Any = model
    for part in loc:
        fields = getattr(current, "model_fields", None)
        if fields and part in fields:
            current = fields[part].annotation
        for candidate in _models_in(current):
            current = candidate
            break
    fields = getattr(current, "model_fields", None) or model.model_fields
    return [info.alias or name for name, info in fields.items()]


def _models_in(annotation: Any) -> list[type[BaseModel]]:
    """The pydantic models inside an annotation such as ``dict[str, Bus] | None``."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    found: list[type[BaseModel]] = []
    for arg in getattr(annotation, "__args__", ()):
        found.extend(_models_in(arg))
    return found
