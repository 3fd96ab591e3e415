"""Collect the errors in files, so that one check reports all of them instead of only the first."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from fieldtwin.gateway.core.errors import FileInvalid


class FollowingError(FileInvalid):
    """A part of a file cannot be checked, because a part that it refers to has an error itself.

    `ErrorCollector` does not report it, because the user has to correct the other error first.
    """


class ErrorCollector:
    """The errors found so far, each once, in the order in which they were found."""

    def __init__(self) -> None:
        self._found: dict[str, FileInvalid] = {}

    @property
    def errors(self) -> list[FileInvalid]:
        return list(self._found.values())

    @contextmanager
    def collect(self) -> Iterator[None]:
        """Catch a `FileInvalid` that the ``with`` block raises, add it with its `others`, and continue after the block."""
        try:
            yield
        except FileInvalid as e:
            self.add(e)

    def add(self, error: FileInvalid) -> None:
        """Add an error and its `others`. The same error of a file that is read again is not added twice."""
        for one in (error, *error.others):
            if not isinstance(one, FollowingError):
                self._found.setdefault(str(one), one)
        error.others = ()

    def raise_all(self) -> None:
        """Raise the first error, with the further ones as its `others`; return if there is none."""
        if self._found:
            first, *others = self._found.values()
            first.others = tuple(others[: FileInvalid.MAX_OTHERS])
            raise first


@contextmanager
def collecting(into: ErrorCollector | None) -> Iterator[ErrorCollector]:
    """Yield `into`; or, for None, a new collector whose errors are raised at the end of the block."""
    collector = ErrorCollector() if into is None else into
    yield collector
    if into is None:
        collector.raise_all()
