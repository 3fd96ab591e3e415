"""Parse the text of JSON, TOML and YAML files of other programs, and find the line of each value for error messages.

The parsers of the standard library and PyYAML give data without positions. The position of a value is searched only when an
error names it, so that a correct file costs nothing. All functions raise `FileInvalid` and no other error.
"""

from __future__ import annotations

import json
import re
import tomllib
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from json.decoder import scanstring  # type: ignore[attr-defined]  # not in the type stubs
from typing import Any

import yaml

from fieldtwin.descriptions.conversion import Source
from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.gateway.core.files.yaml_file import MAX_BYTES, BoundedLoader

MAX_VALUES = 200_000
"""The largest number of values in one file. An aliased YAML document could otherwise expand to millions of values."""

Key = str | int
Loc = tuple[Key, ...]
Position = tuple[int, int]


@dataclass(frozen=True)
class Document:
    """Parsed data of a file, with a function that returns the line and the column (from 1) of a key path."""

    path: str
    data: Any
    locate: Callable[[Loc], Position]

    def error(self, loc: Loc, message: str, *, expected: str = "", got: str = "", hint: str = "") -> FileInvalid:
        """Return a `FileInvalid` at the position of `loc`."""
        line, column = self.locate(loc)
        return FileInvalid(message, path=self.path, line=line, column=column, expected=expected, got=got, hint=hint)

    def mapping(self, value: object, loc: Loc, name: str) -> dict[str, Any]:
        """Return `value` if it is a mapping. Raises `FileInvalid` otherwise."""
        if not isinstance(value, dict):
            raise self.error(loc, name, expected="keys with values", got=_kind(value))
        return value

    def entries(self, value: object, loc: Loc, name: str) -> list[tuple[Loc, dict[str, Any]]]:
        """Return each mapping of a list with its key path; None is an empty list. Raises `FileInvalid` for other values."""
        if value is None:
            return []
        if not isinstance(value, list):
            raise self.error(loc, name, expected="a list", got=_kind(value))
        return [((*loc, i), self.mapping(each, (*loc, i), f"entry {i + 1} of {name}")) for i, each in enumerate(value)]

    def choice(self, value: object, loc: Loc, name: str, options: Iterable[str]) -> str:
        """Return `value` if it is one of the texts `options`. Raises `FileInvalid` otherwise."""
        known = list(options)
        if not isinstance(value, str) or value not in known:
            raise self.error(loc, name, expected=", ".join(each for each in known if each), got=_shown(value))
        return value

    def integer(self, value: object, loc: Loc, name: str, low: int, high: int) -> int:
        """Return a whole number, which may be written as text such as "3" or "0x10". Raises `FileInvalid` for other values."""
        number: object = value
        if isinstance(value, str) and re.fullmatch(r"\s*(0[xX][0-9a-fA-F]{1,8}|[0-9]{1,10})\s*", value):
            number = int(value, 16 if "x" in value.lower() else 10)
        if isinstance(number, float) and number.is_integer():
            number = int(number)
        if isinstance(number, bool) or not isinstance(number, int) or not low <= number <= high:
            raise self.error(loc, name, expected=f"a whole number from {low} to {high}", got=_shown(value))
        return number

    def number(self, value: object, loc: Loc, name: str) -> float:
        """Return a finite number, which may be written as text. Raises `FileInvalid` for other values."""
        try:
            number = float(value) if isinstance(value, int | float | str) and not isinstance(value, bool) else None
        except (ValueError, OverflowError):
            number = None
        if number is None or not abs(number) <= 1e300:
            raise self.error(loc, name, expected="a number", got=_shown(value))
        return number

    def text(self, value: object, loc: Loc, name: str) -> str:
        """Return text; a number becomes text. Raises `FileInvalid` for other values and for empty text."""
        text = str(value).strip() if isinstance(value, str | int | float) and not isinstance(value, bool) else ""
        if not text:
            raise self.error(loc, name, expected="text", got=_shown(value))
        return text


def _kind(value: object) -> str:
    return {dict: "keys with values", list: "a list", type(None): "nothing"}.get(type(value), _shown(value))


def _shown(value: object) -> str:
    return "nothing" if value is None else repr(value)[:80]


def text_of(source: Source) -> str:
    """Return the text of a file, without a byte order mark. Raises `FileInvalid` if it is not UTF-8 or too large."""
    path, most = str(source.path), MAX_BYTES
    if len(source.data) > most:
        raise FileInvalid(
            "the file is too large", path=path, expected=f"at most {most} bytes", got=f"{len(source.data)}"
        )
    try:
        return source.data.decode("utf-8-sig")
    except UnicodeDecodeError as e:
        line = source.data.count(b"\n", 0, e.start) + 1
        got = f"byte {source.data[e.start]:02X}h"
        raise FileInvalid("the file is not UTF-8 text", path=path, line=line, got=got) from e


def parse_json(source: Source) -> Document:
    """Parse JSON. A key that occurs twice in one object is an error."""
    text, path = text_of(source), str(source.path)
    try:
        data = json.loads(text, object_pairs_hook=_unique, parse_constant=_refuse)
    except json.JSONDecodeError as e:
        raise FileInvalid(f"not JSON: {e.msg}", path=path, line=e.lineno, column=e.colno) from e
    except RecursionError as e:
        raise FileInvalid("the file is nested too deeply", path=path, line=1) from e
    except ValueError as e:
        raise FileInvalid(f"not JSON: {e}", path=path, line=1) from e
    return Document(path, data, lambda loc: _json_position(text, loc))


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) < len(pairs):
        keys = [key for key, _ in pairs]
        raise ValueError(f"the key {next(k for k in keys if keys.count(k) > 1)!r} is defined twice in one object")
    return found


def _refuse(name: str) -> float:
    raise ValueError(f"{name} is not a number of JSON")


def _json_position(text: str, loc: Loc) -> Position:
    """Return the position of a value in valid JSON text, or of its nearest parent that exists."""
    decoder, at = json.JSONDecoder(), _skip(text, 0)
    for key in loc:
        found = _json_child(text, at, key, decoder)
        if found is None:
            break
        at = found
    return text.count("\n", 0, at) + 1, at - (text.rfind("\n", 0, at) + 1) + 1


def _json_child(text: str, at: int, key: Key, decoder: json.JSONDecoder) -> int | None:
    """Return the offset of the value of `key` in the object or list that begins at the offset `at`."""
    opening, i, at = text[at], 0, _skip(text, at + 1)
    while opening in "{[" and text[at] not in "}]":
        name: Key = i
        if opening == "{":
            name, at = scanstring(text, at + 1)
            at = _skip(text, _skip(text, at) + 1)
        if name == key:
            return at
        at = _skip(text, decoder.raw_decode(text, at)[1])
        if text[at] == ",":
            at = _skip(text, at + 1)
        i += 1
    return None


def _skip(text: str, at: int) -> int:
    match = re.compile(r"[ \t\r\n]*").match(text, at)
    return match.end() if match else at


def parse_toml(source: Source) -> Document:
    """Parse TOML."""
    text, path = text_of(source), str(source.path)
    try:
        data = tomllib.loads(text)
    except tomllib.TOMLDecodeError as e:
        found = re.search(r"\(at line (\d+), column (\d+)\)$", str(e))
        line, column = (int(found[1]), int(found[2])) if found else (text.rstrip().count("\n") + 1, 1)
        raise FileInvalid(
            f"not TOML: {re.sub(r' [(]at .*[)]$', '', str(e))}", path=path, line=line, column=column
        ) from e
    except (RecursionError, ValueError) as e:
        raise FileInvalid("the file is nested too deeply, or has a number that is too large", path=path, line=1) from e
    return Document(path, data, lambda loc: _toml_position(text, loc))


def _toml_position(text: str, loc: Loc) -> Position:
    """Return the line of a table header, key or inline table of TOML.

    Tables that are written as ``[[a.b]]`` are counted in the order of the file. The search stops at the last part of `loc` that
    it finds.
    """
    lines, line, inner, names = text.splitlines(), 0, False, list[str]()
    for n, key in enumerate(loc):
        after = loc[n + 1] if n + 1 < len(loc) else None
        if isinstance(key, str):
            names.append(key)
            headers = [i for i, each in enumerate(lines) if _is_header(each, names, line, i)]
            wanted = after if isinstance(after, int) else 0
            if not inner and len(headers) > wanted:
                line = headers[wanted]
                continue
            found = next(
                (i for i in range(line, len(lines)) if re.match(rf'\s*"?{re.escape(key)}"?\s*=', lines[i])), None
            )
            if found is None:
                if n + 1 < len(loc):
                    continue  # the first part of a header such as [[inputs.modbus]], or a missing key
                break
            line, inner = found, True
        elif inner:  # the entry of an array: each begins with an opening brace
            braces = [i for i in range(line, len(lines)) for _ in re.findall(r"\{", re.sub(r"#.*", "", lines[i]))]
            if len(braces) <= key:
                break
            line = braces[key]
    return line + 1, len(lines[line]) - len(lines[line].lstrip()) + 1 if lines else 1


def _is_header(text: str, names: list[str], first: int, i: int) -> bool:
    return i >= first and re.match(rf"\s*\[\[?\s*{re.escape('.'.join(names))}\s*\]", text) is not None


class _Loader(BoundedLoader):
    """A loader for the files of other programs: tags such as ``!secret`` become `Tagged`."""


@dataclass(frozen=True)
class Tagged:
    """A YAML value with an application's tag, such as ``!secret meter_host`` or ``!include sensors.yaml``."""

    tag: str
    text: str


def _tagged(loader: _Loader, suffix: str, node: yaml.Node) -> Tagged:
    return Tagged(f"!{suffix}", str(node.value) if isinstance(node, yaml.ScalarNode) else "")


_Loader.add_multi_constructor("!", _tagged)


def parse_yaml(source: Source) -> Document:
    """Parse YAML 1.1, as PyYAML does for most Python programs. The value of an application's tag becomes `Tagged`."""
    text, path = text_of(source), str(source.path)
    loader: _Loader | None = None
    try:
        loader = _Loader(text)
        node = loader.get_single_node()
        positions: dict[Loc, Position] = {}
        if node is not None:
            _note(node, (), positions, path)
        data = loader.construct_document(node) if node is not None else None
    except yaml.MarkedYAMLError as e:
        mark = e.problem_mark or e.context_mark
        line, column = (mark.line + 1, mark.column + 1) if mark else (1, 1)
        raise FileInvalid(f"not YAML: {e.problem or e.context}", path=path, line=line, column=column) from e
    except yaml.YAMLError as e:
        raise FileInvalid(f"not YAML: {e}", path=path, line=1) from e
    except (RecursionError, ValueError, TypeError) as e:
        raise FileInvalid("the file is nested too deeply, or has an invalid value", path=path, line=1) from e
    finally:
        if loader is not None:
            loader.dispose()

    def locate(loc: Loc) -> Position:
        while loc and loc not in positions:
            loc = loc[:-1]
        return positions.get(loc, (1, 1))

    return Document(path, data, locate)


def _note(node: yaml.Node, loc: Loc, out: dict[Loc, Position], path: str) -> None:
    out.setdefault(loc, (node.start_mark.line + 1, node.start_mark.column + 1))
    if len(out) > MAX_VALUES:
        raise FileInvalid("the file contains too many values", path=path, line=1, expected=f"at most {MAX_VALUES}")
    if isinstance(node, yaml.SequenceNode):
        for i, child in enumerate(node.value):
            _note(child, (*loc, i), out, path)
    elif isinstance(node, yaml.MappingNode):
        for key, value in node.value:
            name = str(key.value) if isinstance(key, yaml.ScalarNode) else "?"
            out[(*loc, name)] = (key.start_mark.line + 1, key.start_mark.column + 1)
            _note(value, (*loc, name), out, path)
