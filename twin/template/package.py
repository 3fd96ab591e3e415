"""Reads a template, folder or zip, from an untrusted source: nothing is trusted before it is checked.

Sizes and counts are bounded before memory is allocated, paths cannot leave the folder, links and devices are refused,
and every byte is compared with the manifest's hash. Nothing in a template is run or imported here.
"""

from __future__ import annotations

import hashlib
import os
import shutil
import stat
import struct
import tempfile
import zipfile
import zlib
from abc import ABC, abstractmethod
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, NamedTuple

from fieldtwin.gateway.core.errors import FileInvalid, Unreachable, UsageError
from fieldtwin.gateway.core.files.input_file import open_input
from fieldtwin.twin.template.detect import MANIFEST
from fieldtwin.twin.template.template import (
    MAX_FILE_BYTES,
    MAX_FILES,
    MAX_MANIFEST_BYTES,
    MAX_TOTAL_BYTES,
    Manifest,
    TemplateFile,
    check_path,
    parse_manifest,
)

BLOCK = 1 << 20
MAX_RATIO = 200
"""The highest permitted ratio of unpacked to packed size, for files of more than one block. A recording of zeros compresses
100 times, a zip bomb 1,000 times.
"""
MAX_DIRECTORY_BYTES = MAX_FILES * 600
_END = struct.Struct("<4s4H2LH")
"""A zip's end of central directory record (APPNOTE 4.3.16)."""
_LOCAL_CACHE = "__pycache__"
_DAMAGED = (OSError, EOFError, zlib.error, zipfile.BadZipFile, NotImplementedError, RuntimeError)
"""The exceptions that reading a damaged or foreign zip can raise: `zipfile` passes on the errors of the modules that it uses."""


def _reason(error: Exception) -> str:
    return str(error) or "it ends too early"  # EOFError has an empty text


class Content(NamedTuple):
    """The content of a file of a template: its kind (empty if the manifest does not name the file), bytes, and SHA-256."""

    kind: str
    bytes: int
    sha256: str


class Package(ABC):
    """A template as stored. `path` is the folder or the zip; `manifest` is its manifest, which has been checked."""

    path: Path
    manifest: Manifest
    caches: tuple[str, ...] = ()
    """Cache files that Python writes into the folders from which it imports. They are not part of the template. In a template
    from an untrusted source they count as code, because Python would run them.
    """

    @abstractmethod
    def open(self, name: str) -> IO[bytes]:
        """Open a file of the package for reading, as bytes."""

    @property
    def code(self) -> tuple[str, ...]:
        """Return the files of this package that Python could run."""
        return (*self.manifest.code, *self.caches)

    def read(self, file: TemplateFile) -> Iterator[bytes]:
        """Yield a file in blocks. Raises `FileInvalid` at its end if the file differs from the manifest."""
        digest, size = hashlib.sha256(), 0
        try:
            with self.open(file.path) as source:
                while block := source.read(BLOCK):
                    size += len(block)
                    if size > file.bytes:
                        raise self._wrong(file, f"{file.bytes} bytes", "more")
                    digest.update(block)
                    yield block
        except _DAMAGED as e:
            raise FileInvalid(f"{file.path}: cannot be read: {_reason(e)}", path=str(self.path)) from e
        if size != file.bytes:
            raise self._wrong(file, f"{file.bytes} bytes", f"{size} bytes")
        if digest.hexdigest() != file.sha256:
            raise self._wrong(file, f"SHA-256 {file.sha256}", digest.hexdigest())

    def _wrong(self, file: TemplateFile, expected: str, got: str) -> FileInvalid:
        hint = "`fieldtwin template diff` shows what was edited; pack the template again" if self.path.is_dir() else ""
        return FileInvalid(
            f"{file.path}: the file has changed since it was packed",
            path=str(self.path),
            expected=expected,
            got=got,
            hint=hint,
        )

    def verify(self) -> None:
        """Read everything once. Raises `FileInvalid` for the first file that differs from the manifest."""
        for file in self.manifest.files:
            for _ in self.read(file):
                pass

    def text(self, name: str) -> bytes:
        """Return the whole content of one file, checked."""
        return b"".join(self.read(self.manifest.by_path()[name]))

    def contents(self) -> dict[str, Content]:
        """Return every file with the hash of its bytes, by path, in the manifest's order.

        Reads all files once. Raises `FileInvalid` for the first file that differs from the manifest. Otherwise a damaged file
        would be listed with the manifest's hash and seem unchanged.
        """
        self.verify()
        return {file.path: Content(file.kind, file.bytes, file.sha256) for file in self.manifest.files}


@contextmanager
def open_package(path: Path, *, edited: bool = False) -> Iterator[Package]:
    """Open a template, which is a folder or a zip. With `edited`, a folder may differ from its manifest (`EditedFolder`).

    Raises `FileInvalid` or `UsageError`.
    """
    if path.is_dir():
        yield EditedFolder(path) if edited else FolderPackage(path)
    elif path.is_file():
        with ZipPackage(path) as package:
            yield package
    else:
        raise UsageError("no template", expected="a zip or a folder", got=str(path))


class FolderPackage(Package):
    """A template as a folder, which must contain exactly the files of its manifest."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.manifest = _folder_manifest(path)
        found: list[str] = []
        caches: list[str] = []
        for name in names_below(path):
            (caches if _is_cache(name) else found).append(name)
        self.caches = tuple(caches)
        _compare(found, self.manifest, str(path))

    def open(self, name: str) -> IO[bytes]:
        return _open_inside(self.path, name)


class EditedFolder(Package):
    """A template as a folder that its owner works in: files may have been edited, added or removed since it was packed.

    This class is for comparing templates only. Everything that runs or unpacks a template takes a `FolderPackage`, which
    accepts no such change.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.manifest = _folder_manifest(path)

    def open(self, name: str) -> IO[bytes]:
        return _open_inside(self.path, name)

    def text(self, name: str) -> bytes:
        """Return the file as it is now. Raises `FileInvalid` if it is larger than a template allows."""
        try:
            with self.open(name) as source:
                text = source.read(MAX_FILE_BYTES + 1)
        except OSError as e:
            raise FileInvalid(f"{name}: cannot be read: {e.strerror}", path=str(self.path)) from e
        if len(text) > MAX_FILE_BYTES:
            raise FileInvalid(f"{name}: too large", path=str(self.path), expected=f"at most {MAX_FILE_BYTES} bytes")
        return text

    def contents(self) -> dict[str, Content]:
        """Return the files that are in the folder now. A file that the manifest does not name has an empty kind."""
        kinds: dict[str, str] = {file.path: file.kind for file in self.manifest.files}
        found = {}
        for name in sorted(names_below(self.path)):
            if name != MANIFEST and not _is_cache(name):
                text = self.text(name)
                found[name] = Content(kinds.get(name, ""), len(text), hashlib.sha256(text).hexdigest())
        return found


def _is_cache(name: str) -> bool:
    return f"/{_LOCAL_CACHE}/" in f"/{name}"


def _folder_manifest(path: Path) -> Manifest:
    try:
        with open_input(path / MANIFEST) as file:
            text = file.read(MAX_MANIFEST_BYTES + 1)
    except OSError as e:
        raise FileInvalid(f"not a template: {e.strerror}", path=str(path / MANIFEST)) from e
    return parse_manifest(_bounded(text, str(path)), str(path / MANIFEST))


def _open_inside(folder: Path, name: str) -> IO[bytes]:
    return open(os.open(folder / name, os.O_RDONLY | os.O_NOFOLLOW | os.O_CLOEXEC), "rb")


def names_below(folder: Path) -> Iterator[str]:
    """Yield every file below `folder`, with ``/``. Raises `FileInvalid` for anything else: links, pipes, devices."""
    count, waiting = 0, [folder]
    while waiting:
        with os.scandir(waiting.pop()) as entries:
            for entry in sorted(entries, key=lambda e: e.name):
                name = Path(entry.path).relative_to(folder).as_posix()
                count += 1
                if count > 2 * MAX_FILES:
                    raise FileInvalid("too many files", path=str(folder), expected=f"at most {MAX_FILES}")
                if entry.is_dir(follow_symlinks=False):
                    waiting.append(Path(entry.path))
                elif entry.is_file(follow_symlinks=False):
                    yield name
                else:
                    raise FileInvalid(
                        f"{name!r} is not a regular file", path=str(folder), hint="a template has no links"
                    )


class ZipPackage(Package):
    """A template as a zip. ``with ZipPackage(path) as package``."""

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            _check_directory(path)
            self._zip = zipfile.ZipFile(path)
        except (OSError, zipfile.BadZipFile, NotImplementedError, struct.error) as e:
            raise FileInvalid(f"no zip: {e}", path=str(path)) from e
        try:
            self._entries = {e.orig_filename: e for e in self._zip.infolist() if not self._is_folder(e)}
            self.manifest = parse_manifest(self._manifest_text(), f"{path}/{MANIFEST}")
            self._check_entries()
        except BaseException:
            self._zip.close()
            raise

    def __enter__(self) -> ZipPackage:
        return self

    def __exit__(self, *exc: object) -> None:
        self._zip.close()

    def _is_folder(self, entry: zipfile.ZipInfo) -> bool:
        name = entry.orig_filename
        check_path(name.removesuffix("/"), str(self.path))
        mode = entry.external_attr >> 16
        kind = stat.S_IFMT(mode)
        if kind not in (0, stat.S_IFDIR if name.endswith("/") else stat.S_IFREG):
            raise FileInvalid(f"{name!r} is not a regular file", path=str(self.path), hint="a template has no links")
        if entry.flag_bits & 1 or entry.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
            raise FileInvalid(f"{name!r} is encrypted, or its compression is not supported", path=str(self.path))
        if name.endswith("/") and entry.file_size:
            raise FileInvalid(f"{name!r}: a folder with contents", path=str(self.path))
        return name.endswith("/")

    def _manifest_text(self) -> bytes:
        entry = self._entries.get(MANIFEST)
        if entry is None:
            raise FileInvalid("no template", path=str(self.path), expected=f"{MANIFEST} at its top")
        try:
            with self._zip.open(entry) as file:
                return _bounded(file.read(MAX_MANIFEST_BYTES + 1), str(self.path))
        except _DAMAGED as e:
            raise FileInvalid(f"{MANIFEST} cannot be read: {_reason(e)}", path=str(self.path)) from e

    def _check_entries(self) -> None:
        _compare(list(self._entries), self.manifest, str(self.path))
        files = self.manifest.by_path()
        for name, entry in self._entries.items():
            if name in files and entry.file_size != files[name].bytes:
                raise self._wrong(files[name], f"{files[name].bytes} bytes", f"{entry.file_size} bytes")
            if entry.file_size > BLOCK and entry.file_size > MAX_RATIO * max(entry.compress_size, 1):
                ratio = entry.file_size // max(entry.compress_size, 1)
                raise FileInvalid(
                    f"{name}: its compression ratio is too high", path=str(self.path),
                    expected=f"at most {MAX_RATIO} to 1", got=f"{ratio} to 1", hint="it may be a zip bomb",
                )  # fmt: skip

    def open(self, name: str) -> IO[bytes]:
        return self._zip.open(self._entries[name])


def _bounded(text: bytes, where: str) -> bytes:
    if len(text) > MAX_MANIFEST_BYTES:
        raise FileInvalid(f"{MANIFEST} is too large", path=where, expected=f"at most {MAX_MANIFEST_BYTES} bytes")
    return text


def _check_directory(path: Path) -> None:
    """Refuse a zip directory that would need more memory than a template can.

    It is located in the same way as zipfile does.
    """
    size = path.stat().st_size
    if size > MAX_TOTAL_BYTES + MAX_DIRECTORY_BYTES:
        raise FileInvalid("too large", path=str(path), expected=f"at most {MAX_TOTAL_BYTES} bytes", got=str(size))
    with open_input(path) as file:
        file.seek(max(0, size - _END.size - 0xFFFF - 20))
        tail = file.read()
    at = len(tail) - _END.size
    if at < 0 or tail[at : at + 4] != b"PK\x05\x06" or tail[-2:] != b"\0\0":
        at = tail.rfind(b"PK\x05\x06")
    if at < 0:
        raise zipfile.BadZipFile("it has no directory at its end")
    _, _, _, _, count, directory_bytes, _, _ = _END.unpack_from(tail, at)
    if (
        tail[max(0, at - 20) : at].startswith(b"PK\x06\x07")
        or count > 2 * MAX_FILES
        or directory_bytes > MAX_DIRECTORY_BYTES
    ):
        raise FileInvalid("too many files", path=str(path), expected=f"at most {MAX_FILES}")


def _compare(found: list[str], manifest: Manifest, where: str) -> None:
    """Check that the files found are exactly those of the manifest."""
    named = {MANIFEST, *manifest.by_path()}
    if strangers := sorted(set(found) - named):
        raise FileInvalid(
            f"{strangers[0]!r} is not in the manifest", path=where, expected="the files that were packed, and no others"
        )
    if missing := sorted(named - set(found)):
        raise FileInvalid(f"{missing[0]!r} is missing", path=where, expected="every file of the manifest")


def unpack(package: Package, target: Path) -> None:
    """Write the package as the folder `target`, which must be missing or empty: all files, checked, or nothing.

    Raises `FileInvalid` for a wrong file, `UsageError` for a target in use, `Unreachable` if the folder cannot be written.
    """
    if target.exists() and (not target.is_dir() or any(target.iterdir())):
        raise UsageError("the folder is not empty", got=str(target), hint="choose another with -o")
    total = sum(file.bytes for file in package.manifest.files)
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        free = shutil.disk_usage(target.parent).free
        if free < total:
            raise Unreachable(f"the disk is too full: {total} bytes to unpack, {free} free", where=str(target.parent))
        work = Path(tempfile.mkdtemp(prefix=f".{target.name}.", dir=target.parent))
    except OSError as e:
        raise Unreachable(f"cannot unpack: {e.strerror or e}", where=str(target.parent)) from e
    try:
        for file in package.manifest.files:
            _write(work, package, file)
        (work / MANIFEST).write_bytes(package.manifest.to_json())
        with suppress(FileNotFoundError):
            target.rmdir()
        work.chmod(0o755)
        work.rename(target)
    except OSError as e:
        raise Unreachable(f"cannot unpack: {e.strerror or e}", where=str(target)) from e
    finally:
        shutil.rmtree(work, ignore_errors=True)


def _write(work: Path, package: Package, file: TemplateFile) -> None:
    place = work / file.path
    place.parent.mkdir(parents=True, exist_ok=True)
    with place.open("xb") as out:
        for block in package.read(file):
            out.write(block)
