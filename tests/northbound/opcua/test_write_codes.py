"""The status codes of writes: each error of the gateway has one, and the reference lists all of them."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import Any

import pytest
from asyncua import ua
from hypothesis import given
from hypothesis import strategies as st

from fieldtwin.gateway.core import errors
from fieldtwin.gateway.core.control import RemoteError
from fieldtwin.gateway.core.errors import ConnectionLost, FieldtwinError, ReplyTimeout, Unreachable
from fieldtwin.northbound.opcua.access.users import OPERATE, Account
from fieldtwin.northbound.opcua.writes import CODES, TagWrites

REFERENCE = Path(__file__).parents[3] / "docs/reference/opcua.md"
ANNA = Account("anna", OPERATE)


class Gateway:
    """Takes the calls of writes, and answers each with `error` if there is one."""

    def __init__(self, error: FieldtwinError | None = None) -> None:
        self.calls: list[tuple[str, dict[str, Any]]] = []
        self.error = error

    async def call(self, command: str, **args: Any) -> None:
        self.calls.append((command, args))
        if self.error is not None:
            raise self.error


def written(gateway: Gateway, value: Any, kind: str) -> str:
    writes = TagWrites("scada", gateway.call, {"fan.limit": kind}, ["fan.limit"])
    item = ua.WriteValue(ua.NodeId("fan.limit", 2), ua.AttributeIds.Value, None, ua.DataValue(value))
    return asyncio.run(writes.write(item, "fan.limit", ANNA, "192.0.2.9"))


def test_each_error_that_a_write_may_end_with_has_a_status_code() -> None:
    roots = (errors.Unreachable, errors.WireError, errors.DeviceRefused, errors.NotAllowed)
    kinds = {name for name, kind in vars(errors).items() if isinstance(kind, type) and issubclass(kind, roots)}
    assert kinds == set(CODES)


@pytest.mark.parametrize("kind", sorted(CODES))
def test_an_error_of_the_gateway_gives_its_status_code(kind: str) -> None:
    assert written(Gateway(RemoteError(kind, "refused", 2)), ua.Variant(1.5), "Double") == CODES[kind]


def test_an_unknown_error_is_unexpected() -> None:
    assert written(Gateway(RemoteError("Bug", "?", 70)), ua.Variant(1.5), "Double") == "BadUnexpectedError"


@pytest.mark.parametrize(
    ("error", "code"),
    [
        (Unreachable("x"), "BadNoCommunication"),
        (ConnectionLost("x"), "BadNoCommunication"),
        (ReplyTimeout("x"), "BadTimeout"),
    ],
)
def test_a_gateway_that_does_not_answer_gives_a_bad_code_also_for_a_refusal(error: FieldtwinError, code: str) -> None:
    assert written(Gateway(error), ua.Variant(1.5), "Double") == code
    assert written(Gateway(error), ua.Variant("x"), "Double") == code


@given(st.integers(-(1 << 63), (1 << 63) - 1))
def test_an_integer_is_passed_to_the_gateway_exactly_or_not_at_all(value: int) -> None:
    gateway = Gateway()
    code = written(gateway, ua.Variant(value, ua.VariantType.Int64), "Int64")
    [(command, args)] = gateway.calls
    if code == "Good":
        assert (command, args["value"], float(args["value"])) == ("write", value, value)
    else:
        assert (code, command, args["cause"]) == ("BadOutOfRange", "refuse", "limit")
        assert int(float(value)) != value


TYPES: list[tuple[ua.VariantType, st.SearchStrategy[Any]]] = [
    (ua.VariantType.Double, st.floats()),
    (ua.VariantType.Float, st.floats(width=32)),
    (ua.VariantType.Boolean, st.booleans()),
    (ua.VariantType.Int64, st.integers()),
    (ua.VariantType.String, st.none() | st.text()),
    (ua.VariantType.ByteString, st.none() | st.binary()),
    (ua.VariantType.Null, st.none()),
]


@given(st.sampled_from(TYPES).flatmap(lambda row: st.tuples(st.just(row[0]), row[1] | st.lists(row[1]))))
def test_a_value_of_any_type_is_written_or_refused_and_audited(sent: tuple[ua.VariantType, Any]) -> None:
    kind, value = sent
    gateway = Gateway()
    code = written(gateway, ua.Variant(value, kind), "Double")
    [(command, _)] = gateway.calls
    assert (command == "write") == (code == "Good")
    assert code == "Good" or code in ("BadTypeMismatch", "BadOutOfRange")


def test_the_reference_lists_the_status_codes() -> None:
    text = REFERENCE.read_text(encoding="utf-8")
    section = text[text.index("## Writes") : text.index("## Process")]
    for code in {*CODES.values(), "BadUnexpectedError", "BadUserAccessDenied", "BadTypeMismatch"}:
        assert f"| `{code}` |" in section
