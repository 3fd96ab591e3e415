"""Tokens in files: the form of a token, errors with the path, and no error that shows the token."""

from __future__ import annotations

from pathlib import Path

import pytest

from fieldtwin.gateway.core.errors import FieldtwinError, FileInvalid, UsageError
from fieldtwin.northbound.http_tokens import tokens_of
from fieldtwin.northbound.token_file import LONGEST_TOKEN, read_token
from fieldtwin.twin.site.servers.serving_http import HttpServeConfig

TOKEN = "0123456789abcdef"


def test_the_first_line_of_a_file_is_the_token(tmp_path: Path) -> None:
    path = tmp_path / "token"
    path.write_text(f"  {TOKEN}\r\nsecond line\n")
    assert read_token(path) == TOKEN


@pytest.mark.parametrize(
    "content",
    [b"", b"\n" + TOKEN.encode(), b"short", b"x" * (LONGEST_TOKEN + 1), b"0123456789 abcdef", b"\xff" * 20, "ä".encode() * 20],
)  # fmt: skip
def test_an_error_names_the_file_and_does_not_show_its_content(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "token"
    path.write_bytes(content)
    with pytest.raises(FileInvalid) as caught:
        read_token(path)
    assert str(path) in str(caught.value)
    assert "openssl rand" in str(caught.value)
    if content.strip():
        assert content.decode("latin-1").strip()[:5] not in str(caught.value)


def test_a_missing_file_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(FieldtwinError, match="cannot read the token"):
        read_token(tmp_path / "nothing")


def test_the_roles_have_different_tokens(tmp_path: Path) -> None:
    view, operate = tmp_path / "view", tmp_path / "operate"
    view.write_text(TOKEN)
    operate.write_text(TOKEN[::-1])
    assert tokens_of(HttpServeConfig("web", "127.0.0.1", 0, view)) == (TOKEN, "")
    assert tokens_of(HttpServeConfig("web", "127.0.0.1", 0, view, operate)) == (TOKEN, TOKEN[::-1])
    assert tokens_of(HttpServeConfig("web", "127.0.0.1", 0)) == ("", "")
    operate.write_text(TOKEN)
    with pytest.raises(UsageError, match="both tokens of the server 'web'") as caught:
        tokens_of(HttpServeConfig("web", "127.0.0.1", 0, view, operate))
    assert TOKEN not in str(caught.value)
