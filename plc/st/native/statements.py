"""Translates methods of blocks, FUNCTIONs, and runs of statements of a PROGRAM to C functions.

Each function returns 0, or 1 if Python must take over, or 2 if the statements of a PROGRAM ended with RETURN.
"""

from __future__ import annotations

import ast
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

from fieldtwin.plc.st.native.expressions import Expressions, Value, c_type
from fieldtwin.plc.st.native.layouts import Field, Layout, Layouts, Unsupported
from fieldtwin.plc.st.runtime.lines import RECORD_HEAD, is_line

RETURNED = 2


@dataclass(slots=True)
class Function:
    """A FUNCTION that was translated for arguments of certain kinds."""

    c_name: str
    result: str
    text: str


@dataclass(slots=True)
class Translation:
    """Everything that was translated of one unit: `texts` of C functions, each after those that it calls."""

    layouts: Layouts
    texts: list[str] = field(default_factory=list)
    constants: list[ast.expr] = field(default_factory=list)
    """The Python constants to which records refer by their number from 1."""
    functions: dict[tuple[str, tuple[str, ...]], Function] = field(default_factory=dict)
    blocks: dict[str, str] = field(default_factory=dict)
    """By structure: the C function that executes the block."""
    actions: dict[str, set[tuple[str, str]]] = field(default_factory=dict)
    """By C function of an ACTION: the attributes that it uses."""
    shared: set[tuple[str, str]] = field(default_factory=set)
    """The global variables that blocks and FUNCTIONs use."""
    structures: dict[str, Layout] = field(default_factory=dict)
    """The structures of the blocks, each after those that it contains."""
    _numbers: dict[str, int] = field(default_factory=dict)
    _active: set[str] = field(default_factory=set)

    def constant(self, node: ast.expr) -> int:
        key = ast.unparse(node)
        if key not in self._numbers:
            self.constants.append(node)
            self._numbers[key] = len(self.constants)
        return self._numbers[key]

    def structure(self, name: str) -> None:
        """Note that the structure of a block is used, and those of the blocks in it."""
        if name in self.structures:
            return
        layout = self.layouts.of(name)
        for one in layout.fields.values():
            if one.kind in ("block", "blocks"):
                self.structure(one.of)
        self.structures[name] = layout

    def block(self, name: str) -> str:
        """Return the C function that executes a block. Raises `Unsupported`."""
        if name not in self.blocks:
            self.structure(name)
            layout = self.layouts.of(name)
            method = layout.methods.get("execute")
            if method is None:
                raise Unsupported(f"a call of {name}")
            body = _Body(self, layout)
            for one in method.args.args[1:]:
                body.expressions.declare(one.arg, "int")
            text = body.text(method.body)
            self.shared |= {one for one in body.expressions.used if one[0] == "_G"}
            arguments = "".join(f", int64_t {one.arg}" for one in method.args.args[1:])
            self.texts.append(
                f"static int x_{name}(struct S_{name} *self, struct S_Context *c, struct S_globals *g{arguments}) {{\n"
                f"{body.declarations(one.arg for one in method.args.args)}{text}return 0; bail: return 1;\n}}\n"
            )
            self.blocks[name] = f"x_{name}"
        return self.blocks[name]

    def action(self, layout: Layout, name: str) -> tuple[str, set[tuple[str, str]]]:
        """Return the C function of an ACTION, and the attributes that it uses. Raises `Unsupported`."""
        c_name = f"a_{layout.name}_{name}"
        if c_name not in self.actions:
            method = layout.methods.get(name)
            if method is None or len(method.args.args) != 1 or c_name in self._active:
                raise Unsupported(f"a call of {name.partition('_')[2]}")
            self._active.add(c_name)
            try:
                body = _Body(self, layout)
                text = body.text(method.body)
            finally:
                self._active.discard(c_name)
            self.texts.append(
                f"static int {c_name}(struct S_{layout.name} *self, struct S_Context *c, struct S_globals *g) {{\n"
                f"{body.declarations(())}{text}return 0; bail: return 1;\n}}\n"
            )
            self.actions[c_name] = body.expressions.used
        return c_name, self.actions[c_name]

    def function(self, name: str, kinds: tuple[str, ...]) -> Function:
        """Return a FUNCTION for arguments of these kinds. Raises `Unsupported`."""
        key = (name, kinds)
        if key not in self.functions:
            node = self.layouts.functions.get(name)
            if node is None or name in self._active or node.args.defaults or len(node.args.args) != len(kinds):
                raise Unsupported(f"the function {name.partition('_')[2]}")
            self._active.add(name)
            try:
                body = _Body(self, None)
                names = [one.arg for one in node.args.args]
                for one, kind in zip(names, kinds, strict=True):
                    body.expressions.declare(one, kind)
                text = body.text(node.body)
                self.shared |= body.expressions.used
            finally:
                self._active.discard(name)
            if not body.result:
                raise Unsupported(f"the function {name.partition('_')[2]}, which has no result")
            c_name = "_".join([name, *kinds])
            arguments = "".join(f", {c_type(kind)} {one}" for one, kind in zip(names, kinds, strict=True))
            head = f"static int {c_name}(struct S_Context *c, struct S_globals *g, {c_type(body.result)} *result{arguments})"
            made = f"{head} {{\n{body.declarations(names)}{text}return 0; bail: return 1;\n}}\n"
            self.functions[key] = Function(c_name, body.result, made)
            self.texts.append(made)
        return self.functions[key]

    def run(self, c_name: str, layout: Layout, statements: Sequence[ast.stmt]) -> set[tuple[str, str]]:
        """Translate statements of a PROGRAM to the C function `c_name`. Return the attributes that they use.

        Raises `Unsupported`.
        """
        body = _Body(self, layout, returned=RETURNED)
        text = body.text(statements)
        self.texts.append(
            f"static int {c_name}(struct S_{layout.name} *self, struct S_Context *c, struct S_globals *g) {{\n"
            f"{body.declarations(())}{text}return 0; bail: return 1;\n}}\n"
        )
        return body.expressions.used | self.shared


class _Body:
    """The translator of the statements of one function. `layout` is the structure that ``self`` is, if there is one."""

    def __init__(self, unit: Translation, layout: Layout | None, returned: int = 0) -> None:
        self._unit, self._layout, self._returned = unit, layout, returned
        self.expressions = Expressions(unit.layouts, layout, self._call)
        self.result = ""
        """The kind of the result of a FUNCTION."""
        self._loops: list[str] = []
        """The labels at which the loops around a statement continue."""
        self._labels = 0

    def text(self, statements: Sequence[ast.stmt]) -> str:
        return "".join(self._statement(one) for one in statements)

    def declarations(self, parameters: Iterable[str]) -> str:
        """Return the declarations of the C variables that are not parameters."""
        given = set(parameters)
        kinds = self.expressions.locals
        made = "".join(f"{c_type(kind)} {name} = 0;\n" for name, kind in kinds.items() if name not in given)
        ranges = sorted(self.expressions.ranges)
        made += "".join(f"struct S_{of} *{name} = NULL;\n" for name, of in self.expressions.objects.items())
        return made + "".join(f"int64_t {one}_start = 0, {one}_step = 1, {one}_count = 0;\n" for one in ranges)

    def _statement(self, node: ast.stmt) -> str:
        made = getattr(self, f"_{type(node).__name__.lower()}", None)
        if made is None:
            raise Unsupported(f"the Python statement {type(node).__name__}")
        found: str = made(node)
        return found

    # -- assignments --------------------------------------------------------------------------------------------------

    def _assign(self, node: ast.Assign) -> str:
        target, value = node.targets[0], node.value
        if isinstance(target, ast.Name) and isinstance(value, ast.Call) and _range_of(value):
            return self._range(target.id, value)
        if isinstance(target, ast.Tuple):
            if not isinstance(value, ast.Tuple) or len(value.elts) != len(target.elts):
                raise Unsupported(ast.unparse(node))
            self._labels += 1
            names = [f"t{self._labels}_{n}" for n in range(len(value.elts))]
            values = [self.expressions.value(each) for each in value.elts]  # computed before the first assignment
            text = "".join(f"{c_type(v.kind)} {name} = {v.text};\n" for name, v in zip(names, values, strict=True))
            pairs = zip(target.elts, names, values, strict=True)
            return f"{{ {text}{''.join(self._set(one, Value(name, v.kind)) for one, name, v in pairs)} }}\n"
        if isinstance(target, ast.Name) and (named := self.expressions.named(target.id, value)):
            return named
        if isinstance(target, ast.Attribute) and is_line(target.attr):
            return self._line(target, value)
        if isinstance(target, ast.Subscript) and isinstance(target.value, ast.Attribute) and is_line(target.value.attr):
            return self._element_line(target, value)
        return self._set(target, self.expressions.value(value))

    def _set(self, target: ast.expr, value: Value) -> str:
        if isinstance(target, ast.Name):
            self.expressions.declare(target.id, value.kind)
            return f"{target.id} = {value.text};\n"
        if isinstance(target, ast.Subscript):
            text, field = self.expressions.element(target)
            kind = field.of
            # Python computes the value first, and an index outside the array ends the statement before it assigns.
            given = f"{c_type(kind)} given_ = {value.text}; {text} = given_;"
        elif isinstance(target, ast.Attribute):
            if isinstance(target.value, ast.Name) and target.value.id == "_c":
                if target.attr != "left":
                    raise Unsupported(ast.unparse(target))
                return f"c->f_left = {value.text};\n"
            text, field = self.expressions.place(target)
            kind, given = field.kind, f"{text} = {value.text};"
        else:
            raise Unsupported(f"an assignment to {ast.unparse(target)}")
        if value.kind != kind and not (kind == "optional" and value.kind == "int"):
            raise Unsupported(f"a {value.kind} assigned to {ast.unparse(target)}")
        return f"{{ {given} }}\n"

    def _augassign(self, node: ast.AugAssign) -> str:
        read = ast.parse(ast.unparse(node.target), mode="eval").body
        return self._set(node.target, self.expressions.value(ast.BinOp(read, node.op, node.value)))

    # -- records of assignments ---------------------------------------------------------------------------------------

    def _line(self, target: ast.Attribute, value: ast.expr) -> str:
        text, field = self.expressions.place(target)
        if field.kind != "line":
            raise Unsupported(ast.unparse(target))
        return self._record(f"(&{text})", field, value)

    def _element_line(self, target: ast.Subscript, value: ast.expr) -> str:
        assert isinstance(target.value, ast.Attribute)
        text, field = self.expressions.place(target.value)
        _, layout = self.expressions.object(target.value.value)
        array = layout.fields.get(target.value.attr.removeprefix("line_"))
        if field.kind != "lines" or array is None or array.kind != "array":
            raise Unsupported(ast.unparse(target))
        field.size = array.size
        at = self.expressions.of_kind(target.slice, "int")
        index = f"({{ int64_t at = {at}; if (at < 0 || at >= {array.size}) goto bail; at; }})"
        if not isinstance(value, ast.Tuple) or _is_constant(value):
            raise Unsupported("a record without the number of the scan")
        return self._record(f"record_at((struct Lines *)&{text}, {array.size}, {index})", field, value)

    def _record(self, line: str, field: Field, value: ast.expr) -> str:
        """Translate a record: a constant, or the number of the scan, a constant, the object, and values of indices."""
        if isinstance(value, ast.Constant) or (isinstance(value, ast.Tuple) and _is_constant(value)):
            return f"{line}->code = -{self._unit.constant(value)};\n"
        maker = ast.unparse(value.elts[2]) if isinstance(value, ast.Tuple) else ""
        if not isinstance(value, ast.Tuple) or ast.unparse(value.elts[0]) != "_c.scan" or maker not in ("self", "None"):
            raise Unsupported("a record of an assignment")
        given = [self.expressions.value(each) for each in value.elts[RECORD_HEAD:]]
        if any(each.kind != "int" for each in given):
            raise Unsupported("an index that is not an integer")
        field.values = max(field.values, 1, len(given))
        code = self._unit.constant(value.elts[1])
        texts = [f"record_->values[{n}] = {each.text};" for n, each in enumerate(given)]
        of = "(PyObject *)self->object" if maker == "self" else "NULL"
        body = f"record_->code = {code}; record_->maker = {of}; record_->count = {len(given)}; {' '.join(texts)}"
        return f"{{ struct Record *record_ = {line}; {body} }}\n"

    # -- control ------------------------------------------------------------------------------------------------------

    def _if(self, node: ast.If) -> str:
        text = f"if ({self.expressions.condition(node.test)}) {{\n{self.text(node.body)}}}\n"
        return text + (f"else {{\n{self.text(node.orelse)}}}\n" if node.orelse else "")

    def _while(self, node: ast.While) -> str:
        if node.orelse:
            raise Unsupported("WHILE with a remainder")
        label = self._label()
        self._loops.append(label)
        text = f"while ({self.expressions.condition(node.test)}) {{\n{self.text(node.body)}{label}:;\n}}\n"
        self._loops.pop()
        return f"{{ int done_{label} = 1;\n{text} }}\n"

    def _range(self, name: str, call: ast.Call) -> str:
        function, arguments = _range_of(call), list(call.args)
        if function == "range" and len(arguments) == 2:
            step = "INT64_C(1)"
        elif len(arguments) == 3:
            step = self.expressions.of_kind(arguments[2], "int")
        else:
            raise Unsupported("a FOR")
        first, last = (self.expressions.of_kind(each, "int") for each in arguments[:2])
        if function == "_v.steps":
            last = f"({last} + ({step} > 0 ? 1 : -1))"
        self.expressions.ranges.add(name)
        if name in self.expressions.locals:
            raise Unsupported(f"{name} with values of several kinds")
        return f"if (!range_of({first}, {last}, {step}, &{name}_start, &{name}_step, &{name}_count)) goto bail;\n"

    def _for(self, node: ast.For) -> str:
        of, control = node.iter, ""
        if isinstance(of, ast.Call) and ast.unparse(of.func) == "_v.unaltered" and isinstance(of.args[1], ast.Lambda):
            control, of = self.expressions.of_kind(of.args[1].body, "int"), of.args[0]
        name = of.id if isinstance(of, ast.Name) else ""
        if name not in self.expressions.ranges:
            raise Unsupported("a FOR")
        label = self._label()
        done = f"done_{label}"
        self._loops.append(label)
        number = f"n_{label}"
        value = Value(f"({name}_start + {number} * {name}_step)", "int")
        body = f"{self._set(node.target, value)}{self.text(node.body)}{label}:;\n"
        self._loops.pop()
        if control:
            body += f"if ({control} != {value.text}) goto bail;\n"
        after = self.text(node.orelse)
        loop = (
            f"int64_t {number}; int {done} = 1;\nfor ({number} = 0; {number} < {name}_count; {number}++) {{\n{body}}}\n"
        )
        if after:
            loop += f"if ({done}) {{\n{after}}}\n"
        return f"{{ {loop} }}\n"

    def _label(self) -> str:
        self._labels += 1
        return f"next_{self._labels}"

    def _break(self, _: ast.Break) -> str:
        return f"{{ done_{self._loops[-1]} = 0; break; }}\n"

    def _continue(self, _: ast.Continue) -> str:
        return f"goto {self._loops[-1]};\n"

    def _pass(self, _: ast.Pass) -> str:
        return ";\n"

    def _return(self, node: ast.Return) -> str:
        if node.value is None:
            return f"return {self._returned};\n"
        if self._layout is not None:
            raise Unsupported("a result")
        found = self.expressions.value(node.value)
        if found.kind not in ("bool", "int", "float") or (self.result or found.kind) != found.kind:
            raise Unsupported("a result of several kinds")
        self.result = found.kind
        return f"{{ *result = {found.text}; return 0; }}\n"

    # -- calls --------------------------------------------------------------------------------------------------------

    def _expr(self, node: ast.Expr) -> str:
        call = node.value
        if isinstance(call, ast.Constant):
            return ""
        if not isinstance(call, ast.Call):
            raise Unsupported(ast.unparse(node))
        if ast.unparse(call.func) == "_c.too_long":
            return "goto bail;\n"
        if isinstance(call.func, ast.Attribute) and call.func.attr == "execute":
            text, layout = self.expressions.object(call.func.value)
            function = self._unit.block(layout.name)
            arguments = "".join(f", {self.expressions.of_kind(each, 'int')}" for each in call.args)
            return f"if ({function}(&{text}, c, g{arguments})) goto bail;\n"
        if isinstance(call.func, ast.Attribute) and ast.unparse(call.func.value) == "self" and self._layout is not None:
            if call.args or call.keywords:
                raise Unsupported(f"a call of {call.func.attr.partition('_')[2]}")
            action, used = self._unit.action(self._layout, call.func.attr)
            self.expressions.used |= used
            return f"if ({action}(self, c, g)) goto bail;\n"
        if ast.unparse(call.func) in ("_v.put", "_v.fill"):
            raise Unsupported("the assignment of a structure or array as a whole")
        raise Unsupported(f"the call {ast.unparse(call)}")

    def _call(self, name: str, arguments: list[Value]) -> Value:
        if any(each.kind == "optional" for each in arguments):
            raise Unsupported("an argument that may be None")
        function = self._unit.function(name, tuple(each.kind for each in arguments))
        given = "".join(f", {each.text}" for each in arguments)
        kind = c_type(function.result)
        text = f"({{ {kind} result_; if ({function.c_name}(c, g, &result_{given})) goto bail; result_; }})"
        return Value(text, function.result)


def _range_of(call: ast.Call) -> str:
    name = ast.unparse(call.func)
    return name if name in ("range", "_v.steps") else ""


def _is_constant(node: ast.expr) -> bool:
    return all(isinstance(each, ast.Constant) for each in node.elts) if isinstance(node, ast.Tuple) else False
