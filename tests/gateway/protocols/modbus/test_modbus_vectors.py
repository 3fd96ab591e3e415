"""The wire vectors of tests/vectors/modbus_client.toml against the pure transaction: whole, byte by byte, with garbage."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

import pytest

from fieldtwin.gateway.core import errors
from fieldtwin.gateway.protocols.modbus.frames.framing import Framer
from fieldtwin.gateway.protocols.modbus.frames.mbap import MbapFramer
from fieldtwin.gateway.protocols.modbus.frames.rtu import RtuFramer
from fieldtwin.gateway.protocols.modbus.requests import data as requests
from fieldtwin.gateway.protocols.modbus.requests import diagnostics, files, identity, user
from fieldtwin.gateway.protocols.modbus.requests.replies import Reply
from fieldtwin.gateway.protocols.modbus.transaction import Transaction

VECTORS = tomllib.loads((Path(__file__).parents[3] / "vectors" / "modbus_client.toml").read_text())["vector"]
TIMEOUT_NS = 1_000_000_000
BYTE_NS = 573_000


def ids(vector: dict[str, Any]) -> str:
    return str(vector["id"])


def make_request(spec: list[Any]) -> Any:
    """Return an object of the class that `spec` names, with its arguments; bytes are hexadecimal."""
    name, *args = spec
    module = next(m for m in (requests, diagnostics, files, identity, user) if hasattr(m, name))
    return getattr(module, name)(*[make_argument(name, a) for a in args])


def make_argument(name: str, value: Any) -> Any:
    if isinstance(value, str) and name in ("Loopback", "UserFunction"):
        return bytes.fromhex(value)
    if isinstance(value, list):
        if value and isinstance(value[0], str):
            return make_request(value)
        return tuple(make_argument("", v) for v in value)
    return value


def play(vector: dict[str, Any], chunks: list[bytes]) -> tuple[Reply | errors.FieldtwinError, bool]:
    """Result of the exchange, and whether it took until the deadline."""
    framer: Framer = MbapFramer() if vector.get("framing") == "mbap" else RtuFramer()
    transaction = Transaction(framer, 0x11, make_request(vector["request"]), timeout_ns=TIMEOUT_NS)
    now_ns = 5_000_000_000
    assert transaction.start(now_ns) == bytes.fromhex(vector["sent"])
    try:
        for chunk in chunks:
            now_ns += BYTE_NS
            reply = transaction.feed(chunk, now_ns)
            if reply is not None:
                assert reply.t_ns == now_ns
                return reply, False
        while True:
            assert transaction.wake_ns > now_ns or transaction.wake_ns == transaction.deadline_ns
            now_ns = transaction.wake_ns
            reply = transaction.poll(now_ns)
            if reply is not None:
                return reply, now_ns >= transaction.deadline_ns
    except errors.FieldtwinError as e:
        error = e
    assert transaction.done
    assert "unit 17" in str(error)
    return error, now_ns >= transaction.deadline_ns


def check(vector: dict[str, Any], chunks: list[bytes]) -> None:
    outcome, late = play(vector, chunks)
    if "error" in vector:
        assert isinstance(outcome, getattr(errors, vector["error"])), repr(outcome)
        assert late == (vector["error"] == "ReplyTimeout" or vector.get("at_deadline", False))
        if "code" in vector:
            assert isinstance(outcome, errors.ModbusExceptionReply)
            assert outcome.code == vector["code"]
        return
    assert isinstance(outcome, Reply), repr(outcome)
    assert not late
    found: dict[str, Any] = {
        "registers": list(getattr(outcome, "registers", ())),
        "bits": "".join("01"[bit] for bit in getattr(outcome, "bits", ())),
        "acknowledged": getattr(outcome, "acknowledged", None),
        "status": getattr(outcome, "status", None),
        "value": getattr(outcome, "value", None),
        "event_count": getattr(outcome, "event_count", None),
        "message_count": getattr(outcome, "message_count", None),
        "events": getattr(outcome, "events", b"").hex(" "),
        "records": [list(words) for words in getattr(outcome, "records", ())],
        "raw": outcome.raw.hex(" "),
        "id_bytes": outcome.raw.hex(" "),
        "objects": [[number, value.hex(" ")] for number, value in getattr(outcome, "objects", ())],
    }
    wanted = set(vector) & set(found)
    assert wanted, "a vector without an outcome"
    for key in wanted:
        assert found[key] == vector[key], key


@pytest.mark.parametrize("vector", VECTORS, ids=ids)
def test_vector_in_one_piece(vector: dict[str, Any]) -> None:
    received = bytes.fromhex(vector["received"])
    check(vector, [received] if received else [])


@pytest.mark.parametrize("vector", VECTORS, ids=ids)
def test_vector_byte_by_byte(vector: dict[str, Any]) -> None:
    check(vector, [bytes([b]) for b in bytes.fromhex(vector["received"])])


@pytest.mark.parametrize(
    "tail", [b"\x00\x00\x00", b"\xff\x55", b"\x11\x03\x02\x00\x07"], ids=["zeros", "noise", "half"]
)
@pytest.mark.parametrize("vector", [v for v in VECTORS if v.get("tail", True)], ids=ids)
def test_vector_followed_by_garbage(vector: dict[str, Any], tail: bytes) -> None:
    check(vector, [bytes.fromhex(vector["received"]) + tail])


@pytest.mark.parametrize("noise", [b"\x00", b"\xff", b"\x00\xff\x00"], ids=["00", "FF", "00 FF 00"])
@pytest.mark.parametrize(
    "vector", [v for v in VECTORS if v.get("framing") != "mbap" and not v.get("at_deadline")], ids=ids
)
def test_mb_008_leading_idle_noise(vector: dict[str, Any], noise: bytes) -> None:
    check(vector, [noise, bytes.fromhex(vector["received"])] if vector["received"] else [noise])
