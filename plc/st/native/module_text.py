"""The text of the C module of a unit: structures, tables of their fields, the translated functions, and what Python calls."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from importlib.resources import files

from fieldtwin.plc.st.context import Context
from fieldtwin.plc.st.native.layouts import Field, Layout
from fieldtwin.plc.st.native.statements import Translation

MODULE = "fieldtwin_machine_code"
_KINDS = {"bool": "BOOL", "int": "INT", "float": "FLOAT", "optional": "OPTIONAL"}
_CONTEXT = Layout(
    "Context", {name: Field(name, "int") for name in ("now_ns", "left", "scan")}, tuple(sorted(Context.__slots__))
)
_CONTEXT.fields["first_scan"] = Field("first_scan", "bool")
_FIRST = 2
"""The number of the first class after the context and the global variables."""


@dataclass(frozen=True, slots=True)
class Run:
    """Statements of a PROGRAM that were translated to the C function `c_name`, and the attributes that they use."""

    c_name: str
    layout: Layout
    used: frozenset[tuple[str, str]]


class ModuleText:
    """The writer of the C module for the `runs` of a unit."""

    def __init__(self, translation: Translation, runs: Sequence[Run]) -> None:
        self._translation, self._runs = translation, runs
        programs = {run.layout.name: run.layout for run in runs}
        self._globals = translation.layouts.globals
        for layout in (*programs.values(), self._globals):
            for one in layout.fields.values():
                if one.kind in ("block", "blocks"):
                    translation.structure(one.of)
        self.classes = [*translation.structures.values(), *programs.values()]
        """The classes whose objects are read and written, in the order of `bind`."""
        self._numbers = {layout.name: n for n, layout in enumerate(self.classes, _FIRST)}
        self._objects: dict[str, int] = {}
        """By structure: the number of Python objects that its variables are."""
        for layout in (*self.classes, self._globals, _CONTEXT):
            parts = sum(self._objects_of(one) for one in layout.parts())
            self._objects[layout.name] = len(layout.row()) + parts

    def _objects_of(self, one: Field) -> int:
        if one.kind == "block":
            return self._objects[one.of]
        if one.kind == "blocks":
            return one.size * self._objects[one.of]
        return one.size if one.kind == "array" else 0

    def text(self) -> str:
        blocks = len(self._translation.structures)
        layouts = [_CONTEXT, *self.classes[:blocks], self._globals, *self.classes[blocks:]]
        parts = [
            files("fieldtwin.plc.st.native").joinpath("runtime.h").read_text(encoding="ascii"),
            *(self._structure(layout) for layout in layouts),
            *(self._class(layout) for layout in layouts),
            self._tables(),
            *self._translation.texts,
            *(self._run(run) for run in self._runs),
            self._module(),
        ]
        return "\n".join(parts)

    def _structure(self, layout: Layout) -> str:
        row = "".join(
            f"  {_of_kind(one.kind)} {one.c_name};\n" if one else f"  int64_t gap_{n};\n"
            for n, one in enumerate(layout.row())
        )
        others = "".join(f"  {_member(one)};\n" for one in (*layout.parts(), *layout.lines()))
        return f"struct S_{layout.name} {{\n  PyObject *object;\n{row}{others}}};\n"

    def _class(self, layout: Layout) -> str:
        """Return the tables of a class: the kinds of its row, its parts, its names, and a table for its slots."""
        row, parts, lines = layout.row(), layout.parts(), layout.lines()
        kinds = "".join(f"{_KINDS[one.kind] if one else 'NOTHING'}, " for one in row)
        table, objects = "", len(row)
        for one in parts:
            table += f"  {self._part(layout, one, objects)},\n"
            objects += self._objects_of(one)
        names = "".join(f'"{one.name if one else ""}", ' for one in (*row, *parts, *lines))
        return (
            f"static const uint8_t K_{layout.name}[] = {{{kinds}0}};\n"
            f"static const struct Part P_{layout.name}[] = {{\n{table}  {{0}}\n}};\n"
            f"static const char *const N_{layout.name}[] = {{{names}NULL}};\n"
            f"static Py_ssize_t O_{layout.name}[{len(row) + len(parts) + len(lines) + 1}];\n"
        )

    def _part(self, layout: Layout, one: Field, objects: int) -> str:
        kind = "RECORD" if one.kind == "line" else one.kind.upper()
        of = _KINDS[one.of] if one.kind == "array" else "0"
        block = self._numbers[one.of] if one.kind in ("block", "blocks") else 0
        return f"{{{kind}, {of}, {block}, {one.size}, {objects}, offsetof(struct S_{layout.name}, {one.c_name})}}"

    def _tables(self) -> str:
        layouts = [_CONTEXT, self._globals, *self.classes]
        rows = "".join(f"  {{{self._entry(one)}}},\n" for one in layouts)
        return f"static const struct Class TABLE[] = {{\n{rows}}};\nenum {{ COUNT = {len(layouts)} }};\n"

    def _entry(self, of: Layout) -> str:
        parts, lines = of.parts(), of.lines()
        counts = f"{len(of.row())}, {_read(parts)}, {len(parts)}, {len(lines)}, {self._objects[of.name]}"
        first_line = f"offsetof(struct S_{of.name}, {lines[0].c_name})" if lines else "0"
        tables = ", ".join(f"{table}_{of.name}" for table in "KPNO")
        return f"{counts}, sizeof(struct S_{of.name}), {first_line}, {tables}"

    def _run(self, run: Run) -> str:
        name, layout = run.c_name, run.layout
        number, objects = self._numbers[layout.name], max(self._objects[layout.name], 1)
        shared = max(self._objects["globals"], 1)
        in_context = len(_CONTEXT.row())
        forgotten = (("s", "now", objects), ("g", "g_now", shared), ("c", "c_now", in_context))
        forget = " ".join(f"forget(&{of}, sizeof {now}, {count});" for of, now, count in forgotten)
        return f"""
{_use(f"U_{name}", layout, {attribute for owner, attribute in run.used if owner == "self"})}
{_use(f"UG_{name}", self._globals, {attribute for owner, attribute in run.used if owner == "_G"}, has_slots=False)}
static PyObject *run_{name}(PyObject *capsule, PyObject *const *given, Py_ssize_t count) {{
  static struct S_{layout.name} now, old;
  static struct S_globals g_now, g_old;
  static struct S_Context c_now, c_old;
  static PyObject *objects[{objects}], *g_objects[{shared}], *c_objects[{in_context}];
  const struct Values s = {{(char *)&now, (char *)&old, objects}}, g = {{(char *)&g_now, (char *)&g_old, g_objects}};
  const struct Values c = {{(char *)&c_now, (char *)&c_old, c_objects}};
  const struct Bound *b = PyCapsule_GetPointer(capsule, "{MODULE}");
  if (b == NULL || count != 3) return NULL;
  if (objects[0] == NULL) {{ {forget} }}
  if (load(b, 0, NULL, given[1], &c) || load(b, {number}, &U_{name}, given[0], &s)
      || load_globals(b, &UG_{name}, given[2], &g)) Py_RETURN_NONE;
  int result = {name}(&now, &c_now, &g_now);
  if (result != 1) {{
    int64_t scan = c_now.f_scan;
    PyObject *published = PyObject_GetAttrString(given[1], "published");
    struct Publication p;
    int is_published = published && PyTuple_CheckExact(published);
    if (is_published) p = (struct Publication){{PyTuple_GET_ITEM(published, 0), PyTuple_GET_ITEM(published, 1)}};
    if (published && store({number}, &U_{name}, given[0], &s, scan, is_published ? &p : NULL) == 0
        && store_globals(&UG_{name}, given[2], &g, scan) == 0 && store(0, NULL, given[1], &c, scan, NULL) == 0
        && (!is_published || PyObject_SetAttrString(given[1], "published", Py_None) == 0)) {{
      Py_DECREF(published);
      return PyBool_FromLong(result == 2);
    }}
    Py_XDECREF(published);
  }}
  {forget}
  if (result != 1) return NULL;
  Py_RETURN_NONE;
}}
static PyMethodDef M_{name} = {{"{name}", (PyCFunction)(void (*)(void))run_{name}, METH_FASTCALL, NULL}};
"""

    def _module(self) -> str:
        runs = ", ".join([*(f"&M_{run.c_name}" for run in self._runs), "NULL"])
        return f"""
static PyMethodDef *RUNS[] = {{{runs}}};
static void release(PyObject *capsule) {{
  struct Bound *b = PyCapsule_GetPointer(capsule, "{MODULE}");
  for (int n = 0; b && n < COUNT; n++) Py_XDECREF((PyObject *)b->types[n]);
  if (b) {{ PyMem_Free(b->types); PyMem_Free(b); }}
}}
/* bind(types, constants): return a function for each run; `types` are the classes in the order of TABLE, `constants` a tuple. */
static PyObject *bind(PyObject *module, PyObject *given) {{
  PyObject *types, *constants;
  (void)module;
  if (!PyArg_ParseTuple(given, "O!O!", &PyTuple_Type, &types, &PyTuple_Type, &constants)) return NULL;
  if (PyTuple_GET_SIZE(types) != COUNT) {{ PyErr_SetString(PyExc_ValueError, "the number of classes"); return NULL; }}
  struct Bound *b = PyMem_Calloc(1, sizeof *b);
  if (b == NULL || (b->types = PyMem_Calloc(COUNT, sizeof *b->types)) == NULL) return PyErr_NoMemory();
  PyObject *capsule = PyCapsule_New(b, "{MODULE}", release), *runs = PyList_New(0);
  if (!capsule || !runs) return NULL;
  CLASSES = TABLE;
  for (int n = 0; n < COUNT; n++) {{
    PyObject *type = PyTuple_GET_ITEM(types, n);
    if (type == Py_None) continue;
    b->types[n] = (PyTypeObject *)Py_NewRef(type);
    if (find_slots(type, &TABLE[n])) return NULL;
  }}
  if (CONSTANTS == NULL) {{
    CONSTANTS = ((PyTupleObject *)Py_NewRef(constants))->ob_item;
  }}
  for (int n = 0; RUNS[n]; n++) {{
    PyObject *run = PyCFunction_New(RUNS[n], capsule);
    if (!run || PyList_Append(runs, run)) return NULL;
    Py_DECREF(run);
  }}
  Py_DECREF(capsule);
  return runs;
}}
static PyMethodDef METHODS[] = {{{{"bind", bind, METH_VARARGS, NULL}}, {{NULL, NULL, 0, NULL}}}};
static struct PyModuleDef DEFINITION = {{PyModuleDef_HEAD_INIT, "{MODULE}", NULL, -1, METHODS, NULL, NULL, NULL, NULL}};
PyMODINIT_FUNC PyInit_{MODULE}(void) {{ return PyModule_Create(&DEFINITION); }}
"""


def _use(name: str, layout: Layout, used: set[str], *, has_slots: bool = True) -> str:
    """Return the C table of the variables of a structure that a run uses; without numbers if it uses all values of slots."""
    found = (layout.row(), layout.parts(), layout.lines())
    values = [one for one in (*found[0], *found[1]) if one is not None and one.kind not in ("line", "lines")]
    uses_all = has_slots and all(one.name in used for one in values)
    row, parts, lines = (
        [n for n, one in enumerate(each) if uses_all or (one is not None and one.name in used)] for each in found
    )
    counts = f"{len(row)}, {_read(found[1][n] for n in parts)}, {len(parts)}, {len(lines)}"
    if uses_all:
        return f"static const struct Use {name} = {{{counts}, NULL}};"
    numbers = ", ".join(map(str, [*row, *parts, *lines, 0]))
    return f"static const int N_{name}[] = {{{numbers}}};\nstatic const struct Use {name} = {{{counts}, N_{name}}};"


def _read(parts: Iterable[Field]) -> int:
    """Return how many parts are read; the others, which come after them, are records."""
    return sum(one.kind not in ("line", "lines") for one in parts)


def _of_kind(kind: str) -> str:
    """Return the C type of a variable in a structure, which always has 8 bytes."""
    return "double" if kind == "float" else "int64_t"


def _member(one: Field) -> str:
    if one.kind == "block":
        return f"struct S_{one.of} {one.c_name}"
    if one.kind == "blocks":
        return f"struct S_{one.of} {one.c_name}[{one.size}]"
    if one.kind == "array":
        return f"{_of_kind(one.of)} {one.c_name}[{one.size}]"
    if one.kind == "line":
        return f"struct {'Record' if one.values else 'Line'} {one.c_name}"
    size = max(one.size, 1)
    return f"struct {{ int32_t count; int32_t at[{size}]; struct Record records[{size}]; }} {one.c_name}"
