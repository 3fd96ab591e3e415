"""The code of function blocks (IEC 61131-3:2013, 6.6.3) and of the actions of POUs. A FUNCTION_BLOCK becomes a class."""

from __future__ import annotations

from dataclasses import replace

from fieldtwin.plc.st import types as ty
from fieldtwin.plc.st.compiler.assignments import Recorded, is_recorded
from fieldtwin.plc.st.compiler.configurations.instances import declared_name
from fieldtwin.plc.st.compiler.initial.values import FB_INIT, FIXED
from fieldtwin.plc.st.compiler.pous.functions import Functions
from fieldtwin.plc.st.compiler.pous.variables import Variables
from fieldtwin.plc.st.compiler.scope import Symbol, by_reference, identifier
from fieldtwin.plc.st.compiler.statements import Statements
from fieldtwin.plc.st.syntax import tree as t
from fieldtwin.plc.st.syntax.addresses import area_of


class Bodies:
    """The compiler of what function blocks, classes and programs have in common: bodies, actions and methods."""

    def __init__(self, variables: Variables, functions: Functions) -> None:
        self.env, self.declarations, self.out = variables.env, variables.declarations, variables.out
        self.variables, self.functions = variables, functions

    def body_of(self, pou: t.Pou, symbols: dict[str, Symbol], name: str) -> Statements:
        """Return the compiler of a body of a POU. `name` is that of the POU, or of an action with the POU before it."""
        body = Statements(self.env, symbols, self.out, name)
        body.owner = pou.name.lower()
        body.own = self.env.classes.get(body.owner)
        body.actions = frozenset(body.own.actions) if body.own is not None else frozenset()
        return body

    def write_actions(self, pou: t.Pou, symbols: dict[str, Symbol], inputs: frozenset[str] = frozenset()) -> None:
        """Write a method for each action of a POU."""
        seen: set[str] = set()
        for action in pou.actions:
            key = action.name.lower()
            if key in seen or key in symbols:
                self.env.collected(self.env.error(action.pos, f"{action.name} is declared twice"))
            seen.add(key)
            with self.out.block(f"def a_{key}(self):", action.pos):
                self.out.step(action.pos)
                body = self.body_of(pou, symbols, f"{pou.name.lower()}.{key}")
                body.program_inputs = set(inputs)
                body.body(action.body)

    def write_methods(self, pou: t.Pou, symbols: dict[str, Symbol], inputs: frozenset[str] = frozenset()) -> None:
        """Write the methods of a POU and its properties, and those that it inherits. `symbols` are the variables of the POU."""
        own = self.env.classes.get(pou.name.lower())
        if own is None:
            return
        own.variables = symbols
        visible = {**symbols, **self._without_call(pou, symbols)}
        for declared in pou.methods:
            method = own.of(declared.kind, declared.name)
            if method is None or method.abstract:
                continue
            with self.env.declaring(declared.name, self.env.faulty_here), self.declarations.within(declared):
                body = self.body_of(pou, {**visible, **self.variables.symbols_of(declared, "")}, method.key)
                self.env.symbols[method.key] = body.symbols
                body.program_inputs = set(inputs)
                self.functions.write_body(declared, method.signature, body, method.attribute, "self")
        for method in own.methods.values():
            if method.owner != pou.name and not method.abstract:
                self.out.line(f"{method.attribute} = B_{identifier(method.owner)}.{method.attribute}", pou.pos)
        for action, declaring in own.actions.items():
            if declaring != own.key:
                self.out.line(f"a_{action} = B_{identifier(declaring)}.a_{action}", pou.pos)

    @staticmethod
    def _without_call(pou: t.Pou, symbols: dict[str, Symbol]) -> dict[str, Symbol]:
        """Return the variables that exist only while the body of the POU is executed, as methods see them."""
        found = {}
        for block in pou.blocks:
            for v in block.variables if block.kind in ("VAR_IN_OUT", "VAR_TEMP") else ():
                symbol = symbols.get(v.name.lower())
                if symbol is not None:
                    owner = declared_name(pou.name)
                    reason = f"{v.name} is a {block.kind} of {owner} and does not exist while a method is executed"
                    found[v.name.lower()] = replace(symbol, refused=reason)
        return found

    def note_parts(self, pou: t.Pou, symbols: dict[str, Symbol]) -> None:
        """Add the function blocks that a POU contains to those that it may call."""
        for kind, v in (
            (symbols[v.name.lower()].type, v) for b in pou.blocks for v in b.variables if v.name.lower() in symbols
        ):
            if by_reference(kind) and isinstance(kind, ty.Block):
                self.env.calls.setdefault(pou.name.lower(), {}).setdefault(kind.name.lower(), v.pos)


class Blocks(Bodies):
    """The compiler of the function blocks and classes of a unit."""

    def __init__(self, variables: Variables, functions: Functions) -> None:
        super().__init__(variables, functions)
        self.kept: dict[str, tuple[tuple[str, ty.Type], ...]] = {}
        """By function block: its variables that keep their values."""
        self.recorded: dict[str, Recorded] = {}
        """By class of a function block: the attributes of its outputs, of its variables at %Q*, and of its arrays."""

    def write(self, pou: t.Pou) -> None:
        """Write the Python class of a FUNCTION_BLOCK or CLASS."""
        symbols = self.env.symbols[pou.name.lower()] = self.variables.symbols_of(pou, "self.")
        self.note_parts(pou, symbols)
        held = [s for s in symbols.values() if s.code.startswith("self.")]
        kept = [s.code.split(".")[1] for s in held]
        in_outs = [f"v_{v.name.lower()}" for b in pou.blocks if b.kind == "VAR_IN_OUT" for v in b.variables]
        kind = self.declarations.named(pou.name, pou.pos)
        number = ("number",) if isinstance(kind, ty.Block) and kind.interfaces else ()
        self.kept[pou.name.lower()] = tuple(
            (s.name, s.type)
            for s, attribute in zip(held, kept, strict=True)
            if attribute not in in_outs and not s.is_constant
        )
        with self.out.block(f"class {self._class_of(pou, symbols, kept, in_outs)}:", pou.pos):
            self.out.line(f"__slots__ = {(*kept, *number)}")
            self.out.line(f"in_outs = {(*in_outs, *number)}")
            self.out.line(f"name = {pou.name!r}")
            self.out.line(f"retain = {self._marked(pou, symbols, 'RETAIN', 'PERSISTENT')}")
            self.out.line(f"non_retain = {self._marked(pou, symbols, 'NON_RETAIN')}")
            if isinstance(kind, ty.Block):
                self.out.line(f"kinds = {(pou.name.lower(), *sorted(kind.bases | kind.interfaces))}")
            with self.out.block("def __init__(self):"):
                self.variables.initialise(
                    pou, symbols, ("VAR", "VAR_INPUT", "VAR_OUTPUT", *self._kept_temporaries(pou))
                )
                for attribute in in_outs:
                    self.out.line(f"self.{attribute} = None")
                for attribute in number:
                    self.out.line(f"self.{attribute} = _c.number()")
            self.write_methods(pou, symbols)
            if pou.kind == "FUNCTION_BLOCK":
                with self.out.block("def execute(self, now_ns):"):
                    self.out.step(pou.pos)
                    self.variables.initialise(pou, symbols, ("VAR_TEMP",))
                    self.body_of(pou, symbols, pou.name.lower()).body(pou.body)
            self.write_actions(pou, symbols)
            if isinstance(kind, ty.Block) and kind.created:
                self._write_creation(pou, kind)

    def _write_creation(self, pou: t.Pou, kind: ty.Block) -> None:
        """Write the method that calls FB_init of a new instance: first that of its base, then its own."""
        own = self.env.classes[pou.name.lower()]
        method = own.of("METHOD", FB_INIT)
        if method is None:  # it has an error
            return
        if method.owner != pou.name:
            self.out.line(f"created = B_{identifier(method.owner)}.created", pou.pos)
            return
        parameters = self.declarations.creation(kind)
        names = [f"v_{v.name.lower()}" for v in parameters]
        initials = {p.name.lower(): p.initial for p in method.signature.inputs}
        given = [
            name if v.initial is None else f"{name}={initials[v.name.lower()]}"
            for name, v in zip(names, parameters, strict=True)
        ]
        with self.out.block(
            f"def created(self, *{', '.join(['', *given])}):" if given else "def created(self):", method.pos
        ):
            base = own.ancestors[0].type if own.ancestors else None
            if isinstance(base, ty.Block) and base.created:
                needed = self.declarations.needed(base)
                missing = [name for name in needed if f"v_{name.lower()}" not in names]
                if missing:
                    message = f"{FB_INIT} of {pou.name} has no input {missing[0]}, which {FB_INIT} of {base} has"
                    self.env.fail(method.pos, message, expected=", ".join((*FIXED, *needed)))
                of_base = {f"v_{v.name.lower()}" for v in self.declarations.creation(base)}
                handed = ", ".join(f"{name}={name}" for name in names if name in of_base)
                self.out.line(f"B_{identifier(base.name)}.created(self{', ' if handed else ''}{handed})", method.pos)
            note = self.env.calls.setdefault(pou.name.lower(), {})
            note.setdefault(method.key, method.pos)
            self.out.line(
                f"B_{identifier(pou.name)}.{method.attribute}({', '.join(['self', 'True', 'False', *names])})",
                method.pos,
            )
            self.out.line("return self", method.pos)

    def _class_of(self, pou: t.Pou, symbols: dict[str, Symbol], kept: list[str], in_outs: list[str]) -> str:
        """Return the head of the class of a POU. The lines of the last assignments of its outputs, of its variables at %Q* and
        of elements of its arrays are in a base class, because they do not belong to the state.
        """
        name = f"B_{identifier(pou.name)}"
        variables = [(v, block) for block in pou.blocks for v in block.variables]
        wanted = {f"v_{v.name.lower()}" for v, b in variables if b.kind == "VAR_OUTPUT" or area_of(v.location) == "Q"}
        arrays = {f"v_{key}" for key, symbol in symbols.items() if is_recorded(symbol.type)}
        recorded = Recorded(
            frozenset(wanted.intersection(kept) - arrays),
            frozenset(arrays.intersection(kept).difference(in_outs)),
            frozenset(arrays.intersection(in_outs)),
        )
        if recorded == Recorded():
            return name
        self.recorded[name] = recorded
        with self.out.block(f"class L_{identifier(pou.name)}:", pou.pos):
            self.out.line(f"__slots__ = {recorded.slots()}")
        return f"{name}(L_{identifier(pou.name)})"

    def _marked(self, pou: t.Pou, symbols: dict[str, Symbol], *words: str) -> tuple[str, ...]:
        """Return the attributes of the variables in blocks with one of these qualifiers."""
        found = []
        for block in pou.blocks:
            for v in block.variables if block.qualifiers & set(words) and "CONSTANT" not in block.qualifiers else ():
                symbol = symbols.get(v.name.lower())
                if symbol is None or not symbol.code.startswith("self."):
                    continue
                if "RETAIN" in words and (isinstance(symbol.type, ty.Pointer) or ty.holds_interface(symbol.type)):
                    hint = "a restart creates new instances, so assign the reference again"
                    self.env.collected(self.env.error(v.pos, f"{v.name}, a {symbol.type}, cannot be RETAIN", hint=hint))
                found.append(symbol.code.removeprefix("self."))
        return tuple(found)

    def _kept_temporaries(self, pou: t.Pou) -> tuple[str, ...]:
        """Return VAR_TEMP if the POU has actions: one may be called before the POU, so the variables have to exist."""
        return ("VAR_TEMP",) if pou.actions else ()
