"""Chooses the statements of PROGRAMs that become machine code, and writes the calls of it into their Python code."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

from fieldtwin.plc.st.native.layouts import Layout, Layouts, Unsupported, slots_of
from fieldtwin.plc.st.native.module_text import ModuleText, Run
from fieldtwin.plc.st.native.statements import Translation

RUNS = "_runs"
"""The name of the list of functions of machine code in the Python code."""
_RESULT = "_ended"


MAX_REASON = 100
"""The largest length of a reason; the text of an expression is cut."""


@dataclass(frozen=True, slots=True)
class Kept:
    """A statement of a PROGRAM that stays Python: its line and the reason."""

    line: int
    reason: str


@dataclass(slots=True)
class Prepared:
    """The translation of a unit: the text of the C module, the names of its classes, the constants of its records."""

    text: str
    classes: tuple[str, ...]
    constants: tuple[object, ...]
    runs: int
    kept: dict[str, list[Kept]] = field(default_factory=dict)
    """By class of a PROGRAM: its statements that stay Python."""
    statements: dict[str, int] = field(default_factory=dict)
    """By class of a PROGRAM: the number of its lines with statements, each with the statements inside it."""
    published: dict[str, tuple[str, ...]] = field(default_factory=dict)
    """By class of a PROGRAM that is machine code as a whole: the attributes in the row of its structure; "" between them."""


def prepare(body: list[ast.stmt]) -> Prepared:
    """Translate what can be translated of the Python code of a unit, and change its PROGRAMs, so that they use it."""
    layouts = Layouts(body)
    translation = Translation(layouts)
    runs: list[Run] = []
    kept: dict[str, list[Kept]] = {}
    statements: dict[str, int] = {}
    for node in body:
        if isinstance(node, ast.ClassDef) and node.name.startswith("P_"):
            statements[node.name] = len(
                {group[0].lineno for group in _inseparable(layouts.of(node.name).methods["execute"].body)}
            )
            kept[node.name] = list(_translate(node, layouts.of(node.name), translation, runs))
    if not runs:
        return Prepared("", (), (), 0, kept, statements)
    module = ModuleText(translation, runs)
    constants = tuple(ast.literal_eval(each) for each in translation.constants)
    whole = [name for name, left in kept.items() if not left and sum(run.layout.name == name for run in runs) == 1]
    published = {name: tuple(one.name if one else "" for one in layouts.of(name).row()) for name in whole}
    classes = tuple(one.name for one in module.classes)
    return Prepared(module.text(), classes, constants, len(runs), kept, statements, published)


def _translate(node: ast.ClassDef, layout: Layout, translation: Translation, runs: list[Run]) -> Iterator[Kept]:
    """Replace the statements of a PROGRAM that can be translated by calls of machine code. Yield the others."""
    execute = layout.methods["execute"]
    made: list[ast.stmt] = []
    lines: set[int] = set()
    for group, is_native, reason in _groups(execute.body, layout, translation):
        if not is_native:
            if group[0].lineno not in lines:  # one assignment of a structure is several Python statements
                yield Kept(group[0].lineno, _written(reason))
            lines.add(group[0].lineno)
            made += group
            continue
        c_name = f"r_{len(runs)}"
        used = translation.run(c_name, layout, group)
        made += _calling(len(runs), group)
        runs.append(Run(c_name, layout, frozenset(used)))
    if any(run.layout is layout for run in runs):
        execute.body = made
        # The run-time library sets further attributes, which go to the dictionary.
        names = ast.Tuple([ast.Constant(name) for name in (*slots_of(node), "__dict__")], ast.Load())
        slots = ast.Assign([ast.Name("__slots__", ast.Store())], names)
        node.body.insert(0, ast.copy_location(slots, node))
        ast.fix_missing_locations(node)


def _written(reason: str) -> str:
    """Return a reason with the names of variables as the source writes them."""
    text = re.sub(r"\b(self\.)?(v_|_v\.)", "", reason)
    return text if len(text) <= MAX_REASON else f"{text[:MAX_REASON]}..."


def _groups(
    statements: Sequence[ast.stmt], layout: Layout, translation: Translation
) -> Iterator[tuple[list[ast.stmt], bool, str]]:
    """Yield runs of statements that can be translated, and those between them with the reason why they cannot."""
    run: list[ast.stmt] = []
    for group in _inseparable(statements):
        try:
            translation.run("trial", layout, group)
            del translation.texts[-1]
        except Unsupported as e:
            if run:
                yield run, True, ""
                run = []
            yield group, False, str(e)
        else:
            run += group
    if run:
        yield run, True, ""


def _inseparable(statements: Sequence[ast.stmt]) -> Iterator[list[ast.stmt]]:
    """Yield the statements in groups: local Python variables that one of them sets are used in the same group only."""
    last: dict[str, int] = {}
    stored = [
        {n.id for n in ast.walk(one) if isinstance(n, ast.Name) and isinstance(n.ctx, ast.Store)} for one in statements
    ]
    for at, one in enumerate(statements):
        for node in ast.walk(one):
            if isinstance(node, ast.Name):
                last[node.id] = at
    group: list[ast.stmt] = []
    until = 0
    for at, one in enumerate(statements):
        group.append(one)
        until = max([until, *(last[name] for name in stored[at])])
        if until <= at:
            yield group
            group = []
    if group:
        yield group


def _calling(number: int, group: list[ast.stmt]) -> list[ast.stmt]:
    """Return the call of machine code: without a result, the Python code of the same statements runs."""
    source = (
        f"{_RESULT} = {RUNS}[{number}](self, _c, _G)\nif {_RESULT} is None:\n    pass\nelif {_RESULT}:\n    return\n"
    )
    made = ast.parse(source).body
    for node in made:
        for each in ast.walk(node):
            if isinstance(each, ast.stmt | ast.expr):
                each.lineno = each.end_lineno = group[0].lineno
                each.col_offset = each.end_col_offset = 0
    assert isinstance(made[1], ast.If)
    made[1].body = group
    return made
