"""Reads tests of rusty in Rust: a program in a string, a struct with the values of its variables, and assertions about these.

A test is read if it compiles one program, executes its `main`, and has at least one assertion in a known form. The others
are counted as not read. `tests_of` translates each test that it reads into a TEST block.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

from corpus_rust import NotRead
from rusty_lit import executed, shown

from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.plc.st.dialects import Dialect

_TEST = re.compile(r"(?m)^#\[test\]\n((?:#\[.*\]\n)*)fn (\w+)\(\)[^{]*\{\n(.*?)^\}", re.DOTALL)
_STRING = r'r#"(?P<raw>.*?)"#|r?"(?P<plain>[^"]*)"'
_SOURCE = re.compile(rf"let (?:mut )?\w+\s*=\s*(?:{_STRING})", re.DOTALL)
_RUN = re.compile(r"\b(?:compile_and_run|compile_and_run_no_params|module\.run)\b[^;]*")
_MAIN = re.compile(r"(?i)\b(FUNCTION|PROGRAM)\s+main\b(?:\s*:\s*([\w\[\]]+))?")
_ASSERTION = re.compile(r"\bassert(_eq)?!\s*\((.*?)\)\s*(?:;|\n\s*\}|$)", re.DOTALL)
_NUMBER = re.compile(r"-?(?:0x[0-9A-Fa-f_]+|0b[01_]+|[0-9][0-9_]*(?:\.[0-9_]*)?(?:[eE][-+]?[0-9]+)?)")
_CLOSE = re.compile(r"\(\s*([\w.]+) - ([-\w.]+)\s*\)\.abs\(\) <=? f(?:32|64)::EPSILON$")
_SUFFIX = re.compile(r"_?(?:[iuf](?:8|16|32|64)|[iu]size)$")
_BLOCK = re.compile(r"(?is)\bVAR(?:_INPUT|_OUTPUT|_IN_OUT)?\b(.*?)\bEND_VAR\b")
_DECLARED = re.compile(r"([A-Za-z_][\w, ]*?)\s*:[^;]*;")
_COMMENT = re.compile(r"(?s)//[^\n]*|\(\*.*?\*\)")
_RESULT = ("res", "result", "_res")


@dataclass(frozen=True)
class RustTest:
    """A test: its program, and the text of a TEST block with its assertions."""

    name: str
    source: str
    block: str


def tests_of(text: str) -> tuple[list[RustTest], dict[str, str]]:
    """Return the tests of a file that can be read, and why each other one is not read, by its name."""
    read, left = [], {}
    for attributes, name, body in _TEST.findall(text):
        try:
            if "ignore" in attributes or "should_panic" in attributes:
                raise NotRead("not executed by its own repository, or expected to fail")
            read.append(_test(name, body, text))
        except NotRead as e:
            left[name] = str(e)
    return read, left


def rust_results(text: str, dialect: Dialect) -> tuple[dict[str, str], dict[str, str]]:
    """Return for each test that is read its difference from the expected values ("" for none), and the tests not read."""
    read, left = tests_of(text)
    found = {}
    for test in read:
        try:
            (result,) = executed(test.source, test.block, dialect)
        except FileInvalid as e:
            found[test.name] = shown(e)
            continue
        failed = [f"{one.text.text}: expected {one.expected}; got {one.got}" for one in result.failed]
        found[test.name] = result.error or "; ".join(failed)
    return found, left


def _test(name: str, body: str, text: str) -> RustTest:
    sources = [match["raw"] or match["plain"] for match in _SOURCE.finditer(body)]
    runs = len(_RUN.findall(body))
    if len(sources) != 1 or runs != 1:
        raise NotRead(f"{len(sources)} programs, {runs} executions")
    main = _MAIN.search(sources[0])
    if main is None or "for_each" in body or "format!" in body:
        raise NotRead("no FUNCTION or PROGRAM main, or a loop or macro of Rust")
    names = _names(body, text, sources[0][main.end() :]) if main[1].upper() == "PROGRAM" else {}
    asserted = [_assertion(bool(equal), given, names, main) for equal, given in _ASSERTION.findall(body)]
    if not asserted:
        raise NotRead("no assertion in a known form")
    if main[1].upper() == "PROGRAM":
        declared, call = "m : main;", "m();"
    else:
        declared, call = (f"r : {main[2]};", "r := main();") if main[2] else ("", "main();")
    lines = "\n".join(asserted)
    return RustTest(name, sources[0], f"TEST '{name}'\nVAR {declared} END_VAR\n{call}\n{lines}\nEND_TEST\n")


def _names(body: str, text: str, program: str) -> dict[str, str]:
    """Return the variables of a program by the fields of the struct of Rust that holds them, which are in the same order."""
    variables = [
        name.strip()
        for block in _BLOCK.findall(_COMMENT.sub("", program.partition("END_PROGRAM")[0]))
        for names in _DECLARED.findall(block)
        for name in names.split(",")
    ]
    made = re.search(r"&mut (\w+)\s*\)", body)
    of = re.search(rf"let mut {made[1]}(?::[^=]*)?\s*=\s*(\w+)", body) if made is not None else None
    struct = re.search(rf"struct {of[1]}\b[^{{;]*\{{(.*?)\}}", body + text, re.DOTALL) if of is not None else None
    fields = re.findall(r"(?m)(\w+)\s*:", _COMMENT.sub("", struct[1])) if struct is not None else []
    if len(fields) != len(variables):
        fields = variables
    return {**dict(zip(variables, variables, strict=True)), **dict(zip(fields, variables, strict=True))}


def _assertion(equal: bool, given: str, names: dict[str, str], main: re.Match[str]) -> str:
    """Return an assertion in Structured Text."""
    if close := _CLOSE.match(given):
        return _assertion(True, f"{close[1]}, {close[2]}", names, main)
    if not equal:
        path = given.strip()
        wanted = "FALSE" if path.startswith("!") else "TRUE"
        return f"ASSERT_{wanted}({_variable(path.lstrip('!'), names, main)});"
    parts = [part for part in _split(given) if part]
    if len(parts) != 2:
        raise NotRead(f"an assertion with {len(parts)} arguments")
    literals = [_literal(part) for part in parts]
    if (literals[0] is None) == (literals[1] is None):
        raise NotRead(f"an assertion about {given.strip()[:40]}")
    at = 0 if literals[1] is not None else 1
    variable, value = _variable(parts[at], names, main), literals[1 - at]
    assert value is not None
    if value in ("TRUE", "FALSE"):
        return f"ASSERT_{value}({variable});"
    if re.search(r"[.eE]", value) and "'" not in value:
        return f"ASSERT_NEAR({variable}, {value}, {max(abs(float(value)), 1e-30) * 1e-6:.12f});"
    return f"ASSERT_EQ({variable}, {value});"


def _split(given: str) -> list[str]:
    """Return the arguments of a macro, which commas separate outside of brackets and quotation marks."""
    parts, depth, quoted = [""], 0, False
    for c in given:
        quoted ^= c == '"'
        depth += not quoted and c in "([{"
        depth -= not quoted and c in ")]}"
        if c == "," and not depth and not quoted:
            parts.append("")
        else:
            parts[-1] += c
    return [part.strip() for part in parts]


def _literal(text: str) -> str | None:
    """Return a literal of Rust in Structured Text; None for anything else."""
    if text in ("true", "false"):
        return text.upper()
    if re.fullmatch("b'[^'\\\\$]'", text):
        return f"CHAR#{text[1:]}"
    if re.fullmatch(r'"[^"\\$]*"', text):
        return "'" + text[1:-1].replace("'", "$'") + "'"
    text = text if text.startswith(("0x", "-0x")) else _SUFFIX.sub("", text)
    if not _NUMBER.fullmatch(text):
        return None
    if "." in text or ("e" in text and "0x" not in text):
        return repr(float(text.replace("_", "")))
    return str(int(text.replace("_", ""), 0))


def _variable(text: str, names: dict[str, str], main: re.Match[str]) -> str:
    """Return the variable of a test that a path of Rust names: the result, or a variable of the program `main`."""
    text = text.strip()
    if text in _RESULT:
        if main[1].upper() != "FUNCTION" or not main[2]:
            raise NotRead("an assertion about the result of a PROGRAM")
        return "TIME_TO_LINT(r)" if main[2].upper() == "TIME" else "r"  # rusty counts ms
    first, *more = text.partition(".")[2].split(".")
    if not re.fullmatch(r"\w+(?:\.\w+)+", text) or first not in names:
        raise NotRead(f"an assertion about {text[:40]}")
    return ".".join(("m", names[first], *more))
