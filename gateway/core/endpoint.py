"""Endpoints are URLs that name a port, socket or bus and the protocol used on it.

==================================================  =====================================================
``rtu:/dev/ttyUSB0?baudrate=19200&frame=8E1``       Modbus RTU on a serial port (``rtu:COM5`` on Windows)
``ascii:/dev/ttyUSB0?baudrate=9600&frame=7E1``      Modbus ASCII on a serial port
``tcp://host:502``                                  Modbus TCP; raw bytes if the remote end is a serial line
``rtu+tcp://host:4001``                             Modbus RTU frames in a TCP stream
``udp://host:502``                                  Modbus TCP's ADUs in datagrams
``tls://host:802?ca=FILE&cert=FILE&key=FILE``       Modbus/TCP Security; ``name=HOST`` if the certificate has another name
``can:socketcan/can0``                              a kernel CAN interface
``can:fieldtwin/127.0.0.1:29536``                   the software CAN bus
``can:pcan/PCAN_USBBUS1?bitrate=250000``            an adapter of python-can: pcan, kvaser, slcan, virtual...
``pty:line1``                                       (listening side only) a virtual serial port with that link name
==================================================  =====================================================

A serial port also accepts ``rs485=1``: the driver switches the transceiver's direction. An RTU port accepts
``silence_us=1000``: the silence before a request, in microseconds. An endpoint names the files that hold secrets and
never contains the secrets, because endpoints appear in messages, logs and reports.

This module only handles text: it opens nothing and does not depend on the operating system.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from urllib.parse import parse_qsl, urlencode

from fieldtwin.gateway.core.errors import UsageError
from fieldtwin.gateway.core.files.nearest import did_you_mean

SERIAL_SCHEMES = ("rtu", "ascii")
SOCKET_SCHEMES = ("tcp", "rtu+tcp", "udp", "tls")
SCHEMES = (*SERIAL_SCHEMES, *SOCKET_SCHEMES, "can", "pty")
DEFAULT_PORTS = {"tcp": 502, "udp": 502, "tls": 802}

SERIAL_PARAMS = ("baudrate", "frame", "rs485", "silence_us")
MOST_SILENCE_US = 100_000
TLS_PARAMS = ("ca", "cert", "key", "name")

_FRAME = re.compile(r"^([78])([NEO])([12])$")
_NUMBER = re.compile(r"^[0-9]{1,9}$")  # str.isdigit also takes digits that int() refuses
_HOST = re.compile(r"^(\[[^\s\[\]/?#@]+\]|[^\s\[\]/?#@:]+)$")


@dataclass(frozen=True, slots=True)
class SerialSettings:
    """The settings that both ends of a serial line must share.

    `frame` is written as in manuals: data bits, parity N/E/O, stop bits.
    """

    baudrate: int = 19200
    frame: str = "8E1"

    @property
    def data_bits(self) -> int:
        return int(self.frame[0])

    @property
    def parity(self) -> str:
        return self.frame[1]

    @property
    def stop_bits(self) -> int:
        return int(self.frame[2])

    @property
    def bits_per_char(self) -> int:
        """Return the number of bits that a character takes on the line: start, data, parity if any, stop."""
        return 1 + self.data_bits + (self.parity != "N") + self.stop_bits

    @property
    def char_time_s(self) -> float:
        """Return the seconds that one character takes on the line."""
        return self.bits_per_char / self.baudrate


@dataclass(frozen=True, slots=True)
class Endpoint:
    """A parsed endpoint URL.

    `path` is the device path of a serial port, the channel of a CAN interface, or the link name of a pty.
    `interface` is the kind of CAN interface (``socketcan``, ``fieldtwin``...). Parameters keep their order.
    """

    scheme: str
    host: str = ""
    port: int = 0
    path: str = ""
    interface: str = ""
    params: tuple[tuple[str, str], ...] = ()

    @classmethod
    def parse(cls, url: str) -> Endpoint:
        """Read a URL. Raises `UsageError` with the part that is wrong."""
        scheme, colon, rest = url.partition(":")
        scheme = scheme.lower()
        if not colon or scheme not in SCHEMES:
            raise UsageError(
                f"cannot read endpoint {url!r}",
                expected="one of " + ", ".join(f"{s}:" for s in SCHEMES),
                hint=_hint_for(url, scheme if colon else ""),
            )
        rest, _, query = rest.partition("?")
        params = tuple(parse_qsl(query, keep_blank_values=True))
        if scheme in SOCKET_SCHEMES:
            host, port = _host_port(url, scheme, rest)
            endpoint = cls(scheme, host=host, port=port, params=params)
        elif scheme == "can":
            interface, slash, channel = rest.partition("/")
            if not slash or not interface or not channel:
                raise UsageError(f"cannot read endpoint {url!r}", expected="can:INTERFACE/CHANNEL")
            endpoint = cls(scheme, interface=interface, path=channel, params=params)
        else:
            if not rest:
                raise UsageError(f"endpoint {url!r} has no port", expected=f"{scheme}:PATH")
            endpoint = cls(scheme, path=rest, params=params)
        _check_params(endpoint)
        return endpoint

    @property
    def is_serial(self) -> bool:
        return self.scheme in SERIAL_SCHEMES

    @property
    def is_can(self) -> bool:
        return self.scheme == "can"

    def param(self, name: str, default: str = "") -> str:
        """Return the value of a parameter, or `default`."""
        return dict(self.params).get(name, default)

    @property
    def serial(self) -> SerialSettings:
        """Return baud rate and frame of a serial endpoint. Defaults are those of Modbus: 19200 8E1, ASCII 7E1 (SL
        2.5.1, 2.5.2).
        """
        usual = "7E1" if self.scheme == "ascii" else "8E1"
        text, frame = self.param("baudrate", "19200"), self.param("frame", usual).upper()
        if not _NUMBER.match(text) or not 50 <= int(text) <= 4_000_000:
            raise UsageError(f"endpoint {self}: baud rate", expected="a number from 50 to 4000000", got=repr(text))
        if not _FRAME.match(frame):
            raise UsageError(
                f"endpoint {self}: frame", expected="data bits, parity, stop bits such as 8E1 or 8N2", got=repr(frame)
            )
        return SerialSettings(int(text), frame)

    @property
    def rs485(self) -> bool:
        """Return whether the serial port's driver has to switch the direction of an RS485 transceiver."""
        text = self.param("rs485", "0")
        if text not in ("0", "1"):
            raise UsageError(f"endpoint {self}: rs485", expected="0 or 1", got=repr(text))
        return text == "1"

    @property
    def silence_s(self) -> float | None:
        """Return the silence in seconds that a Modbus RTU client keeps before a request, or None for the recommended
        one.

        Above 19200 baud the standard recommends 1.75 ms (SL 2.5.1.1). Some devices accept a shorter silence; it must be at least
        3.5 characters.
        """
        text = self.param("silence_us")
        if not text:
            return None
        if self.scheme != "rtu":
            raise UsageError(
                f"endpoint {self}: silence_us", expected="an rtu: endpoint; only RTU frames end with a silence"
            )
        least_us = -int(-3.5e6 * self.serial.char_time_s // 1)
        if not _NUMBER.match(text) or not least_us <= int(text) <= MOST_SILENCE_US:
            expected = f"{least_us} (3.5 characters) to {MOST_SILENCE_US} microseconds"
            raise UsageError(f"endpoint {self}: silence_us", expected=expected, got=repr(text))
        return int(text) / 1e6

    @property
    def address(self) -> tuple[str, int]:
        """Return host and port of a socket endpoint, or of a software CAN bus."""
        if self.is_can:
            host, _, port = self.path.rpartition(":")
            if not _HOST.match(host) or not _NUMBER.match(port) or int(port) > 65535:
                raise UsageError(f"cannot read endpoint {self}", expected="can:fieldtwin/HOST:PORT")
            return host.strip("[]"), int(port)
        return self.host, self.port

    def with_path(self, path: str) -> Endpoint:
        """Return the same endpoint, baud rate and frame included, on another serial port or channel."""
        return replace(self, path=path)

    def with_address(self, host: str, port: int) -> Endpoint:
        """Return the same endpoint on another host and port."""
        if self.is_can:
            return replace(self, path=f"{_bracketed(host)}:{port}")
        return replace(self, host=host, port=port)

    def __str__(self) -> str:
        query = f"?{urlencode(self.params)}" if self.params else ""
        if self.scheme in SOCKET_SCHEMES:
            return f"{self.scheme}://{_bracketed(self.host)}:{self.port}{query}"
        if self.is_can:
            return f"can:{self.interface}/{self.path}{query}"
        return f"{self.scheme}:{self.path}{query}"


def _bracketed(host: str) -> str:
    return f"[{host}]" if ":" in host else host


def _check_params(endpoint: Endpoint) -> None:
    """Raise `UsageError` for repeated, invalid and misspelt parameters, before the port is opened."""
    names = [name for name, _ in endpoint.params]
    for name in names:
        if names.count(name) > 1:
            raise UsageError(f"endpoint {endpoint}: {name!r} is given more than once")
        known = SERIAL_PARAMS if endpoint.is_serial else TLS_PARAMS if endpoint.scheme == "tls" else ()
        if known and name not in known:
            raise UsageError(f"endpoint {endpoint}: unknown setting", expected=" or ".join(known), got=repr(name))
    if endpoint.is_serial or endpoint.scheme == "pty":
        endpoint.serial  # noqa: B018  reading it checks it
        endpoint.rs485  # noqa: B018
        endpoint.silence_s  # noqa: B018


def _hint_for(url: str, scheme: str) -> str:
    """Return a hint for a text that is not an endpoint: a device's path without its scheme, or a misspelt scheme."""
    if url.startswith("/dev/"):
        return f"a serial port is rtu:{url}?baudrate=9600&frame=8N1"
    return did_you_mean(scheme, SCHEMES)


def _host_port(url: str, scheme: str, rest: str) -> tuple[str, int]:
    """Split ``//host:port``; the port may be left out where the scheme has a standard one."""
    if not rest.startswith("//"):
        raise UsageError(f"cannot read endpoint {url!r}", expected=f"{scheme}://HOST:PORT")
    host, colon, port = rest[2:].rstrip("/").rpartition(":")
    if not colon or "]" in port:  # no port given (the colons of an IPv6 address are inside its brackets)
        host, port = rest[2:].rstrip("/"), str(DEFAULT_PORTS.get(scheme, ""))
    if not _HOST.match(host) or not _NUMBER.match(port) or int(port) > 65535:
        raise UsageError(
            f"cannot read endpoint {url!r}",
            expected=f"{scheme}://HOST:PORT, port 0 to 65535, [..] around an IPv6 address",
        )
    return host.strip("[]"), int(port)
