"""The chance that belongs to nobody: Python's `random`, and numpy's where it is loaded, with a run's seed while the run lasts.

The parts of fieldtwin have generators of their own. A program or a model of the user's may take noise from where everybody takes
it, and has it the same again with the same seed.
"""

from __future__ import annotations

import random
import sys
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def seeded(seed: int) -> Iterator[None]:
    """Until the end; then it goes on as if nothing had been."""
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
