"""Decode one Modbus connection of a trace: the chunks of both directions become texts and exchanges.

On a serial line at most one request is open, and the next request ends it; on MBAP replies are matched by their transaction
ID. A frame that answers no request is a stray. The decoder reads no clock: the caller gives the time of each chunk.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass

from fieldtwin.capture.decoding.exchange import SECRET, DecodedExchange, TouchedSpan
from fieldtwin.capture.decoding.modbus_frames import Expected, ModbusFrame, splitter
from fieldtwin.capture.decoding.modbus_pdu import DecodedRequest, parse_reply, parse_request, words
from fieldtwin.capture.decoding.tags import TagMap
from fieldtwin.gateway.core.values import Scalar

MAX_OPEN = 64
"""Maximum number of open requests on an MBAP connection; an older one counts as unanswered."""

STRAY_SHOWN = 32
"""The largest number of bytes of a stray frame that its text shows; the exchange contains all of them."""


@dataclass(frozen=True, slots=True)
class KnownUnit:
    """A device on the connection: its name in the system and its tags."""

    name: str
    tags: TagMap


@dataclass(slots=True)
class _Open:
    frame: ModbusFrame
    asked: DecodedRequest
    device: str
    tags: TagMap | None
    text: str = ""


class ModbusConnectionDecoder:
    """The decoder of one Modbus connection.

    `framing` is rtu, ascii, mbap or udp. `echo`: the line returns the sent bytes before the reply. `served`: the remote side is
    the client.
    """

    def __init__(
        self, bus: str, framing: str, units: dict[int, KnownUnit], *, echo: bool = False, served: bool = False
    ) -> None:
        self.bus = bus
        self.framing = framing
        self.served = served
        self._units = units
        self._serial = framing in ("rtu", "ascii")
        self._requests, self._replies = splitter(framing), splitter(framing)
        self._datagrams = framing == "udp"
        self._echo = echo and self._serial
        self._echo_due = b""
        self._open: dict[int, _Open] = {}  # by transaction ID; a serial line has one entry, with ID -1
        self._given_up: deque[int] = deque(maxlen=MAX_OPEN)
        self._cut_off = False

    @property
    def tags(self) -> dict[int, TagMap]:
        """Return the tags of the known devices by unit ID."""
        return {unit: known.tags for unit, known in self._units.items()}

    def feed(self, sent: bool, data: bytes, t_ns: int) -> tuple[list[str], list[DecodedExchange]]:
        """Add a chunk, in the order of the trace. Return texts, one for each whole or partial frame, and the completed
        exchanges.
        """
        return self._take_requests(data, t_ns) if sent != self.served else self._take_replies(data, t_ns)

    def finish(self) -> list[DecodedExchange]:
        """End the trace: return the requests that are still open, as unanswered."""
        texts: list[str] = []
        done: list[DecodedExchange] = []
        self._settle(texts, done)
        done += [self._unanswered(o) for o in self._open.values()]
        self._open.clear()
        return done

    def pending(self) -> list[DecodedExchange]:
        """Return the requests whose reply may still come, the oldest first. The call has no side effects."""
        size = self._replies.pending
        text = f"pending, {_bytes(size)} of a reply so far" if size else "pending"
        return [self._exchange(opened, None, "pending", text) for opened in self._open.values()]

    # -- requests -----------------------------------------------------------------------------------------------------

    def _take_requests(self, data: bytes, t_ns: int) -> tuple[list[str], list[DecodedExchange]]:
        texts: list[str] = []
        done: list[DecodedExchange] = []
        frames = self._requests.feed(data, t_ns)
        if not self.served:
            frames += self._requests.flush()  # each chunk that is sent is one whole frame
            self._echo_due = data if self._echo else b""
        for frame in frames:
            if frame.bad:
                texts.append(f"{_bytes(len(frame.raw))} that are not a request ({frame.bad})")
                continue
            if self._serial:
                self._settle(texts, done)
                done += [self._unanswered(o) for o in self._open.values()]
                self._open.clear()
            texts.append(self._request(frame, done))
        return texts or [f"{_bytes(self._requests.pending)} of a request"], done

    def _request(self, frame: ModbusFrame, done: list[DecodedExchange]) -> str:
        unit, asked = self._units.get(frame.unit), parse_request(frame.pdu)
        opened = _Open(frame, asked, unit.name if unit else "", unit.tags if unit else None)
        text = opened.text = self._describe(opened)
        if frame.unit == 0 and self._serial:
            done.append(self._exchange(opened, None, "", ""))
            return f"{text}, to all"
        if (replaced := self._open.pop(frame.transaction, None)) is not None:
            done.append(self._unanswered(replaced))
        self._cut_off = self._replies.pending > 0  # the reply may continue, or the connection was lost and replaced
        if len(self._open) >= MAX_OPEN:
            done.append(self._unanswered(self._open.pop(next(iter(self._open)))))
        self._open[frame.transaction] = opened
        return text

    def _describe(self, opened: _Open) -> str:
        asked = opened.asked
        text = f"{opened.device or f'unit {opened.frame.unit}'}: {asked.service}"
        if asked.problem:
            return f"{text}, malformed: {opened.frame.pdu.hex(' ')}"
        if asked.spans:
            text += f" {' and '.join(map(str, asked.spans))}"
        span = asked.write_span
        if span is not None and asked.written:
            text += f": {_values(opened.tags, span, asked.written, opened.frame.t_ns)}"
        elif span is not None and span.table == "holding":
            text += f": AND {opened.frame.pdu[3:5].hex()}h, OR {opened.frame.pdu[5:7].hex()}h"
        return text

    # -- replies ------------------------------------------------------------------------------------------------------

    def _take_replies(self, data: bytes, t_ns: int) -> tuple[list[str], list[DecodedExchange]]:
        texts: list[str] = []
        done: list[DecodedExchange] = []
        if self._echo_due:
            echo = data[: len(self._echo_due)]
            if echo == self._echo_due[: len(echo)]:
                self._echo_due = self._echo_due[len(echo) :]
                data = data[len(echo) :]
                texts.append("echo")
                if not data:
                    return texts, done
            else:
                self._echo_due = b""
                texts.append("the echo differs from what was sent: a collision")
        if self._datagrams or (self._cut_off and self._begins_a_reply(data)):
            self._judge(self._replies.flush(), texts, done)
        self._cut_off = False
        self._judge(self._replies.feed(data, t_ns, self._expected()), texts, done)
        if not texts:
            texts = [f"{_bytes(self._replies.pending)} of a reply"]
        return texts, done

    def _begins_a_reply(self, data: bytes) -> bool:
        """Return whether `data` begins an awaited answer although another answer is incomplete (MBAP)."""
        opened = self._open.get(int.from_bytes(data[:2])) if len(data) >= 7 else None
        return opened is not None and data[2:4] == b"\0\0" and data[6] == opened.frame.unit

    def _expected(self) -> Expected | None:
        opened = self._open.get(-1)
        if opened is None:
            return None
        return Expected(opened.frame.unit, opened.asked.function, opened.asked.reply_bytes)

    def _settle(self, texts: list[str], done: list[DecodedExchange]) -> None:
        """End the current reply, because a new request begins: the bytes so far are either a complete reply or noise."""
        self._judge(self._replies.flush(self._expected()), texts, done)

    def _judge(self, frames: Iterable[ModbusFrame], texts: list[str], done: list[DecodedExchange]) -> None:
        for frame in frames:
            opened = self._open.get(frame.transaction)
            ours = opened is not None and frame.unit == opened.frame.unit and frame.pdu
            if not ours or opened is None or (frame.bad and frame.bad != "check sum"):
                texts.append(self._stray(frame, done))
                continue
            del self._open[frame.transaction]
            if not self._serial and not self.served:
                done += self._older(opened)
            if frame.bad:
                done.append(self._exchange(opened, frame, frame.bad, "damaged: the check sum is wrong"))
            else:
                done.append(self._answered(opened, frame))
            texts.append(f"{opened.device or f'unit {frame.unit}'}: {done[-1].reply_text}")

    def _older(self, answered: _Open) -> list[DecodedExchange]:
        """End older requests as unanswered: the gateway sends one request at a time, so it no longer waits for the older ones."""
        older = [t for t, o in self._open.items() if o.frame.t_ns <= answered.frame.t_ns]
        self._given_up.extend(older)
        return [self._unanswered(self._open.pop(t)) for t in older]

    def _stray(self, frame: ModbusFrame, done: list[DecodedExchange]) -> str:
        if frame.bad:
            return f"{_bytes(len(frame.raw))} of noise ({frame.bad})"
        unit = self._units.get(frame.unit) or self._sender_of(frame)
        name = unit.name if unit else ""
        late = frame.transaction in self._given_up
        why = "a late reply" if late else "a reply without a request"
        transaction = frame.transaction if frame.transaction >= 0 else None
        hidden = unit is not None and unit.tags.has_secrets
        text = f"{name or f'unit {frame.unit}'}: {why}: {_identified(frame.unit, transaction)}, "
        text += f"{SECRET}: the device has secret tags" if hidden else _shortened(frame.raw)
        done.append(
            DecodedExchange(
                frame.t_ns, frame.t_ns, self.bus, name, frame.unit, frame.pdu[0] & 0x7F if frame.pdu else 0, "stray",
                reply=frame.raw, problem="stray", text=text, reply_text=text, secrets=frozenset({""}) if hidden else frozenset(),
                transaction=transaction,
            )
        )  # fmt: skip
        return text

    def _sender_of(self, frame: ModbusFrame) -> KnownUnit | None:
        """Return the sender of a frame with an unknown unit ID: the device of the request, or the only device."""
        opened = self._open.get(frame.transaction)
        if opened is not None and opened.frame.unit in self._units:
            return self._units[opened.frame.unit]
        return next(iter(self._units.values())) if len(self._units) == 1 else None

    def _answered(self, opened: _Open, frame: ModbusFrame) -> DecodedExchange:
        answer = parse_reply(opened.asked, opened.frame.pdu, frame.pdu)
        span, text = opened.asked.read_span, answer.detail or "done"
        registers: tuple[int, ...] = ()
        tags: dict[str, Scalar | None] = {}
        if span is not None and answer.read:
            registers = words(span, answer.read)
            if opened.tags is not None:
                tags = opened.tags.of_registers(span, answer.read, frame.t_ns)
            text = _shown(opened.tags, span, tags, registers)
        return self._exchange(opened, frame, answer.problem, text, registers, tags, answer.exception)

    def _unanswered(self, opened: _Open) -> DecodedExchange:
        return self._exchange(opened, None, "no reply", "no reply")

    def _exchange(
        self,
        opened: _Open,
        reply: ModbusFrame | None,
        problem: str,
        reply_text: str,
        registers: tuple[int, ...] = (),
        tags: dict[str, Scalar | None] | None = None,
        exception: int | None = None,
    ) -> DecodedExchange:
        asked, frame, found = opened.asked, opened.frame, dict(tags or {})
        span = asked.write_span
        if span is not None and asked.written:
            registers = words(span, asked.written) + registers
            if opened.tags is not None:
                found |= opened.tags.of_registers(span, asked.written, frame.t_ns)
        if opened.tags is not None:
            for touched in asked.spans:
                for name in opened.tags.names(touched):
                    found.setdefault(name, None)
        return DecodedExchange(
            t_ns=frame.t_ns,
            end_ns=reply.t_ns if reply else frame.t_ns,
            bus=self.bus,
            device=opened.device,
            unit=frame.unit,
            function=asked.function,
            service=asked.service,
            spans=asked.spans,
            registers=registers,
            tags=found,
            exception=exception,
            latency_ns=reply.t_ns - frame.t_ns if reply else None,
            request=frame.raw,
            reply=reply.raw if reply else b"",
            problem=problem or asked.problem,
            text=opened.text,
            reply_text=reply_text,
            secrets=opened.tags.secrets(asked.spans) if opened.tags is not None else frozenset(),
            transaction=frame.transaction if frame.transaction >= 0 else None,
        )


def _values(tags: TagMap | None, span: TouchedSpan, data: bytes, t_ns: int) -> str:
    found = tags.of_registers(span, data, t_ns) if tags is not None else {}
    return _shown(tags, span, found, words(span, data))


def _shown(tags: TagMap | None, span: TouchedSpan, found: dict[str, Scalar | None], registers: tuple[int, ...]) -> str:
    """Return the tags as text; without tags, return the register words."""
    if tags is not None and found:
        return tags.show(found)
    if tags is not None and tags.secret(span):
        return SECRET
    most = 8
    numbers = " ".join(str(r) if span.table in ("coil", "discrete") else f"{r:04X}" for r in registers[:most])
    return numbers + (f" ... ({len(registers)})" if len(registers) > most else "")


def _identified(unit: int, transaction: int | None) -> str:
    return f"unit {unit}" if transaction is None else f"transaction {transaction}, unit {unit}"


def _shortened(raw: bytes) -> str:
    """Return the bytes in hex, the first `STRAY_SHOWN` of them."""
    more = f" ... ({_bytes(len(raw))})" if len(raw) > STRAY_SHOWN else ""
    return raw[:STRAY_SHOWN].hex(" ") + more


def _bytes(count: int) -> str:
    return f"{count} byte" + "s" * (count != 1)
