"""The messages of the Debug Adapter Protocol (base protocol): a header with the length, and a JSON object."""

from __future__ import annotations

import json
import threading
from typing import Any, BinaryIO

from fieldtwin.gateway.core.errors import UsageError

MAX_HEADER = 4096
"""The longest header, in bytes."""
MAX_MESSAGE = 4 * 1024 * 1024
"""The longest message, in bytes. A longer one is refused before it is read."""
_LENGTH = b"content-length:"


class Messages:
    """The messages on a pair of byte streams. Any thread may send."""

    def __init__(self, source: BinaryIO, sink: BinaryIO) -> None:
        self._source, self._sink = source, sink
        self._lock = threading.Lock()
        self._sequence = 0

    def receive(self) -> dict[str, Any] | None:
        """Return the next message; None at the end of the stream. Raises `UsageError` for bytes that are not a message."""
        length = self._length()
        if length is None:
            return None
        data = self._source.read(length)
        if len(data) < length:
            return None
        try:
            found = json.loads(data)
        except ValueError as e:
            raise UsageError("a message that is not JSON", got=str(e)) from e
        if not isinstance(found, dict):
            raise UsageError("a message that is not a JSON object", got=type(found).__name__)
        return found

    def _length(self) -> int | None:
        """Return the length in the next header."""
        length, read = None, 0
        while True:
            line = self._source.readline(MAX_HEADER)
            read += len(line)
            if not line:
                return None
            if read >= MAX_HEADER:
                raise UsageError("a header that is too long", expected=f"at most {MAX_HEADER} bytes")
            if not line.strip():
                break
            if line.lower().startswith(_LENGTH):
                text = line[len(_LENGTH) :].strip()
                length = int(text) if text.isdigit() else -1
        if length is None or not 0 <= length <= MAX_MESSAGE:
            raise UsageError("a header without a valid Content-Length", expected=f"0 to {MAX_MESSAGE} bytes")
        return length

    def send(self, kind: str, **more: Any) -> None:
        """Send a message of type `kind`: response or event. The end of the stream is ignored, because the reader notices it."""
        with self._lock:
            self._sequence += 1
            data = json.dumps({"seq": self._sequence, "type": kind, **more}).encode()
            try:
                self._sink.write(b"Content-Length: %d\r\n\r\n" % len(data) + data)
                self._sink.flush()
            except (OSError, ValueError):
                return
