"""Read YAML without its surprising conversions, and with errors that name line and column.

Scalars follow YAML 1.2's core schema: only ``true`` and ``false`` are booleans and no number is sexagesimal, so ``OFF``
and ``1017:00`` stay strings (PyYAML's 1.1 reads them as False and 61020). The reader is stricter than 1.2 in one respect: a
float needs a point, so that ``8E1`` is a serial frame and not 80. Duplicate keys are refused. The line and column of
every key and value are kept, so that a validation error can name them.

`load` reads a file, `validate` turns it into a pydantic model; both raise `FileInvalid` and no other error.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, TypeVar, get_args, get_origin

import yaml
from pydantic import BaseModel, Tag, ValidationError
from pydantic_core import ErrorDetails

from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.gateway.core.files.input_file import read_input
from fieldtwin.gateway.core.files.nearest import did_you_mean

MAX_BYTES = 8 * 1024 * 1024
"""The largest size of a configuration file. A larger file is a mistake, such as a recording given as a system file."""

MAX_VALUES = 100_000

MAX_NESTING = 64
"""The largest number of nested ``[`` and ``{``. PyYAML's time grows with the square of this number."""

MAX_DIGITS = 21
"""The largest number of characters of an integer, including its sign."""

Key = str | int
Position = tuple[int, int]
M = TypeVar("M", bound=BaseModel)


class BoundedLoader(yaml.SafeLoader):
    """A SafeLoader that refuses more than `MAX_NESTING` nested ``[`` and ``{`` with a `yaml.MarkedYAMLError`."""

    def fetch_flow_collection_start(self, TokenClass: Any) -> None:
        if self.flow_level >= MAX_NESTING:
            message = f"more than {MAX_NESTING} nested [ and {{"
            raise yaml.scanner.ScannerError(None, None, message, self.get_mark())
        super().fetch_flow_collection_start(TokenClass)


class _Loader(BoundedLoader):
    """A loader with the scalars of YAML 1.2's core schema."""

    merges = False


_Loader.yaml_implicit_resolvers = {}
for _tag, _pattern, _first in (
    ("tag:yaml.org,2002:bool", r"^(?:true|false)$", "tf"),
    ("tag:yaml.org,2002:null", r"^(?:~|null|)$", ["~", "n", ""]),
    ("tag:yaml.org,2002:int", r"^[-+]?(?:0|[1-9][0-9]*|0x[0-9a-fA-F]+)$", "-+0123456789"),
    ("tag:yaml.org,2002:float", r"^[-+]?(?:[0-9]+\.[0-9]*|\.[0-9]+)(?:[eE][-+]?[0-9]+)?$", "-+.0123456789"),
):
    _Loader.add_implicit_resolver(_tag, re.compile(_pattern), list(_first))


def _integer(loader: _Loader, node: yaml.ScalarNode) -> int:
    """Read an integer of at most 64 bits.

    No register, object or time needs more, and a very long number would take long to parse.
    """
    text = str(node.value)
    value = (
        int(text, 0) if len(text) <= MAX_DIGITS and "x" in text else int(text) if len(text) <= MAX_DIGITS else 1 << 64
    )
    if not -(1 << 63) <= value < 1 << 64:
        raise yaml.constructor.ConstructorError(None, None, "an integer of more than 64 bits", node.start_mark)
    return value


def _number(loader: _Loader, node: yaml.ScalarNode) -> float:
    value = float(node.value)
    if not math.isfinite(value):
        raise yaml.constructor.ConstructorError(None, None, "a number that is too large", node.start_mark)
    return value


_Loader.add_constructor("tag:yaml.org,2002:int", _integer)
_Loader.add_constructor("tag:yaml.org,2002:float", _number)


class _MergingLoader(_Loader):
    """A loader that resolves `<<`, which compose files use. In files of fieldtwin `<<` is an unknown key."""

    merges = True


_MergingLoader.add_implicit_resolver("tag:yaml.org,2002:merge", re.compile("^<<$"), ["<"])

_OTHER_FILES = (
    (b"PK\x03\x04", "a zip; if it is a template: fieldtwin template unpack"),
    (b"\xff\xfe", "it looks like UTF-16: save it as UTF-8"),
    (b"\xfe\xff", "it looks like UTF-16: save it as UTF-8"),
)
"""Files that users give by mistake, recognised by their first bytes."""


@dataclass(frozen=True)
class YamlFile:
    """A parsed file: plain data, and the position of each path of keys (line and column from 1)."""

    path: str
    data: dict[str, Any]
    positions: dict[tuple[Key, ...], Position]

    def section(self, name: str) -> dict[str, Any]:
        """Return the entries of a section as the user wrote them, also those with errors; none without such a section."""
        found = self.data.get(name)
        return found if isinstance(found, dict) else {}

    def line(self, loc: tuple[Key, ...]) -> int:
        """Return the line of the key path `loc`, or of its nearest parent that is in the file."""
        return self._place(loc)[0]

    def _place(self, loc: tuple[Key, ...]) -> Position:
        while loc and loc not in self.positions:
            loc = loc[:-1]
        return self.positions.get(loc, (1, 1))

    def error(
        self, loc: tuple[Key, ...], message: str, *, expected: str = "", got: str = "", hint: str = ""
    ) -> FileInvalid:
        """Return a `FileInvalid` at the position of the key path `loc`, or of its nearest parent that is in the file."""
        line, column = self._place(loc)
        return FileInvalid(message, path=self.path, line=line, column=column, expected=expected, got=got, hint=hint)


def load(path: Path, *, merges: bool = False) -> YamlFile:
    """Read and parse `path`. The top level must be a mapping. With `merges`, `<<` adds the keys of another mapping."""
    try:
        text = read_input(path, MAX_BYTES).decode("utf-8")
    except OSError as e:
        raise FileInvalid(f"cannot read the file: {e.strerror or e}", path=str(path)) from e
    except UnicodeDecodeError as e:
        hint = next((advice for begins, advice in _OTHER_FILES if e.object.startswith(begins)), "")
        got = f"byte {e.object[e.start]:02X}h"
        raise FileInvalid("the file is not UTF-8 text", path=str(path), got=got, hint=hint) from e
    return parse(text, str(path), merges=merges)


def parse(text: str, path: str, *, merges: bool = False) -> YamlFile:
    """Parse YAML text; `path` is for messages."""
    loader: _Loader | None = None
    try:
        loader = _MergingLoader(text) if merges else _Loader(text)
        node = loader.get_single_node()
        positions: dict[tuple[Key, ...], Position] = {}
        if not isinstance(node, yaml.MappingNode):
            raise FileInvalid("the file contains no keys", path=path, line=1, expected="a mapping such as `key: value`")
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
    """Walk the node tree and store the position of each value in `out`. Raises `FileInvalid` for duplicate keys."""
    out.setdefault(loc, (node.start_mark.line + 1, node.start_mark.column + 1))
    if len(out) > MAX_VALUES:  # a few aliases of aliases can expand to millions of values
        raise FileInvalid("the file contains too many values", path=path, line=1, expected=f"at most {MAX_VALUES}")
    if isinstance(node, yaml.SequenceNode):
        for i, child in enumerate(node.value):
            _note_positions(loader, child, (*loc, i), out, path)
    elif isinstance(node, yaml.MappingNode):
        seen: dict[Any, int] = {}
        if loader.merges:
            loader.flatten_mapping(node)  # merged keys come first, and a key of the mapping itself replaces them
        for key_node, value_node in node.value:
            line, column = key_node.start_mark.line + 1, key_node.start_mark.column + 1
            if not isinstance(key_node, yaml.ScalarNode):
                raise FileInvalid("a key must be a plain word", path=path, line=line, column=column)
            key = loader.construct_object(key_node)
            if key in seen and not loader.merges:
                raise FileInvalid(
                    f"the key {key!r} is defined twice",
                    path=path,
                    line=line,
                    column=column,
                    hint=f"first at line {seen[key]}",
                )
            seen[key] = line
            out[(*loc, key)] = (line, column)
            _note_positions(loader, value_node, (*loc, key), out, path)


def validate(file: YamlFile, model: type[M]) -> M:
    """Return the file as a `model`.

    Raises `FileInvalid` for the first error, with line, expected and given value; `FileInvalid.others` holds the other errors.
    """
    try:
        return model.model_validate(file.data)
    except ValidationError as e:
        raise _translate(file, model, e) from e


def _translate(file: YamlFile, model: type[BaseModel], e: ValidationError) -> FileInvalid:
    errors = sorted(e.errors(), key=lambda d: d["type"] != "extra_forbidden")  # a misspelt key explains a missing one
    places: dict[tuple[Key, ...], list[ErrorDetails]] = {}
    for error in errors:
        missing = (str(error["loc"][-1]),) if error["type"] == "missing" else ()
        places.setdefault((*_in_file(file, error["loc"]), *missing), []).append(error)
    first, *others = (_translate_place(file, model, found) for found in places.values())
    first.others = tuple(others[: FileInvalid.MAX_OTHERS])
    return first


def _translate_place(file: YamlFile, model: type[BaseModel], errors: list[ErrorDetails]) -> FileInvalid:
    """Return one error for a value that fits no type of a union. It lists what each of these types expects."""
    expected = [expected_value(error, _keys_at(model, error["loc"])) for error in errors]
    if not all(expected):
        return _translate_one(file, model, errors[0])
    loc = _in_file(file, errors[0]["loc"])
    name = ".".join(str(part) for part in loc) or "the file"
    given = errors[0]["input"]
    got = str(given).lower() if isinstance(given, bool) else repr(given)[:80]
    return file.error(loc, name, expected=" or ".join(dict.fromkeys(expected)), got=got)


_KINDS = {
    "int": "a whole number",
    "float": "a number",
    "string": "text",
    "bool": "true or false",
    "list": "a list",
    "tuple": "a list",
    "dict": "keys with values",
    "model": "keys with values",
}
_LIMITS = {"greater_than": "gt", "greater_than_equal": "ge", "less_than": "lt", "less_than_equal": "le"}
_LIMIT_WORDS = {"gt": "more than", "ge": "at least", "lt": "less than", "le": "at most"}


def expected_value(error: ErrorDetails, keys: Iterable[str] = ()) -> str:
    """Return in plain English what pydantic expected of a value, or an empty text if pydantic's own message has to be
    used.

    `keys` are the keys of the form that the value should have been.
    """
    kind, _, rest = error["type"].partition("_")
    if kind == "model" and keys:
        return f"the keys {', '.join(keys)}"
    if rest in ("type", "parsing", "from_float", "attributes_type"):
        return _KINDS.get(kind, "")
    if limit := _LIMITS.get(error["type"]):
        value = error["ctx"][limit]
        return f"{_LIMIT_WORDS[limit]} {f'{value:g}' if isinstance(value, float) else value}"
    return ""


def _keys_at(model: type[BaseModel], loc: tuple[int | str, ...]) -> list[str]:
    """Return the keys of the form at `loc`, or an empty list if `loc` is not a form."""
    return _known_keys(model, loc) if loc else list(model.model_fields)


def _translate_one(file: YamlFile, model: type[BaseModel], error: ErrorDetails) -> FileInvalid:
    loc = _in_file(file, error["loc"])
    name = ".".join(str(part) for part in loc)
    if error["type"] == "extra_forbidden":
        known = _known_keys(model, error["loc"][:-1])
        expected = "one of " + ", ".join(sorted(known))
        hint = did_you_mean(str(loc[-1]), known)
        return file.error(loc, f"unknown key {str(loc[-1])!r}{_inside(loc)}", expected=expected, hint=hint)
    if error["type"] == "missing":
        missing = str(error["loc"][-1])
        expected = _example(model, error["loc"][:-1], missing)
        return file.error(loc, f"the key {missing!r} is missing{_inside((*loc, missing))}", expected=expected)
    if error["type"] == "too_short" and not error["input"]:
        return file.error(loc, f"{name} is empty")
    if error["type"] == "union_tag_invalid":
        # a union is discriminated by a function that is named after the key that it reads, such as kind_of
        key = str(error["ctx"]["discriminator"]).strip("'").removesuffix("_of()")
        known, tag = re.findall(r"'([^']*)'", str(error["ctx"]["expected_tags"])), str(error["ctx"]["tag"])
        hint = did_you_mean(tag, known)
        return file.error((*loc, key), f"{name}.{key}", expected=" or ".join(known), got=repr(tag)[:80], hint=hint)
    got = "" if error["type"] == "value_error" else repr(error["input"])[:80]
    if error["type"] == "literal_error":
        known = re.findall(r"'([^']*)'", str(error["ctx"]["expected"]))
        hint = did_you_mean(str(error["input"]), known)
        return file.error(loc, name, expected=" or ".join(known), got=got, hint=hint)
    if error["type"] == "string_pattern_mismatch" and (example := _example_of_text(model, error["loc"])):
        return file.error(loc, f"{name} does not have the required form", expected=f"text such as {example}", got=got)
    return file.error(loc, f"{name}: {error['msg'].removeprefix('Value error, ')}", got=got)


def _example_of_text(model: type[BaseModel], loc: tuple[int | str, ...]) -> str:
    """Return the first example of a text, or of a text in a list of texts; an empty text if its form states none."""
    at = len(loc) - 1 - isinstance(loc[-1], int)
    info = _model_at(model, loc[:at]).model_fields.get(str(loc[at]))
    example = (info.examples or [""])[0] if info is not None else ""
    example = example[0] if isinstance(example, list) else example
    return example if isinstance(example, str) else ""


def _inside(loc: tuple[Key, ...]) -> str:
    return f" in {'.'.join(str(part) for part in loc[:-1])!r}" if len(loc) > 1 else ""


def _in_file(file: YamlFile, loc: tuple[Key, ...]) -> tuple[Key, ...]:
    """Return the key path `loc` of a pydantic error without the parts that are not in the file (union tags, "[key]")."""
    out: tuple[Key, ...] = ()
    for part in loc:
        if (*out, part) in file.positions:
            out = (*out, part)
    return out


def _known_keys(model: type[BaseModel], loc: tuple[Key, ...]) -> list[str]:
    """Return the keys of the model at `loc`, or those of the top level if there is no model."""
    return [info.alias or name for name, info in _model_at(model, loc).model_fields.items()]


def _model_at(model: type[BaseModel], loc: tuple[Key, ...]) -> type[BaseModel]:
    """Return the model at `loc`, found from the annotations, or `model` if there is none."""
    current: Any = model
    for part in loc:
        fields = getattr(current, "model_fields", None)
        if fields and part in fields:
            current = fields[part].annotation
        if tagged := _tagged_models(current):
            current = tagged.get(part, current)
            continue
        for candidate in _models_in(current):
            current = candidate
            break
    return current if getattr(current, "model_fields", None) else model


def _example(model: type[BaseModel], loc: tuple[Key, ...], key: str) -> str:
    """Return a missing key with a value that it may have, or with the kind of its value."""
    fields = _model_at(model, loc).model_fields
    info = next((info for name, info in fields.items() if key in (name, info.alias)), None)
    if info is None:
        return ""
    choices = [str(value) for value in get_args(info.annotation)] if get_origin(info.annotation) is Literal else []
    examples = [each if isinstance(each, str) else json.dumps(each) for each in info.examples or []]
    if choices:
        return f"{key}: {' or '.join(choices)}"
    return f"{key}: {examples[0]}, for example" if examples else _KINDS.get(_kind_of(info.annotation), "")


def _kind_of(annotation: Any) -> str:
    kind = get_origin(annotation) or annotation
    return {str: "string"}.get(kind, getattr(kind, "__name__", ""))


def _tagged_models(annotation: Any) -> dict[Key, type[BaseModel]]:
    """Return the models of a union whose members have tags, by their tag; none if the annotation holds no such union."""
    found: dict[Key, type[BaseModel]] = {}
    for tag in getattr(annotation, "__metadata__", ()):
        if isinstance(tag, Tag):
            found[tag.tag] = annotation.__origin__
    for arg in getattr(annotation, "__args__", ()):
        found |= _tagged_models(arg)
    return found


def _models_in(annotation: Any) -> list[type[BaseModel]]:
    """Return the pydantic models inside an annotation such as ``dict[str, Bus] | None``."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    found: list[type[BaseModel]] = []
    for arg in getattr(annotation, "__args__", ()):
        found.extend(_models_in(arg))
    return found
