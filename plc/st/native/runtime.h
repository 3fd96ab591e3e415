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

enum { BOOL, INT, FLOAT, OPTIONAL, BLOCK, BLOCKS, ARRAY, LINE, RECORD, LINES };
enum { MAX_VALUES = 8 };

struct Line { int32_t code, count; };
/* The record of an assignment by the statement of `maker`; NULL for a FUNCTION, which has no object. */
struct Record { int32_t code, count; PyObject *maker; int64_t key; int64_t values[MAX_VALUES]; };
/* A variable: `kind` and `of`, the kind of its elements; their number; its class, if it is a block; the number of its first Python
   object; its place in the structure. Tables are read in each scan, so entries are small. */
struct Entry { uint8_t kind, of; uint16_t block; uint32_t size, object, offset; };
/* The first `values` entries have values; the others are records. `objects` is the number of Python objects that the values are, and
   `size` that of the structure. */
struct Class { int values, count, objects; size_t size; const struct Entry *entries; const char *const *names; Py_ssize_t *slots; };
/* The Python classes of one resource. */
struct Bound { PyTypeObject **types; };
/* The head of the records of the elements of an array. `at` has the number of the record of each element, from 1. */
struct Lines { int32_t count; int32_t at[]; };
#define RECORDS(lines, size) ((struct Record *)((char *)(lines) + ((4 + 4 * (size_t)(size) + 7) & ~(size_t)7)))

/* The variables of one object: `now` has the values with which machine code computes, `old` those of the Python object, and
   `objects` the Python objects of the values. A variable that still is the same Python object is not read again. */
struct Values { char *now, *old; PyObject **objects; };

static const struct Class *CLASSES;
static PyObject **CONSTANTS;

#define INLINE static inline __attribute__((always_inline))
#ifdef __clang__
#define FAST
#else
#define FAST __attribute__((optimize("O2")))
#endif
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

static inline int load_value(int kind, PyObject *v, char *to) {
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
      if (kind == OPTIONAL && v == Py_None) { *(int64_t *)to = INT64_MIN; return 0; }
      if (!PyLong_CheckExact(v)) return 1;
#if PY_VERSION_HEX < 0x030c0000
      if (Py_SIZE(v) >= -1 && Py_SIZE(v) <= 1) {  /* most integers; the function below is slower */
        *(int64_t *)to = Py_SIZE(v) * (int64_t)((PyLongObject *)v)->ob_digit[0];
        return 0;
      }
#else
      if (PyUnstable_Long_IsCompact((PyLongObject *)v)) {
        *(int64_t *)to = PyUnstable_Long_CompactValue((PyLongObject *)v);
        return 0;
      }
#endif
      long long n = PyLong_AsLongLongAndOverflow(v, &overflow);
      if (overflow || (kind == OPTIONAL && n == INT64_MIN)) return 1;
      *(int64_t *)to = n;
      return 0;
    }
  }
}
static inline size_t width(int kind) { return kind == BOOL ? 1 : 8; }
static inline int differs(int kind, const char *a, const char *b) {
  return kind == BOOL ? *a != *b : *(const int64_t *)a != *(const int64_t *)b;
}
static inline void copy(int kind, char *to, const char *from) {
  if (kind == BOOL) *to = *from;
  else *(int64_t *)to = *(const int64_t *)from;
}
INLINE int take(int kind, PyObject *v, const struct Values *s, size_t offset, int object) {
  if (v == s->objects[object]) return v == NULL;
  if (load_value(kind, v, s->now + offset)) return 1;
  copy(kind, s->old + offset, s->now + offset);
  Py_XSETREF(s->objects[object], Py_NewRef(v));
  return 0;
}
/* Read the variables of `o`. `use` lists the entries that are read; NULL: all `n`. Return 1 if Python must take over. */
FAST static int load(const struct Bound *b, int of, const int *use, int n, PyObject *o, const struct Values *s) {
  const struct Class *c = &CLASSES[of];
  if (o == NULL || Py_TYPE(o) != b->types[of]) return 1;
  *(PyObject **)s->now = o;  /* each structure begins with its object */
  for (int k = 0; k < n; k++) {
    int i = use ? use[k] : k;
    const struct Entry *e = &c->entries[i];
    PyObject *v = *(PyObject **)((char *)o + c->slots[i]);
    switch (e->kind) {
      case BLOCK:
        if (load(b, e->block, NULL, CLASSES[e->block].values, v, &WITHIN(s, e))) return 1;
        break;
      case BLOCKS:
        if (v == NULL || !PyList_CheckExact(v) || PyList_GET_SIZE(v) != e->size) return 1;
        for (uint32_t at = 0; at < e->size; at++)
          if (load(b, e->block, NULL, CLASSES[e->block].values, PyList_GET_ITEM(v, at), &ELEMENT(s, e, at))) return 1;
        break;
      case ARRAY:
        if (v == NULL || !PyList_CheckExact(v) || PyList_GET_SIZE(v) != e->size) return 1;
        for (int at = 0; at < e->size; at++)
          if (take(e->of, PyList_GET_ITEM(v, at), s, e->offset + at * width(e->of), e->object + at)) return 1;
        break;
      default:
        if (take(e->kind, v, s, e->offset, e->object)) return 1;
    }
  }
  return 0;
}
/* Forget what was read and computed, because machine code ended in the middle. */
static void forget(const struct Values *s, size_t size, int objects) {
  memset(s->now, 0, size);
  for (int n = 0; n < objects; n++) Py_CLEAR(s->objects[n]);
}

static PyObject *made(int kind, const char *from) {
  switch (kind) {
    case BOOL: return PyBool_FromLong(*from);
    case FLOAT: return PyFloat_FromDouble(*(const double *)from);
    case OPTIONAL:
      if (*(const int64_t *)from == INT64_MIN) Py_RETURN_NONE;
    /* fall through */
    default: return PyLong_FromLongLong(*(const int64_t *)from);
  }
}
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

/* Where changed variables are published: a dictionary, and for each entry its key, or None. */
struct Publication { PyObject *to, *keys; };

/* Return whether the variable has changed; -1, with an exception, without memory. */
INLINE int change(int kind, PyObject **slot, const struct Values *s, size_t offset, int object) {
  if (!differs(kind, s->now + offset, s->old + offset)) return 0;
  PyObject *v = made(kind, s->now + offset);
  if (v == NULL) return -1;
  copy(kind, s->old + offset, s->now + offset);
  Py_XSETREF(s->objects[object], Py_NewRef(v));
  return put(slot, v) ? -1 : 1;
}

/* Write the variables that have changed. Return -1, with an exception, without memory. */
FAST static int store(int of, const int *use, int n, PyObject *o, const struct Values *s, int64_t scan,
                      const struct Publication *p) {
  const struct Class *c = &CLASSES[of];
  for (int k = 0; k < n; k++) {
    int i = use ? use[k] : k;
    const struct Entry *e = &c->entries[i];
    PyObject **slot = (PyObject **)((char *)o + c->slots[i]);
    switch (e->kind) {
      case BLOCK:
        if (store(e->block, NULL, CLASSES[e->block].count, *slot, &WITHIN(s, e), scan, NULL)) return -1;
        break;
      case BLOCKS:
        for (uint32_t at = 0; at < e->size; at++)
          if (store(e->block, NULL, CLASSES[e->block].count, PyList_GET_ITEM(*slot, at), &ELEMENT(s, e, at), scan, NULL)) return -1;
        break;
      case ARRAY:
        for (int at = 0; at < e->size; at++)
          if (change(e->of, &((PyListObject *)*slot)->ob_item[at], s, e->offset + at * width(e->of), e->object + at) < 0) return -1;
        break;
      case LINE:
      case RECORD: {
        struct Record *r = (struct Record *)(s->now + e->offset);
        if (!r->code) break;
        PyObject *constant = CONSTANTS[r->code - 1];
        if (r->count >= 0 ? put(slot, record(r, scan)) : *slot != constant && put(slot, Py_NewRef(constant))) return -1;
        r->code = 0;
        break;
      }
      case LINES: {
        struct Lines *lines = (struct Lines *)(s->now + e->offset);
        for (int at = 0; at < lines->count; at++) {
          struct Record *r = RECORDS(lines, e->size) + at;
          PyObject *key = PyLong_FromLongLong(r->key), *made_one = record(r, scan);
          int failed = !key || !made_one || PyObject_SetItem(*slot, key, made_one);
          Py_XDECREF(key);
          Py_XDECREF(made_one);
          if (failed) return -1;
          lines->at[r->key] = 0;
        }
        lines->count = 0;
        break;
      }
      default:
        switch (change(e->kind, slot, s, e->offset, e->object)) {
          case 0: break;
          case 1:
            if (p && PyTuple_GET_ITEM(p->keys, i) != Py_None
                && PyDict_SetItem(p->to, PyTuple_GET_ITEM(p->keys, i), *slot)) return -1;
            break;
          default: return -1;
        }
    }
  }
  return 0;
}

/* Read and write the global variables, whose object has a dictionary. */
static int load_globals(const struct Bound *b, const int *use, int n, PyObject *o, const struct Values *s) {
  for (int k = 0; k < n; k++) {
    const struct Entry *e = &CLASSES[1].entries[use[k]];
    if (e->kind == LINE || e->kind == RECORD) continue;
    PyObject *v = PyObject_GetAttrString(o, CLASSES[1].names[use[k]]);
    int failed;
    if (v == NULL) { PyErr_Clear(); return 1; }
    if (e->kind == BLOCK) failed = load(b, e->block, NULL, CLASSES[e->block].values, v, &WITHIN(s, e));
    else failed = take(e->kind, v, s, e->offset, e->object);
    Py_DECREF(v);
    if (failed) return 1;
  }
  return 0;
}
static int store_globals(const int *use, int n, PyObject *o, const struct Values *s, int64_t scan) {
  for (int k = 0; k < n; k++) {
    const struct Entry *e = &CLASSES[1].entries[use[k]];
    PyObject *v = NULL;
    int failed = 0;
    if (e->kind == BLOCK) {
      if ((v = PyObject_GetAttrString(o, CLASSES[1].names[use[k]])) == NULL) return -1;
      failed = store(e->block, NULL, CLASSES[e->block].count, v, &WITHIN(s, e), scan, NULL);
      Py_DECREF(v);
    } else if (e->kind == LINE || e->kind == RECORD) {
      struct Record *r = (struct Record *)(s->now + e->offset);
      if (!r->code) continue;
      v = r->count < 0 ? Py_NewRef(CONSTANTS[r->code - 1]) : record(r, scan);
      r->code = 0;
      failed = v == NULL || PyObject_SetAttrString(o, CLASSES[1].names[use[k]], v);
      Py_XDECREF(v);
    } else if (differs(e->kind, s->now + e->offset, s->old + e->offset)) {
      failed = change(e->kind, &v, s, e->offset, e->object) < 0 || PyObject_SetAttrString(o, CLASSES[1].names[use[k]], v);
      Py_XDECREF(v);
    }
    if (failed) return -1;
  }
  return 0;
}
