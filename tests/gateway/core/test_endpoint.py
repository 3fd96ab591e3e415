"""Endpoint URLs: valid ones round-trip, invalid ones are refused with the reason."""

from __future__ import annotations

import string

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldtwin.gateway.core.endpoint import SOCKET_SCHEMES, TLS_PARAMS, Endpoint, SerialSettings
from fieldtwin.gateway.core.errors import FieldtwinError, UsageError

NAME = st.text(string.ascii_lowercase + string.digits + "-", min_size=1, max_size=12)
PATH = st.text(string.ascii_letters + string.digits + "/._-:#%&=+ é", min_size=1, max_size=30)
HOST = st.one_of(
    st.lists(NAME, min_size=1, max_size=3).map(".".join),
    st.ip_addresses(v=4).map(str),
    st.ip_addresses(v=6).map(str),
    st.just("fe80::1%eth0"),
)
PARAMS = st.dictionaries(NAME, st.text(max_size=10), max_size=3).map(lambda d: tuple(d.items()))
SERIAL_PARAMS = st.tuples(
    st.integers(50, 4_000_000), st.sampled_from("78"), st.sampled_from("NEO"), st.sampled_from("12")
)
ENDPOINT = st.one_of(
    st.builds(
        Endpoint,
        st.sampled_from([scheme for scheme in SOCKET_SCHEMES if scheme != "tls"]),
        host=HOST,
        port=st.integers(0, 65535),
        path=st.just(""),
        params=PARAMS,
    ),
    st.builds(
        lambda scheme, path, s: Endpoint(
            scheme, path=path, params=(("baudrate", str(s[0])), ("frame", "".join(s[1:])))
        ),
        st.sampled_from(("rtu", "ascii")),
        PATH,
        SERIAL_PARAMS,
    ),
    st.builds(
        lambda interface, path, params: Endpoint("can", interface=interface, path=path, params=params),
        NAME,
        PATH,
        PARAMS,
    ),
    st.builds(
        lambda host, port, files: Endpoint("tls", host=host, port=port, params=tuple(files.items())),
        HOST,
        st.integers(0, 65535),
        st.dictionaries(st.sampled_from(TLS_PARAMS), st.text(max_size=10)),
    ),
    st.builds(lambda path: Endpoint("pty", path=path), PATH),
)


@given(ENDPOINT)
def test_written_values_are_read_back(endpoint: Endpoint) -> None:
    assert Endpoint.parse(str(endpoint)) == endpoint


@given(
    st.text(max_size=60)
    | st.tuples(st.sampled_from(["rtu:", "tcp://", "can:", "pty:"]), st.text(max_size=40)).map("".join)
)
def test_any_text_is_an_endpoint_or_a_usage_error(text: str) -> None:
    try:
        endpoint = Endpoint.parse(text)
    except UsageError:
        return
    assert Endpoint.parse(str(endpoint)) == endpoint


@pytest.mark.parametrize(
    ("url", "expected"),
    [
        ("rtu:COM5", Endpoint("rtu", path="COM5")),
        ("RTU:/dev/ttyS0", Endpoint("rtu", path="/dev/ttyS0")),
        ("tcp://modem", Endpoint("tcp", host="modem", port=502)),
        ("tcp://modem:1502/", Endpoint("tcp", host="modem", port=1502)),
        ("tls://h", Endpoint("tls", host="h", port=802)),
        ("tcp://[::1]", Endpoint("tcp", host="::1", port=502)),
        ("tcp://[::1]:5020", Endpoint("tcp", host="::1", port=5020)),
        ("rtu+tcp://127.0.0.1:0", Endpoint("rtu+tcp", host="127.0.0.1", port=0)),
        ("can:socketcan/can0", Endpoint("can", interface="socketcan", path="can0")),
    ],
)
def test_short_forms_of_endpoints_are_read(url: str, expected: Endpoint) -> None:
    assert Endpoint.parse(url) == expected


@pytest.mark.parametrize(
    ("url", "says"),
    [
        ("", "one of rtu:"),
        ("/dev/ttyS0", "one of rtu:"),
        ("http://h", "one of rtu:"),
        ("rtu:", "has no port"),
        ("tcp:modem:502", "tcp://HOST:PORT"),
        ("tcp://", "tcp://HOST:PORT"),
        ("tcp://h:65536", "0 to 65535"),
        ("tcp://h:²", "0 to 65535"),
        ("tcp://::1", "around an IPv6 address"),
        ("tcp://a b:1", "HOST"),
        ("tcp://me@h:1", "HOST"),
        ("rtu+tcp://h", "rtu+tcp://HOST:PORT"),
        ("can:can0", "can:INTERFACE/CHANNEL"),
        ("rtu:/dev/ttyS0?baudrate=fast", "baud rate"),
        ("rtu:/dev/ttyS0?baudrate=²", "baud rate"),
        ("rtu:/dev/ttyS0?baudrate=49", "50 to 4000000"),
        ("rtu:/dev/ttyS0?frame=9X1", "8E1"),
        ("rtu:/dev/ttyS0?boudrate=9600", "boudrate"),
        ("rtu:/dev/ttyS0?rs485=on", "0 or 1"),
        ("tls://h?certificate=/etc/me.pem", "certificate"),
        ("rtu:/dev/ttyS0?baudrate=9600&baudrate=19200", "more than once"),
        ("pty:line1?frame=9X1", "8E1"),
    ],
)
def test_errors_are_reported(url: str, says: str) -> None:
    with pytest.raises(UsageError) as caught:
        Endpoint.parse(url)
    assert says in str(caught.value)


def test_serial_settings_default_to_those_of_modbus() -> None:
    assert Endpoint.parse("rtu:/dev/ttyS0").serial == SerialSettings(19200, "8E1")
    settings = Endpoint.parse("rtu:/dev/ttyS0?frame=7o2&baudrate=9600").serial
    assert (settings.data_bits, settings.parity, settings.stop_bits, settings.bits_per_char) == (7, "O", 2, 11)
    assert SerialSettings(9600, "8N1").bits_per_char == 10
    assert SerialSettings(9600, "8N1").char_time_s == pytest.approx(10 / 9600)


def test_moving_an_endpoint_keeps_its_protocol() -> None:
    serial = Endpoint.parse("rtu:/dev/ttyS0?baudrate=9600&frame=8N2").with_path("/run/line1")
    assert str(serial) == "rtu:/run/line1?baudrate=9600&frame=8N2"
    assert str(Endpoint.parse("tcp://modem:502").with_address("::1", 1502)) == "tcp://[::1]:1502"
    bus = Endpoint.parse("can:fieldtwin/127.0.0.1:0").with_address("::1", 29536)
    assert bus.address == ("::1", 29536)
    assert Endpoint.parse(str(bus)) == bus


@pytest.mark.parametrize("channel", ["can0", "127.0.0.1:port", ":1", "h:65536"])
def test_the_address_of_a_software_bus_is_checked(channel: str) -> None:
    with pytest.raises(UsageError, match="can:fieldtwin/HOST:PORT"):
        _ = Endpoint.parse(f"can:fieldtwin/{channel}").address


def test_a_message_starts_with_the_place_of_the_error() -> None:
    error = FieldtwinError("broke", expected="this", got="that", where="unit 1", hint="do it").at("line1")
    assert str(error) == "line1: unit 1: broke; expected this; got that (do it)"
