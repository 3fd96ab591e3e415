"""`os_reason`: the operating system's reason for a failed connection in one plain phrase."""

from __future__ import annotations

import pytest

from fieldtwin.gateway.core.errors import os_reason


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (ConnectionRefusedError(111, "Connect call failed ('127.0.0.1', 7420)"), "Connection refused"),
        (OSError("Multiple exceptions: [Errno 99] Cannot assign requested address, [Errno 111] Connect call failed "
                 "('127.0.0.1', 7420)"), "Connection refused"),
        (OSError("Multiple exceptions: [Errno 111] Connect call failed ('::1', 1, 0, 0), [Errno 111] Connect call "
                 "failed ('127.0.0.1', 1)"), "Connection refused"),
        (OSError("Multiple exceptions: [Errno 99] Cannot assign requested address, [Errno 101] x"), "Network is unreachable"),
        (OSError("Multiple exceptions: [Errno 99] Cannot assign requested address"), "Cannot assign requested address"),
        (OSError(-2, "Name or service not known"), "Name or service not known"),
        (OSError("could not bind"), "could not bind"),
        (TimeoutError(), "no answer"),
        (OSError(), "OSError"),
    ],
)  # fmt: skip
def test_the_most_informative_address_error_represents_a_name(error: OSError, said: str) -> None:
    assert os_reason(error) == said
