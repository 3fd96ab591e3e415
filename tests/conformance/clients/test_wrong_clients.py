"""Clients with one intentional error each: the corresponding case fails, and its reason names the error."""

from __future__ import annotations

import asyncio
from collections.abc import Callable

import pytest
from clients_in_memory import LAZY_S, Publish, judge, judge_canopen

from fieldtwin.emulators.endpoints.memory_ports import MemoryNet
from fieldtwin.emulators.modbus.rtu.receiver import crc16, with_crc
from fieldtwin.emulators.virtual.clock import VirtualClock
from fieldtwin.gateway.core.canframe import CanFrame
from fieldtwin.gateway.core.connection import ByteConnection
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import ConnectionLost
from fieldtwin.results.model import Verdict

REQUEST = bytes((17, 3, 0, 107, 0, 2))
TIMEOUT_S = 0.2
Take = Callable[[bytes], int | None]


def _first_register(reply: bytes) -> int:
    return int.from_bytes(reply[3:5], "big")


def _believes_all(reply: bytes) -> int | None:
    return _first_register(reply) if len(reply) >= 7 and reply[1] < 0x80 else None


def _checks_crc_only(reply: bytes) -> int | None:
    return _first_register(reply) if len(reply) >= 7 and crc16(reply) == 0 and reply[1] < 0x80 else None


def _zero_for_refusals(reply: bytes) -> int | None:
    if len(reply) == 5:
        return 0
    return _first_register(reply) if reply[:3] == b"\x11\x03\x04" and crc16(reply) == 0 and len(reply) == 9 else None


async def _answer(line: ByteConnection) -> bytes:
    """Return all bytes received within the timeout, up to a pause of 5 ms."""
    got = b""
    try:
        async with asyncio.timeout(TIMEOUT_S):
            got = await line.read()
        while True:
            async with asyncio.timeout(0.030):
                got += await line.read()
    except TimeoutError:
        return got


def _client(take: Take, pause_s: float = LAZY_S) -> Callable[..., object]:
    async def poll(net: MemoryNet, endpoint: Endpoint, clock: VirtualClock, publish: Publish) -> None:
        line = await net.open_bytes(endpoint)
        while True:
            await line.write(with_crc(REQUEST))
            value = take(await _answer(line))
            if value is not None:
                publish(str(value))
            await asyncio.sleep(pause_s)

    return poll


@pytest.mark.parametrize(
    ("take", "case", "says"),
    [
        (_believes_all, "MB-002", "published 3333"),
        (_checks_crc_only, "MB-015a", "published 3333"),
        (_checks_crc_only, "MB-016", "published 3333"),
        (_checks_crc_only, "MB-017b", "published 3333"),
        (_checks_crc_only, "MB-008", "were not accepted"),
        (_zero_for_refusals, "MB-024", "published 0, which no correct answer contained"),
        (_checks_crc_only, "MB-013", "published 3333"),
    ],
)
def test_a_client_that_believes_too_much_or_too_little_fails(take: Take, case: str, says: str) -> None:
    pause_s = 0.0 if case == "MB-013" else LAZY_S
    result = judge(_client(take, pause_s), "rtu:/line?baudrate=19200", case)[case]  # type: ignore[arg-type]
    assert result.verdict is Verdict.FAILED, result.reason
    assert says in result.reason


def test_a_late_reply_is_only_a_failure_if_the_timeout_is_known() -> None:
    client = _client(_checks_crc_only, 0.0)
    result = judge(client, "rtu:/line?baudrate=19200", "MB-013", timeout_s=0.0)["MB-013"]  # type: ignore[arg-type]
    assert result.verdict is Verdict.INCONCLUSIVE
    assert "give --timeout" in result.reason


async def _gives_up(net: MemoryNet, endpoint: Endpoint, clock: VirtualClock, publish: Publish) -> None:
    line = await net.open_bytes(endpoint)
    silences = 0
    while silences < 2:  # the test determines the timeout from the first one
        await line.write(with_crc(REQUEST))
        reply = await _answer(line)
        if _checks_crc_only(reply) is None:
            silences += 1
        else:
            publish(str(_first_register(reply)))
        await asyncio.sleep(LAZY_S)
    await asyncio.Event().wait()


def test_a_client_that_never_asks_again_is_wedged_and_later_cases_are_inconclusive() -> None:
    results = judge(_gives_up, "rtu:/line?baudrate=19200", "MB-003", "MB-014")
    assert results["MB-003"].verdict is Verdict.FAILED
    assert "it has stopped" in results["MB-003"].reason
    assert results["MB-014"].verdict is Verdict.INCONCLUSIVE


async def _floods(net: MemoryNet, endpoint: Endpoint, clock: VirtualClock, publish: Publish) -> None:
    line = await net.open_bytes(endpoint)
    while True:
        await line.write(with_crc(REQUEST))
        value = _checks_crc_only(await _answer(line))
        if value is not None:
            publish(str(value))
            await asyncio.sleep(LAZY_S)


def test_a_client_that_asks_a_busy_device_at_once_does_not_back_off() -> None:
    result = judge(_floods, "rtu:/line?baudrate=19200", "MB-024")["MB-024"]
    assert result.verdict is Verdict.FAILED
    assert "does not back off" in result.reason


async def _naive_sdo(net: MemoryNet, endpoint: Endpoint, clock: VirtualClock, publish: Publish) -> None:
    """Accept any frame with the correct number as the answer."""
    bus = await net.open_can(endpoint, 125_000)
    while True:
        await bus.send(CanFrame(0x605, bytes((0x40, 0x00, 0x20, 0, 0, 0, 0, 0))))
        try:
            async with asyncio.timeout(TIMEOUT_S):
                while (frame := await bus.recv()).can_id != 0x585:
                    pass
                if len(frame.data) == 8 and frame.data[0] >> 5 == 2:
                    publish(str(int.from_bytes(frame.data[4:8], "little")))
        except TimeoutError:
            pass
        await asyncio.sleep(LAZY_S)


def test_a_naive_sdo_client_fails_the_cases_that_it_ignores() -> None:
    results = judge_canopen(_naive_sdo, "CO-001", "CO-005", "CO-060", "CO-008")
    assert "published 14" in results["CO-001"].reason, "the indicated length, taken for the value"
    for case in ("CO-001", "CO-005", "CO-060"):
        assert results[case].verdict is Verdict.FAILED, case
    assert results["CO-008"].verdict is Verdict.PASSED


def _sdo(
    *, whole_s: float = 0.0, stale: bool = False, pdo: bool = False, beat_s: float = 0.0, guards: bool = False
) -> Callable[..., object]:
    """A correct SDO client with one mistake. `whole_s`: its timeout covers a whole transfer; `stale`: it does not stop
    the timer of a finished transfer; `pdo`: it publishes the first bytes of a TPDO; `beat_s`: it commands a node whose
    heartbeat is later than that; `guards`: it requests the state by remote frames, and stops for good at a wrong toggle
    bit."""

    async def poll(net: MemoryNet, endpoint: Endpoint, clock: VirtualClock, publish: Publish) -> None:
        bus, loop = await net.open_can(endpoint, 125_000), asyncio.get_running_loop()
        toggle: int | None = None
        due_s = beat_due_s = 0.0

        async def ask(data: bytes, end_s: float) -> bytes:
            nonlocal toggle, beat_due_s
            await bus.send(CanFrame(0x605, data.ljust(8, b"\0")))
            while True:
                async with asyncio.timeout_at(min(loop.time() + TIMEOUT_S, end_s)):
                    frame = await bus.recv()
                if frame.can_id == 0x185 and pdo:
                    publish(str(int.from_bytes(frame.data[:4], "little")))
                if frame.can_id == 0x705 and guards and frame.data != b"\0":
                    if frame.data[0] & 0x80 == toggle:
                        await asyncio.Event().wait()
                    toggle = frame.data[0] & 0x80
                elif frame.can_id == 0x705 and beat_s:
                    if beat_due_s and loop.time() > beat_due_s:
                        await bus.send(CanFrame(0, b"\x01\x05"))
                    beat_due_s = loop.time() + beat_s
                if frame.can_id == 0x585 and not frame.extended and len(frame.data) == 8:
                    return frame.data

        async def upload() -> bytes:
            end_s = loop.time() + (whole_s or 60.0)
            reply = await ask(b"\x40\x00\x20", min(end_s, due_s) if stale and due_s > loop.time() else end_s)
            value = reply[4:8] if reply[0] & 0xE3 == 0x43 else b""
            at = 0
            while reply[0] == 0x41 and not at & 0x80:
                segment = await ask(bytes((0x60 | at << 4 & 0x10,)), end_s)
                if segment[0] >> 5:
                    return b""
                value += segment[1 : 8 - (segment[0] >> 1 & 7)]
                at = 0x80 if segment[0] & 1 else at + 1
            return value

        while True:
            if guards:
                await bus.send(CanFrame(0x705, remote=True, dlc=1))
            begun_s = loop.time()
            try:
                value = await upload()
                if len(value) == 4:
                    publish(str(int.from_bytes(value, "little")))
            except TimeoutError:
                pass
            due_s = begun_s + TIMEOUT_S
            await asyncio.sleep(0.02 if stale else LAZY_S)

    return poll


@pytest.mark.parametrize(
    ("client", "case", "verdict", "says"),
    [
        (_sdo(whole_s=TIMEOUT_S), "CO-022", Verdict.FAILED, "were not accepted"),
        (_sdo(stale=True), "CO-024", Verdict.FAILED, "asked again 0.0"),
        (_sdo(pdo=True), "CO-043", Verdict.FAILED, "published 5, which no correct answer contained"),
        (_sdo(pdo=True), "CO-044", Verdict.FAILED, "published 3333"),
        (_sdo(beat_s=1.1), "CO-037", Verdict.INCONCLUSIVE, "consumer time is shorter"),
        (_sdo(beat_s=1.5), "CO-037", Verdict.PASSED, ""),
        (_sdo(guards=True), "CO-040", Verdict.FAILED, "was not published"),
        (_sdo(), "CO-040", Verdict.SKIPPED, "the client or master sent no guard request"),
        (_sdo(), "CO-006", Verdict.SKIPPED, "the client or master sent no download"),
        (_sdo(), "CO-002", Verdict.PASSED, ""),
        (_sdo(), "CO-022", Verdict.PASSED, ""),
        (_sdo(), "CO-024", Verdict.PASSED, ""),
        (_sdo(), "CO-038", Verdict.INCONCLUSIVE, "configures no node"),
    ],
)
def test_one_mistake_of_an_sdo_client_is_one_failure(
    client: Callable[..., object], case: str, verdict: Verdict, says: str
) -> None:
    result = judge_canopen(client, case)[case]  # type: ignore[arg-type]
    assert result.verdict is verdict, result.reason
    assert says in result.reason


def _tcp(request: bytes, *, closes: bool = True, again: bool = False) -> Callable[..., object]:
    """A TCP client with one connection as long as it lasts. Unless it `closes`, it opens a new connection for each
    request and keeps the old ones open. `again`: it repeats unanswered requests once."""

    async def poll(net: MemoryNet, endpoint: Endpoint, clock: VirtualClock, publish: Publish) -> None:
        links: list[ByteConnection] = []
        while True:
            try:
                if not links or not closes or links[-1].lost is not None:
                    links.append(await net.open_bytes(endpoint))
                for pdu in (READ, request) if request else (READ,):
                    for _ in range(2 if again else 1):
                        await links[-1].write(bytes((0, 1, 0, 0, 0, len(pdu))) + pdu)
                        reply = await _answer(links[-1])
                        if reply:
                            break
                    if pdu == READ and len(reply) == 11:
                        publish(str(int.from_bytes(reply[9:11], "big")))
            except ConnectionLost:
                pass
            await asyncio.sleep(LAZY_S)

    return poll


READ = bytes((17, 3, 0, 107, 0, 1))
TO_ALL = bytes((0, 6, 0, 1, 0, 1))


@pytest.mark.parametrize(
    ("client", "case", "says"),
    [
        (_tcp(b""), "MB-064c", "was not published"),
        (_tcp(b"", closes=False), "MB-065b", "connections at once"),
        (_tcp(TO_ALL, again=True), "MB-028", "it waited for an answer"),
    ],
)
def test_a_client_that_handles_connections_badly_fails(client: Callable[..., object], case: str, says: str) -> None:
    result = judge(client, "tcp://127.0.0.1:0", case)[case]  # type: ignore[arg-type]
    assert result.verdict is Verdict.FAILED, result.reason
    assert says in result.reason


def test_a_write_to_unit_0_that_is_sent_once_passes() -> None:
    result = judge(_tcp(TO_ALL), "tcp://127.0.0.1:0", "MB-028")["MB-028"]  # type: ignore[arg-type]
    assert result.verdict is Verdict.PASSED, result.reason


def _in_ascii(*, checks: bool, newest: bool) -> Callable[..., object]:
    """An ASCII client on a line. It `checks` the LRC or not, and treats the `newest` colon or the first one as the
    start."""
    asked = b":" + (REQUEST + bytes((-sum(REQUEST) & 0xFF,))).hex().upper().encode() + b"\r\n"

    async def poll(net: MemoryNet, endpoint: Endpoint, clock: VirtualClock, publish: Publish) -> None:
        line = await net.open_bytes(endpoint)
        while True:
            await line.write(asked)
            text = (await _answer(line)).strip()
            try:
                reply = bytes.fromhex(text[(text.rfind(b":") if newest else 0) + 1 :].replace(b":", b"").decode())
            except ValueError:
                reply = b""
            if len(reply) >= 8 and (not checks or sum(reply) & 0xFF == 0):
                publish(str(_first_register(reply)))
            await asyncio.sleep(LAZY_S)

    return poll


@pytest.mark.parametrize(
    ("checks", "newest", "case", "says"),
    [(False, True, "MB-070a", "published 3333"), (True, False, "MB-070b", "were not accepted")],
)
def test_a_client_that_reads_ascii_badly_fails(checks: bool, newest: bool, case: str, says: str) -> None:
    client = _in_ascii(checks=checks, newest=newest)
    result = judge(client, "ascii:/line?baudrate=19200&frame=7E1", case)[case]  # type: ignore[arg-type]
    assert result.verdict is Verdict.FAILED, result.reason
    assert says in result.reason
