"""Read and write files of Asset Administration Shells with the BaSyx Python SDK: JSON, XML and AASX packages.

A file comes from outside, so its size is limited before the SDK reads it, and a document type in XML, whose entities could name
other files, is refused.
"""

from __future__ import annotations

import io
import logging
import zipfile
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import Any

from basyx.aas import model
from basyx.aas.adapter import aasx
from basyx.aas.adapter.json import read_aas_json_file, write_aas_json_file
from basyx.aas.adapter.xml import read_aas_xml_file

from fieldtwin.gateway.core.errors import FileInvalid

MAX_UNPACKED_BYTES = 256 * 1024 * 1024
"""The largest sum of the sizes of all parts of an AASX package, in bytes."""
MAX_PARTS = 10_000
MAX_DESCRIPTION_BYTES = 32 * 1024 * 1024
"""The largest size of one part that describes shells (JSON or XML), in bytes."""
MAX_MESSAGES = 50
"""The largest number of messages about skipped elements that are kept."""


def shell_json(objects: Iterable[Any]) -> bytes:
    """Return shells and submodels as JSON (AAS Part 5)."""
    out = io.StringIO()
    write_aas_json_file(out, model.DictIdentifiableStore(objects), indent=2, ensure_ascii=False)
    return (out.getvalue() + "\n").encode()


def read_shells(data: bytes, path: str) -> tuple[list[Any], dict[str, bytes], list[str]]:
    """Return the shells and submodels of a file, the supplementary files of a package, and what the SDK had to skip.

    Raises `FileInvalid` for a file that is no JSON, XML or AASX of shells, and one that is too large.
    """
    files: Any = aasx.DictSupplementaryFileContainer()  # type: ignore[no-untyped-call]
    start = data.lstrip()[:1]
    read: Callable[[], Any]
    if data.startswith(b"PK"):
        _check_package(data, path)
        read = lambda: _package(data, files)  # noqa: E731
    elif start == b"<":
        _check_part(data, path)
        read = lambda: read_aas_xml_file(io.BytesIO(data))  # noqa: E731
    elif start == b"{":
        _check_part(data, path)
        read = lambda: read_aas_json_file(io.BytesIO(data))  # noqa: E731
    else:
        raise FileInvalid("not a file of Asset Administration Shells", path=path, expected="AASX, JSON or XML")
    with _messages() as skipped:
        try:
            found = list(read())
        except Exception as e:  # the SDK raises errors of several libraries, without a common class
            text = f"{type(e).__name__}: {e}"[:200]
            raise FileInvalid("not a file of Asset Administration Shells", path=path, got=text) from e
    if not found:
        why = skipped[0] if skipped else "it contains no shell and no submodel"
        raise FileInvalid("not a file of Asset Administration Shells", path=path, got=why)
    return found, {name: _content(files, name) for name in files}, skipped


def _package(data: bytes, files: Any) -> Any:
    store: Any = model.DictIdentifiableStore()
    with aasx.AASXReader(io.BytesIO(data)) as reader:
        reader.read_into(store, files)
    return store


def _content(files: Any, name: str) -> bytes:
    out = io.BytesIO()
    files.write_file(name, out)
    return out.getvalue()


def _check_package(data: bytes, path: str) -> None:
    """Raise `FileInvalid` for a package that is damaged, or whose parts are too large."""
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as package:
            parts = package.infolist()
            size = sum(part.file_size for part in parts)
            if len(parts) > MAX_PARTS or size > MAX_UNPACKED_BYTES:
                got = f"{len(parts)} parts with {size} bytes"
                expected = f"at most {MAX_PARTS} parts with {MAX_UNPACKED_BYTES} bytes"
                raise FileInvalid("the package is too large", path=path, expected=expected, got=got)
            for part in parts:
                if part.filename.endswith((".xml", ".json", ".rels")):
                    _check_size(part.file_size, f"{path}: {part.filename}")
                    _check_part(package.read(part), f"{path}: {part.filename}")
    except (zipfile.BadZipFile, NotImplementedError, RuntimeError, OSError, ValueError) as e:
        raise FileInvalid("the package is damaged", path=path, expected="an AASX package (a zip)", got=str(e)) from e


def _check_size(size: int, path: str) -> None:
    if size > MAX_DESCRIPTION_BYTES:
        raise FileInvalid("the description is too large", path=path, expected=f"at most {MAX_DESCRIPTION_BYTES} bytes")


def _check_part(data: bytes, path: str) -> None:
    _check_size(len(data), path)
    if data.lstrip().startswith(b"<") and b"<!DOCTYPE" in data:
        raise FileInvalid("the XML has a document type", path=path, hint="remove <!DOCTYPE>; shells need none")


@contextmanager
def _messages() -> Iterator[list[str]]:
    """Yield the list of messages that the SDK logs about elements that it skips; nothing reaches the console."""
    found: list[str] = []

    class Keep(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            if len(found) < MAX_MESSAGES:
                found.append(" ".join(record.getMessage().split())[:300])

    logger, handler = logging.getLogger("basyx"), Keep(logging.WARNING)
    before = logger.propagate
    logger.addHandler(handler)
    logger.propagate = False
    try:
        yield found
    finally:
        logger.propagate = before
        logger.removeHandler(handler)
