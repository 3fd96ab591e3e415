/* What the machine code of a program needs: it is written before the translated functions of each unit. */
#define PY_SSIZE_T_CLEAN
#include <Python.h>
#include <structmember.h>
#include <float.h>
#include <math.h>
#include <stddef.h>
#include <stdint.h>
#if FLT_EVAL_METHOD != 0
#error "the compiler computes REAL with more digits than Python"
#endif

enum { NOTHING, BOOL, INT, FLOAT, OPTIONAL, BLOCK, BLOCKS, ARRAY, RECORD, LINES };
enum { MAX_VALUES = 8 };

/* The record of an assignment: 0 for none, -n for the constant number n. */
struct Line { int32_t code; };
/* The record of an assignment with values: also n for an assignment by the statement number n of `maker`; NULL for a FUNCTION, which has
   no object. */
struct Record { int32_t code, count; PyObject *maker; int64_t key; int64_t values[MAX_VALUES]; };
/* A block, an array, or a record with values: `kind` and `of`, the kind of its elements; their number; its class, if it is a block;
   the number of its first Python object; its place in the structure. */
struct Part { uint8_t kind, of; uint16_t block; uint32_t size, object, offset; };
/* A class. Its structure begins with the Python object. Then comes the row of the variables without parts: numbers of 8 bytes in the order of
   the slots of the Python object, which are consecutive too, so that a scan compares them in short loops. Another slot between them has
   the kind NOTHING. After the row come `parts`, of which the first `read` are read, and `lines` records without
   values, from `first_line`. `names` and `slots` are those of the row, the parts and the lines. `objects` is the number of Python
   objects of all values, those of the row first. */
struct Class {
  int row, read, parts, lines, objects;
  size_t size, first_line;
  const uint8_t *kinds;
  const struct Part *part;
  const char *const *names;
  Py_ssize_t *slots;
};
/* The variables that a run uses: how many of each kind, and their numbers in the row, then of parts, then of lines. Without numbers it
   uses all variables of the class. */
struct Use { int row, read, parts, lines; const int *numbers; };
/* The Python classes of one resource. */
struct Bound { PyTypeObject **types; };
/* The head of the records of the elements of an array. `at` has the number of the record of each element, from 1. */
struct Lines { int32_t count; int32_t at[]; };
#define RECORDS(lines, size) ((struct Record *)((char *)(lines) + ((4 + 4 * (size_t)(size) + 7) & ~(size_t)7)))

/* The variables of one object: `now` has the values with which machine code computes, `old` those of the Python object, and
   `objects` the Python objects of the values, or Ellipsis. A variable that still is the same Python object is not read again. */
struct Values { char *now, *old; PyObject **objects; };

static const struct Class *CLASSES;
static PyObject **CONSTANTS;

#define INLINE static inline __attribute__((always_inline))
#ifdef __clang__
#define FAST
#else
#define FAST __attribute__((optimize("O2")))
#endif
#define ROW(of) ((int64_t *)((of) + sizeof(PyObject *)))
#define SLOT(o, c, n) (*(PyObject **)((char *)(o) + (c)->slots[n]))
#define WITHIN(s, e) ((struct Values){(s)->now + (e)->offset, (s)->old + (e)->offset, (s)->objects + (e)->object})
#define ELEMENT(s, e, at) ((struct Values){ \
    (s)->now + (e)->offset + (at) * CLASSES[(e)->block].size, (s)->old + (e)->offset + (at) * CLASSES[(e)->block].size, \
    (s)->objects + (e)->object + (at) * CLASSES[(e)->block].objects})
#define CHECKED(op, a, b) ({ int64_t r_; if (__builtin_##op##_overflow((int64_t)(a), (int64_t)(b), &r_)) goto bail; r_; })
#define WITH(function, ...) ({ int bad_ = 0; int64_t value_ = function(&bad_, __VA_ARGS__); if (bad_) goto bail; value_; })

static inline int64_t divide(int *bad, int64_t a, int64_t b) {
  if (b == 0 || (b == -1 && a == INT64_MIN)) { *bad = 1; return 0; }
  return a / b;
}
static inline int64_t modulo(int *bad, int64_t a, int64_t b) {
  (void)bad;
  return b == 0 || b == -1 ? 0 : a % b;
}
static inline int64_t absolute(int *bad, int64_t a) {
  if (a == INT64_MIN) *bad = 1;
  return a < 0 ? (int64_t)(0 - (uint64_t)a) : a;
}
static inline int64_t inside(int *bad, int64_t x, int64_t low, int64_t high) {
  if (x < low || x > high) *bad = 1;
  return x;
}
static inline int64_t index_in(int *bad, int64_t i, int64_t low, int64_t high) {
  int64_t at = 0;
  if (i < low || i > high || __builtin_sub_overflow(i, low, &at)) *bad = 1;
  return at;
}
static inline int64_t shift_left(int *bad, int64_t x, int64_t n, int64_t bits) {
  if (n < 0 && n < bits) *bad = 1;
  return n < 0 || n >= bits ? 0 : (int64_t)(((uint64_t)x << n) & (((uint64_t)1 << bits) - 1));
}
static inline int64_t shift_right(int *bad, int64_t x, int64_t n, int64_t bits) {
  if (n < 0) *bad = 1;
  return n < 0 || n >= bits ? 0 : x >> n;
}
static inline int64_t rotate_left(int *bad, int64_t x, int64_t n, int64_t bits) {
  if (n < 0) { *bad = 1; return 0; }
  n %= bits;
  return (int64_t)(((uint64_t)x << n | (uint64_t)x >> (bits - n)) & (((uint64_t)1 << bits) - 1));
}
static inline int64_t rotate_right(int *bad, int64_t x, int64_t n, int64_t bits) {
  if (n < 0) { *bad = 1; return 0; }
  return rotate_left(bad, x, bits - n % bits, bits);
}
static inline int64_t set_part(int *bad, int64_t x, int64_t first, int64_t bits, int64_t part) {
  (void)bad;
  uint64_t mask = (((uint64_t)1 << bits) - 1) << first;
  return (int64_t)(((uint64_t)x & ~mask) | ((uint64_t)part << first));
}
/* `rounded` as an integer, if it is one between the limits, which are less than 2**62 or the limits of 64 bits. */
static inline int64_t whole(int *bad, double rounded, int64_t low, int64_t high) {
  if (!isfinite(rounded) || rounded < -0x1p63 || rounded >= 0x1p63) { *bad = 1; return 0; }
  return inside(bad, (int64_t)rounded, low, high);
}
static inline int range_of(int64_t start, int64_t stop, int64_t step, int64_t *first, int64_t *by, int64_t *count) {
  const int64_t most = INT64_C(1) << 60;
  if (step == 0 || start < -most || start > most || stop < -most || stop > most || step < -most || step > most) return 0;
  *first = start, *by = step;
  if (step > 0) *count = stop > start ? (stop - start + step - 1) / step : 0;
  else *count = stop < start ? (start - stop - step - 1) / -step : 0;
  return 1;
}
static inline struct Record *record_at(struct Lines *lines, int size, int64_t key) {
  if (!lines->at[key]) lines->at[key] = ++lines->count;
  struct Record *r = RECORDS(lines, size) + lines->at[key] - 1;
  r->key = key;
  return r;
}

/* Fill the table of the slots of a class. Return -1, with an exception, if they are not as expected. */
static int find_slots(PyObject *type, const struct Class *c) {
  for (int k = 0; k < c->row + c->parts + c->lines; k++) {
    const Py_ssize_t next = k ? c->slots[k - 1] + (Py_ssize_t)sizeof(PyObject *) : 0;
    if (!*c->names[k]) { c->slots[k] = next; continue; }
    PyObject *found = PyObject_GetAttrString(type, c->names[k]);
    if (found == NULL) return -1;
    PyMemberDef *member = Py_IS_TYPE(found, &PyMemberDescr_Type) ? ((PyMemberDescrObject *)found)->d_member : NULL;
    if (member) c->slots[k] = member->offset;
    Py_DECREF(found);
    if (member == NULL || member->type != T_OBJECT_EX || (0 < k && k < c->row && c->slots[k] != next)) {
      PyErr_Format(PyExc_TypeError, "%s is not the expected slot", c->names[k]);
      return -1;
    }
  }
  return 0;
}

static inline int load_value(int kind, PyObject *v, int64_t *to) {
  if (v == NULL) return 1;
  switch (kind) {
    case BOOL:
      if (v != Py_True && v != Py_False) return 1;
      *to = v == Py_True;
      return 0;
    case FLOAT:
      if (!PyFloat_CheckExact(v)) return 1;
      *(double *)to = PyFloat_AS_DOUBLE(v);
      return 0;
    default: {
      int overflow = 0;
      if (kind == OPTIONAL && v == Py_None) { *to = INT64_MIN; return 0; }
      if (!PyLong_CheckExact(v)) return 1;
#if PY_VERSION_HEX < 0x030c0000
      if (Py_SIZE(v) >= -1 && Py_SIZE(v) <= 1) {  /* most integers; the function below is slower */
        *to = Py_SIZE(v) * (int64_t)((PyLongObject *)v)->ob_digit[0];
        return 0;
      }
#else
      if (PyUnstable_Long_IsCompact((PyLongObject *)v)) {
        *to = PyUnstable_Long_CompactValue((PyLongObject *)v);
        return 0;
      }
#endif
      long long n = PyLong_AsLongLongAndOverflow(v, &overflow);
      if (overflow || (kind == OPTIONAL && n == INT64_MIN)) return 1;
      *to = n;
      return 0;
    }
  }
}
INLINE int take(int kind, PyObject *v, int64_t *now, int64_t *old, PyObject **object) {
  if (v == *object || kind == NOTHING) return 0;
  if (load_value(kind, v, now)) return 1;
  *old = *now;
  Py_SETREF(*object, Py_NewRef(v));
  return 0;
}
INLINE int load_row(const struct Class *c, const int *numbers, int count, PyObject *o, const struct Values *s) {
  PyObject **slots = &SLOT(o, c, 0), **objects = s->objects;
  int64_t *now = ROW(s->now), *old = ROW(s->old);
  for (int n = 0; n < count; n++) {
    int k = numbers ? numbers[n] : n;
    if (slots[k] != objects[k] && take(c->kinds[k], slots[k], now + k, old + k, objects + k)) return 1;
  }
  return 0;
}
static int load(const struct Bound *b, int of, const struct Use *use, PyObject *o, const struct Values *s);
INLINE int load_block(const struct Bound *b, int of, PyObject *o, const struct Values *s) {
  const struct Class *c = &CLASSES[of];
  if (c->read) return load(b, of, NULL, o, s);
  if (o == NULL || Py_TYPE(o) != b->types[of]) return 1;
  *(PyObject **)s->now = o;
  return load_row(c, NULL, c->row, o, s);
}
FAST static int load_part(const struct Bound *b, const struct Part *p, PyObject *v, const struct Values *s) {
  if (p->kind == BLOCK) return load_block(b, p->block, v, &WITHIN(s, p));
  if (v == NULL || !PyList_CheckExact(v) || PyList_GET_SIZE(v) != p->size) return 1;
  int64_t *now = (int64_t *)(s->now + p->offset), *old = (int64_t *)(s->old + p->offset);
  for (uint32_t at = 0; at < p->size; at++) {
    PyObject *element = PyList_GET_ITEM(v, at);
    if (p->kind == BLOCKS ? load_block(b, p->block, element, &ELEMENT(s, p, at))
                          : take(p->of, element, now + at, old + at, s->objects + p->object + at)) return 1;
  }
  return 0;
}
/* Read the variables of `o`, all of them if `use` is NULL. Return 1 if Python must take over. */
FAST static int load(const struct Bound *b, int of, const struct Use *use, PyObject *o, const struct Values *s) {
  const struct Class *c = &CLASSES[of];
  if (o == NULL || Py_TYPE(o) != b->types[of]) return 1;
  *(PyObject **)s->now = o;
  const int *numbers = use ? use->numbers : NULL;
  if (load_row(c, numbers, use ? use->row : c->row, o, s)) return 1;
  if (numbers) numbers += use->row;
  for (int n = 0, count = use ? use->read : c->read; n < count; n++) {
    int k = numbers ? numbers[n] : n;
    if (load_part(b, &c->part[k], SLOT(o, c, c->row + k), s)) return 1;
  }
  return 0;
}
/* Forget what was read and computed, because machine code ended in the middle, or has not run before. */
static void forget(const struct Values *s, size_t size, int objects) {
  memset(s->now, 0, size);
  memset(s->old, 0, size);
  for (int n = 0; n < objects; n++) Py_XSETREF(s->objects[n], Py_NewRef(Py_Ellipsis));
}

static PyObject *made(int kind, const int64_t *from) {
  switch (kind) {
    case BOOL: return PyBool_FromLong(*from != 0);
    case FLOAT: return PyFloat_FromDouble(*(const double *)from);
    case OPTIONAL:
      if (*from == INT64_MIN) Py_RETURN_NONE;
    /* fall through */
    default: return PyLong_FromLongLong(*from);
  }
}
#define CONSTANT(code) CONSTANTS[-(code) - 1]
static PyObject *record(const struct Record *r, int64_t scan) {
  PyObject *found = PyTuple_New(3 + r->count), *number = PyLong_FromLongLong(scan);
  if (!found || !number) { Py_XDECREF(found); Py_XDECREF(number); return NULL; }
  PyTuple_SET_ITEM(found, 0, number);
  PyTuple_SET_ITEM(found, 1, Py_NewRef(CONSTANTS[r->code - 1]));
  PyTuple_SET_ITEM(found, 2, Py_NewRef(r->maker ? r->maker : Py_None));
  for (int n = 0; n < r->count; n++) {
    PyObject *v = PyLong_FromLongLong(r->values[n]);
    if (!v) { Py_DECREF(found); return NULL; }
    PyTuple_SET_ITEM(found, 3 + n, v);
  }
  return found;
}
static inline int put(PyObject **slot, PyObject *v) {
  if (v == NULL) return -1;
  PyObject *before = *slot;
  *slot = v;
  Py_XDECREF(before);
  return 0;
}
/* Write a variable that has changed. Return -1, with an exception, without memory. */
INLINE int change(int kind, PyObject **slot, const int64_t *now, int64_t *old, PyObject **object) {
  PyObject *v = made(kind, now);
  if (v == NULL) return -1;
  *old = *now;
  Py_SETREF(*object, Py_NewRef(v));
  return put(slot, v);
}

/* Where changed variables are published: a dictionary, and for each variable of the row its key, or None. */
struct Publication { PyObject *to, *keys; };

INLINE int store_row(const struct Class *c, const int *numbers, int count, PyObject *o, const struct Values *s,
                     const struct Publication *p) {
  int64_t *now = ROW(s->now), *old = ROW(s->old);
  for (int n = 0; n < count; n++) {
    int k = numbers ? numbers[n] : n;
    if (now[k] == old[k]) continue;
    PyObject **slot = &SLOT(o, c, 0) + k;
    if (change(c->kinds[k], slot, now + k, old + k, s->objects + k)) return -1;
    if (p && PyTuple_GET_ITEM(p->keys, k) != Py_None && PyDict_SetItem(p->to, PyTuple_GET_ITEM(p->keys, k), *slot)) return -1;
  }
  return 0;
}
static int store(int of, const struct Use *use, PyObject *o, const struct Values *s, int64_t scan, const struct Publication *p);
INLINE int store_block(int of, PyObject *o, const struct Values *s, int64_t scan) {
  const struct Class *c = &CLASSES[of];
  if (c->parts || c->lines) return store(of, NULL, o, s, scan, NULL);
  return store_row(c, NULL, c->row, o, s, NULL);
}
FAST static int store_part(const struct Part *p, PyObject **slot, const struct Values *s, int64_t scan) {
  switch (p->kind) {
    case BLOCK:
      return store_block(p->block, *slot, &WITHIN(s, p), scan);
    case BLOCKS:
      for (uint32_t at = 0; at < p->size; at++)
        if (store_block(p->block, PyList_GET_ITEM(*slot, at), &ELEMENT(s, p, at), scan)) return -1;
      return 0;
    case ARRAY: {
      int64_t *now = (int64_t *)(s->now + p->offset), *old = (int64_t *)(s->old + p->offset);
      for (uint32_t at = 0; at < p->size; at++)
        if (now[at] != old[at]
            && change(p->of, &((PyListObject *)*slot)->ob_item[at], now + at, old + at, s->objects + p->object + at)) return -1;
      return 0;
    }
    case RECORD: {
      struct Record *r = (struct Record *)(s->now + p->offset);
      if (!r->code) return 0;
      if (r->code > 0 ? put(slot, record(r, scan)) : put(slot, Py_NewRef(CONSTANT(r->code)))) return -1;
      r->code = 0;
      return 0;
    }
    default: {
      struct Lines *lines = (struct Lines *)(s->now + p->offset);
      for (int at = 0; at < lines->count; at++) {
        struct Record *r = RECORDS(lines, p->size) + at;
        PyObject *key = PyLong_FromLongLong(r->key), *made_one = record(r, scan);
        int failed = !key || !made_one || PyObject_SetItem(*slot, key, made_one);
        Py_XDECREF(key);
        Py_XDECREF(made_one);
        if (failed) return -1;
        lines->at[r->key] = 0;
      }
      lines->count = 0;
      return 0;
    }
  }
}
/* Write the variables that have changed. Return -1, with an exception, without memory. */
FAST static int store(int of, const struct Use *use, PyObject *o, const struct Values *s, int64_t scan, const struct Publication *p) {
  const struct Class *c = &CLASSES[of];
  const int *numbers = use ? use->numbers : NULL;
  if (store_row(c, numbers, use ? use->row : c->row, o, s, p)) return -1;
  if (numbers) numbers += use->row;
  for (int n = 0, count = use ? use->parts : c->parts; n < count; n++) {
    int k = numbers ? numbers[n] : n;
    if (store_part(&c->part[k], &SLOT(o, c, c->row + k), s, scan)) return -1;
  }
  if (numbers) numbers += use->parts;
  struct Line *lines = (struct Line *)(s->now + c->first_line);
  for (int n = 0, count = use ? use->lines : c->lines; n < count; n++) {
    int k = numbers ? numbers[n] : n;
    if (!lines[k].code) continue;
    PyObject *constant = CONSTANT(lines[k].code), **slot = &SLOT(o, c, c->row + c->parts + k);
    if (*slot != constant && put(slot, Py_NewRef(constant))) return -1;
    lines[k].code = 0;
  }
  return 0;
}

/* Read and write the global variables, whose object has a dictionary. */
static int load_globals(const struct Bound *b, const struct Use *use, PyObject *o, const struct Values *s) {
  const struct Class *c = &CLASSES[1];
  for (int n = 0; n < use->row + use->read; n++) {
    int is_part = n >= use->row, k = use->numbers[n];
    PyObject *v = PyObject_GetAttrString(o, c->names[is_part ? c->row + k : k]);
    if (v == NULL) { PyErr_Clear(); return 1; }
    int failed = is_part ? load_part(b, &c->part[k], v, s)
                         : take(c->kinds[k], v, ROW(s->now) + k, ROW(s->old) + k, s->objects + k);
    Py_DECREF(v);
    if (failed) return 1;
  }
  return 0;
}
static int store_globals(const struct Use *use, PyObject *o, const struct Values *s, int64_t scan) {
  const struct Class *c = &CLASSES[1];
  int64_t *now = ROW(s->now), *old = ROW(s->old);
  for (int n = 0; n < use->row + use->parts + use->lines; n++) {
    int k = use->numbers[n], at = k, is_changed = 0, failed = 0;
    PyObject *v = NULL;
    if (n < use->row) {
      is_changed = now[k] != old[k];
      failed = is_changed && change(c->kinds[k], &v, now + k, old + k, s->objects + k);
    } else if (n < use->row + use->read) {
      if ((v = PyObject_GetAttrString(o, c->names[c->row + k])) == NULL) return -1;
      failed = store_part(&c->part[k], &v, s, scan);
    } else if (n < use->row + use->parts) {
      at = c->row + k;
      is_changed = ((struct Record *)(s->now + c->part[k].offset))->code != 0;
      failed = store_part(&c->part[k], &v, s, scan);
    } else {
      at = c->row + c->parts + k;
      struct Line *line = (struct Line *)(s->now + c->first_line) + k;
      is_changed = line->code != 0;
      if (is_changed) v = Py_NewRef(CONSTANT(line->code));
      line->code = 0;
    }
    failed = failed || (is_changed && PyObject_SetAttrString(o, c->names[at], v));
    Py_XDECREF(v);
    if (failed) return -1;
  }
  return 0;
}
