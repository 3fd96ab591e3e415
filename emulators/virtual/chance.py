"""Seeds the shared random generators, Python's `random` and numpy's if it is loaded, for the duration of a run.

The parts of fieldtwin have their own generators. A user's program or model may take noise from the shared generators,
and gets the same noise again with the same seed.
"""

from __future__ import annotations

import random
import sys
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def seeded(seed: int) -> Iterator[None]:
    """Seed the shared generators until the end of the context; then restore their earlier state."""
    before = random.getstate()
    random.seed(seed)
    numpy = sys.modules.get("numpy")
    numpy_before = numpy.random.get_state() if numpy is not None else None
    if numpy is not None:
        numpy.random.seed(seed % 2**32)
    try:
        yield
    finally:
        random.setstate(before)
        if numpy is not None:
            numpy.random.set_state(numpy_before)
