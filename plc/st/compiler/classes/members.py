"""Selects the methods and properties to which references refer (IEC 61131-3:2013, 6.6.5.4 to 6.6.5.10).

``Start()``, ``THIS.Start()``, ``SUPER.Start()``, ``pump.Start()``, and the same through a variable of an interface type.
"""

from __future__ import annotations

from dataclasses import dataclass

from fieldtwin.plc.st import types as ty
from fieldtwin.plc.st.compiler.scope import Class, Compiling, Method, Symbol, Value, identifier
from fieldtwin.plc.st.syntax import tree as t

THIS = ("this", "this^")
SUPER = ("super", "super^")


@dataclass(frozen=True, slots=True)
class Selected:
    """A selected method: the Python expression that is called, and its first argument if that is not bound to it."""

    method: Method
    code: str
    instance: str = ""

    def called(self, arguments: str = "") -> str:
        """Return the Python expression of the call with these arguments."""
        return f"{self.code}({', '.join(part for part in (self.instance, arguments) if part)})"


def is_own(x: Compiling, ref: t.Ref) -> bool:
    """Return whether a reference begins with THIS or SUPER. Raises `FileInvalid` where these are not allowed."""
    name = ref.name.lower()
    if name not in (*THIS, *SUPER) or name in x.symbols:
        return False
    if name.endswith("^") and not x.env.dialect.vendor:
        hint = "the dialects codesys and twincat write the mark ^"
        x.env.fail(ref.pos, ref.name, expected=name[:-1].upper(), hint=hint)
    if x.own is None or x.own.kind == "PROGRAM":
        x.env.fail(ref.pos, f"{ref.name} outside a FUNCTION_BLOCK or CLASS")
    if x.own.key in x.env.incomplete:
        raise x.env.following(x.own.name, ref.pos)
    if name in SUPER and not x.own.ancestors:
        x.env.fail(ref.pos, f"{ref.name} in {x.own.name}, which extends nothing")
    return True


def own_variable(x: Compiling, ref: t.Ref) -> tuple[Symbol | None, tuple[t.Selector, ...]]:
    """Return the variable that ``THIS.name`` or ``SUPER.name`` selects, and the other selectors. THIS alone is the instance."""
    assert x.own is not None
    first = ref.selectors[0] if ref.selectors else None
    if isinstance(first, t.Member):
        return x.own.variables.get(first.name.lower()), ref.selectors[1:]
    if ref.name.lower() in THIS and x.own.type is not None and first is None:
        return Symbol(ref.name, x.own.type, "self", writable=False), ()
    return None, ref.selectors


def class_of(x: Compiling, kind: ty.Type | None) -> Class | None:
    """Return the class of a function block type, class or interface; None for another type, or one without methods."""
    return x.env.classes.get(kind.name.lower()) if isinstance(kind, ty.Block | ty.Interface) else None


def method_of(x: Compiling, ref: t.Ref, kind: str) -> Method | None:
    """Return the method, GET or SET (`kind`) that `ref` selects, without compiling it; None if it selects something else."""
    if not ref.selectors:
        return x.own.of(kind, ref.name) if x.own is not None else None
    *before, last = ref.selectors
    if not isinstance(last, t.Member):
        return None
    if not before and is_own(x, ref):
        assert x.own is not None
        return (x.own if ref.name.lower() in THIS else x.own.ancestors[0]).of(kind, last.name)
    of = class_of(x, x.type_of(ref.without_last()))
    return of.of(kind, last.name) if of is not None else None


def selected(x: Compiling, ref: t.Ref, kind: str) -> Selected | None:
    """Compile the method, GET or SET (`kind`) that `ref` selects; return None if it selects something else.

    Lines of code that select the instance are written, so this is done once for each call. The call is added to those that must
    not be recursive. Raises `FileInvalid` if the method is not accessible.
    """
    if not ref.selectors:
        method = x.own.of(kind, ref.name) if x.own is not None else None
        return _own(x, method, ref.pos) if method is not None and x.own is not None else None
    *before, last = ref.selectors
    if not isinstance(last, t.Member):
        return None
    instance = ref.without_last()
    if not before and is_own(x, ref):
        return _of_own(x, ref, last, kind)
    of = class_of(x, x.type_of(instance))
    method = of.of(kind, last.name) if of is not None else None
    if of is None or method is None:
        return None
    check_access(x, method, last.pos)
    note(x, method.key, ref.pos, dynamic=of.kind == "INTERFACE")
    return Selected(method, f"{target(x, x.value(instance), instance)}.{method.attribute}")


def target(x: Compiling, value: Value, ref: t.Ref) -> str:
    """Return the Python expression of the instance whose method is called: `value`, or what an interface refers to."""
    if isinstance(value.type, ty.Interface):
        return f"_v.instance({value.code}, {ref.name!r})"
    return value.code


def property_value(x: Compiling, value: Value, ref: t.Ref, member: t.Member) -> Value | None:
    """Return the value of the property `member` of `value`, a part of `ref`; None if it has no such property."""
    of = class_of(x, value.type)
    if of is None:
        return None
    method = of.of("GET", member.name)
    if method is None:
        if of.of("SET", member.name) is not None:
            x.env.fail(member.pos, f"property {of.name}.{member.name} has no GET, so it cannot be read")
        return None
    check_access(x, method, member.pos)
    note(x, method.key, member.pos, dynamic=of.kind == "INTERFACE")
    return Value(f"{target(x, value, ref)}.{method.attribute}()", method.signature.returns)


def property_type(x: Compiling, kind: ty.Type | None, name: str) -> ty.Type | None:
    """Return the type of the property `name` of a class or interface without compiling it; None if it has none."""
    of = class_of(x, kind)
    return _type(of, name) if of is not None else None


def _type(of: Class, name: str) -> ty.Type | None:
    getter, setter = of.of("GET", name), of.of("SET", name)
    if getter is not None:
        return getter.signature.returns
    return setter.signature.inputs[0].type if setter is not None else None


def own_property_type(x: Compiling, ref: t.Ref) -> tuple[ty.Type | None, tuple[t.Selector, ...]]:
    """Return the type of the property of the class itself with which `ref` begins, and the selectors after it."""
    if x.own is None:
        return None, ref.selectors
    if not is_own(x, ref):
        return _type(x.own, ref.name), ref.selectors
    first = ref.selectors[0] if ref.selectors else None
    return (_type(x.own, first.name) if isinstance(first, t.Member) else None), ref.selectors[1:]


def own_property(x: Compiling, ref: t.Ref) -> tuple[Value, tuple[t.Selector, ...]] | None:
    """Return the value of a property of the class itself, and the selectors after it; None if `ref` does not begin with one."""
    if x.own is None:
        return None
    first = t.Ref(ref.pos, ref.name, ref.selectors[:1]) if is_own(x, ref) else t.Ref(ref.pos, ref.name)
    found = selected(x, first, "GET")
    if found is None:
        setter = selected(x, first, "SET")
        if setter is not None:
            x.env.fail(
                ref.pos,
                f"property {setter.method.owner}.{setter.method.signature.name} has no GET, so it cannot be read",
            )
        return None
    return Value(found.called(), found.method.signature.returns), ref.selectors[len(first.selectors) :]


def _own(x: Compiling, method: Method, pos: t.Pos) -> Selected:
    """Return a method of the class itself. An instance of a class that extends it may have overridden the method."""
    assert x.own is not None
    if method.access == "PRIVATE":
        check_access(x, method, pos)
    for one in (method, *(below.methods.get(method.attribute, method) for below in x.own.descendants)):
        note(x, one.key, pos)
    return Selected(method, f"self.{method.attribute}")


def _of_own(x: Compiling, ref: t.Ref, member: t.Member, kind: str) -> Selected | None:
    """Return the method that ``THIS.name`` or ``SUPER.name`` selects."""
    assert x.own is not None
    if ref.name.lower() in THIS:
        method = x.own.of(kind, member.name)
        return _own(x, method, ref.pos) if method is not None else None
    base = x.own.ancestors[0]
    method = base.of(kind, member.name)
    if method is None:
        return None
    if method.abstract:
        x.env.fail(member.pos, f"{ref.name}.{member.name}: {method} is ABSTRACT and has no statements")
    check_access(x, method, member.pos)
    note(x, method.key, ref.pos)
    return Selected(method, f"B_{identifier(method.owner)}.{method.attribute}", "self")


def check_access(x: Compiling, method: Method, pos: t.Pos) -> None:
    """Raise `FileInvalid` if the body that is being compiled may not call a method (6.6.5.10)."""
    inside = x.own is not None and x.own.key == method.owner.lower()
    below = x.own is not None and any(one.key == method.owner.lower() for one in x.own.ancestors)
    if method.access == "PRIVATE" and not inside:
        x.env.fail(pos, f"{method} is PRIVATE", hint=f"only {method.owner} itself can use it")
    if method.access == "PROTECTED" and not (inside or below):
        hint = f"only {method.owner} and the POUs that extend it can use it; METHOD PUBLIC can be called everywhere"
        x.env.fail(pos, f"{method} is PROTECTED", hint=hint)


def note(x: Compiling, name: str, pos: t.Pos, *, dynamic: bool = False) -> None:
    """Add a call to those that must not be recursive. A `dynamic` one depends on the instance, so it is limited at run time."""
    if not dynamic:
        x.env.calls.setdefault(x.pou, {}).setdefault(name, pos)
