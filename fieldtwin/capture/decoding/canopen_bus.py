"""Decode the CANopen traffic of one CAN bus of a trace: frames become texts and exchanges (CiA 301, CiA 305).

Identifiers are those of the pre-defined connection set, except for PDOs, whose identifiers are learnt (see `node_map`). The
decoder reads no clock: the caller gives the time of each frame.
"""

from __future__ import annotations

from collections.abc import Iterable

from fieldtwin.capture.decoding.exchange import SECRET, DecodedExchange, TouchedSpan
from fieldtwin.capture.decoding.lss import LssWatch
from fieldtwin.capture.decoding.node_map import NodeMap, Pdo
from fieldtwin.capture.decoding.sdo import SdoWatch, Seen, Transfer
from fieldtwin.capture.decoding.tags import show_value
from fieldtwin.gateway.core.canframe import CanFrame
from fieldtwin.gateway.core.errors import FieldtwinError
from fieldtwin.gateway.core.values import Scalar
from fieldtwin.gateway.devices.config import DeviceConfig
from fieldtwin.gateway.protocols.canopen import cob_id
from fieldtwin.gateway.protocols.canopen.emcy import parse_emcy
from fieldtwin.gateway.protocols.canopen.nmt.states import NmtCommand, NmtState, heartbeat_state
from fieldtwin.gateway.protocols.canopen.sdo.abort_codes import meaning

_COMMANDS = {int(c): c.name.lower().replace("_", " ").replace("pre operational", "pre-operational") for c in NmtCommand}
_STATES = {s: s.name.replace("_", "-") for s in NmtState}
_PDO_AREA = range(0x180, 0x580)


class CanopenBusDecoder:
    """The decoder of one bus: its nodes, and the open transfers between them and their master."""

    def __init__(self, bus: str, devices: Iterable[DeviceConfig]) -> None:
        self.bus = bus
        self.nodes = {d.address: NodeMap(d) for d in devices}
        """The known nodes, with the PDO mappings that were learnt so far."""
        self._sdo: dict[int, SdoWatch] = {}
        self._lss = LssWatch(bus)
        self._pdos: dict[int, Pdo] = {}
        self._find_pdos()

    def feed(self, frame: CanFrame, t_ns: int) -> tuple[str, list[DecodedExchange]]:
        """Decode the next frame of the trace; return its description and the exchanges that it completed."""
        if frame.error:
            return "error frame", []
        if frame.extended:
            return f"{frame}: not CANopen (29-bit identifier)", []
        if frame.remote:
            return f"asks for {frame.can_id:03X}h", []
        number, node = frame.can_id, frame.can_id & 0x7F
        if number in self._pdos:
            return self._pdo(self._pdos[number], frame.data, t_ns)
        if number == cob_id.NMT:
            return self._nmt(frame.data, t_ns)
        if number == cob_id.SYNC:
            counter = f" {frame.data[0]}" if frame.data else ""
            return self._message(t_ns, 0, "SYNC", f"SYNC{counter}", frame.data)
        if number == cob_id.TIME:
            return self._message(t_ns, 0, "TIME", f"TIME {frame.data.hex(' ')}", frame.data)
        if number in (cob_id.LSS_REQUEST, cob_id.LSS_REPLY):
            return self._lss.feed(frame.data, number == cob_id.LSS_REPLY, t_ns)
        match number & 0x780:
            case cob_id.EMCY_BASE:
                return self._emcy(node, frame.data, t_ns)
            case cob_id.SDO_REQUEST_BASE | cob_id.SDO_RESPONSE_BASE if node:
                return self._on_sdo(node, number < cob_id.SDO_REQUEST_BASE, frame.data, t_ns)
            case cob_id.HEARTBEAT_BASE if node:
                return self._heartbeat(node, frame.data, t_ns)
        if number in _PDO_AREA and node:
            sends, at = bool(number & 0x80), number // 0x100
            return self._pdo(
                Pdo(node, f"{'TPDO' if sends else 'RPDO'}{at - (not sends)}", sends, None), frame.data, t_ns
            )
        return f"{frame}: not a CANopen identifier", []

    def finish(self) -> list[DecodedExchange]:
        """End the trace: return the requests that are still open, as unanswered."""
        dropped = [(node, watch.drop()) for node, watch in self._sdo.items()]
        return [self._transferred(node, t, t.t_ns, "no reply") for node, t in dropped if t] + self._lss.finish()

    def pending(self) -> list[DecodedExchange]:
        """Return the requests whose reply may still come. The call has no side effects."""
        open_ = [(node, watch.open) for node, watch in self._sdo.items()]
        return [self._transferred(node, t, t.t_ns, "pending") for node, t in open_ if t] + self._lss.pending()

    # -- unanswered messages -------------------------------------------------------------------------------------------

    def _message(
        self,
        t_ns: int,
        node: int,
        service: str,
        text: str,
        data: bytes,
        *,
        spans: tuple[TouchedSpan, ...] = (),
        tags: dict[str, Scalar | None] | None = None,
        value: Scalar | None = None,
        problem: str = "",
    ) -> tuple[str, list[DecodedExchange]]:
        return text, [
            DecodedExchange(
                t_ns, t_ns, self.bus, self._device(node), node, 0, service, spans, tags=tags or {}, request=data,
                problem=problem, text=text, value=value, secrets=self._secrets(node, spans),
            )
        ]  # fmt: skip

    def _device(self, node: int) -> str:
        return self.nodes[node].name if node in self.nodes else ""

    def _secrets(self, node: int, spans: tuple[TouchedSpan, ...]) -> frozenset[str]:
        return self.nodes[node].tags.secrets(spans) if node in self.nodes else frozenset()

    def _called(self, node: int) -> str:
        return self._device(node) or f"node {node}"

    def _nmt(self, data: bytes, t_ns: int) -> tuple[str, list[DecodedExchange]]:
        if len(data) != 2:
            return self._message(t_ns, 0, "NMT", f"NMT of {len(data)} bytes", data, problem="malformed")
        command = _COMMANDS.get(data[0], f"command {data[0]:02X}h")
        whom = self._called(data[1]) if data[1] else "all nodes"
        return self._message(t_ns, data[1], f"NMT {command}", f"{whom}: NMT {command}", data)

    def _emcy(self, node: int, data: bytes, t_ns: int) -> tuple[str, list[DecodedExchange]]:
        try:
            emcy = parse_emcy(data)
        except FieldtwinError as e:
            return self._message(t_ns, node, "EMCY", f"{self._called(node)}: {e.message}", data, problem="malformed")
        text = f"{self._called(node)}: EMCY {emcy.code:04X}h {emcy.meaning}"
        return self._message(t_ns, node, "EMCY", text, data, value=emcy.code)

    def _heartbeat(self, node: int, data: bytes, t_ns: int) -> tuple[str, list[DecodedExchange]]:
        state = heartbeat_state(data)
        if state is None:
            text = f"{self._called(node)}: error control {data.hex(' ')}"
            return self._message(t_ns, node, "error control", text, data)
        booted = state is NmtState.INITIALISING
        text = f"{self._called(node)}: {'boot-up' if booted else _STATES[state]}"
        return self._message(t_ns, node, "boot-up" if booted else "heartbeat", text, data, value=_STATES[state])

    def _pdo(self, pdo: Pdo, data: bytes, t_ns: int) -> tuple[str, list[DecodedExchange]]:
        head, node = f"{self._called(pdo.node)}: {pdo.name}", self.nodes.get(pdo.node)
        if pdo.mapping is None or node is None:
            return self._message(t_ns, pdo.node, pdo.name, f"{head} {data.hex(' ')}", data)
        try:
            values = pdo.mapping.unpack(data)
        except FieldtwinError:
            mapped = [TouchedSpan("read", "object", e.index, 1, e.subindex) for e in pdo.mapping.entries]
            said = SECRET if node.tags.secrets(mapped) else data.hex(" ")
            text = f"{head} {said}, {pdo.mapping.length} bytes were mapped"
            return self._message(t_ns, pdo.node, pdo.name, text, data, problem="malformed")
        access = "read" if pdo.sends else "write"
        tags: dict[str, Scalar | None] = {}
        others, spans = [], []
        for entry, raw in zip(pdo.mapping.entries, values, strict=True):
            spans.append(TouchedSpan("read" if access == "read" else "write", "object", entry.index, 1, entry.subindex))
            found, value = node.value(entry.index, entry.subindex, raw, t_ns)
            tags |= found
            if not found and node.tags.secrets(spans[-1:]):
                others.append(f"{node.named(entry.index, entry.subindex)} {SECRET}")
            elif not found:
                others.append(f"{node.named(entry.index, entry.subindex)} {show_value(value)}")
        said = ", ".join(filter(None, [node.tags.show(tags), *others]))
        return self._message(t_ns, pdo.node, pdo.name, f"{head} {said}", data, spans=tuple(spans), tags=tags)

    # -- SDO --------------------------------------------------------------------------------------------------------

    def _on_sdo(self, node: int, reply: bool, data: bytes, t_ns: int) -> tuple[str, list[DecodedExchange]]:
        watch = self._sdo.setdefault(node, SdoWatch())
        seen: Seen = watch.reply(data, t_ns) if reply else watch.request(data, t_ns)
        done = []
        if seen.dropped is not None:
            done.append(self._transferred(node, seen.dropped, t_ns, "no reply"))
        if seen.done is not None:
            done.append(self._transferred(node, seen.done, t_ns, "abort" if seen.done.abort is not None else ""))
            return f"{self._called(node)}: {done[-1].reply_text}", done
        if watch.open is not None and watch.open.request is data and not reply:
            return self._asked(node, watch.open), done
        if seen.stray:
            done.append(self._stray(node, seen.text, data, t_ns))
            return done[-1].text, done
        # the text of a segment only reports that it was received; the content of a secret is not shown
        opened = watch.open
        hidden = opened is not None and self._secrets(node, (_span(opened),))
        return f"{self._called(node)}: {seen.text}" + (f" {SECRET}" if hidden else ""), done

    def _stray(self, node: int, text: str, data: bytes, t_ns: int) -> DecodedExchange:
        hidden = node in self.nodes and self.nodes[node].tags.has_secrets
        text = f"{self._called(node)}: {text}: " + (
            f"{SECRET}: the device has secret tags" if hidden else data.hex(" ")
        )
        return DecodedExchange(
            t_ns, t_ns, self.bus, self._device(node), node, 0, "stray", reply=data, problem="stray", text=text, reply_text=text,
            secrets=frozenset({""}) if hidden else frozenset(),
        )  # fmt: skip

    def _asked(self, node: int, transfer: Transfer) -> str:
        """Return the request of a transfer, with the name of the object and the value of an expedited write."""
        known = self.nodes.get(node)
        name = known.named(transfer.index, transfer.subindex) if known else transfer.name
        text = f"{self._called(node)}: {transfer.service} {name}" + (" in blocks" if transfer.block else "")
        return text if transfer.upload or not transfer.data else f"{text} = {self._said(node, transfer)}"

    def _said(self, node: int, transfer: Transfer) -> str:
        data, known = bytes(transfer.data), self.nodes.get(node)
        if not data:
            return "nothing"
        return known.said(transfer.index, transfer.subindex, data, transfer.t_ns) if known else data.hex(" ")

    def _transferred(self, node: int, transfer: Transfer, t_ns: int, problem: str) -> DecodedExchange:
        tags, value = self._value(node, transfer, t_ns)
        text = self._asked(node, transfer)
        failed = transfer.abort is not None or bool(problem)
        ended = problem not in ("no reply", "pending")
        known_node = None if failed else self.nodes.get(node)
        if known_node is not None and known_node.learn(transfer.index, transfer.subindex, bytes(transfer.data)):
            self._find_pdos()
        named = self.nodes[node].named(transfer.index, transfer.subindex) if node in self.nodes else transfer.name
        if transfer.abort is not None:
            reply_text = f"{named}: abort {transfer.abort:08X}h {meaning(transfer.abort)}"
            reply_text += " (by the master)" if transfer.aborted_by == "client" else ""
        elif problem:
            reply_text = problem
        else:
            reply_text = f"{named} = {self._said(node, transfer)}" if transfer.upload else f"{named}: written"
        known = value is not None and not (failed and transfer.upload)
        span = _span(transfer)
        return DecodedExchange(
            transfer.t_ns, t_ns, self.bus, self._device(node), node, 0, transfer.service, (span,),
            tags=tags if known else dict.fromkeys(tags), abort=transfer.abort,
            latency_ns=t_ns - transfer.t_ns if ended else None, request=transfer.request,
            reply=transfer.reply, problem=problem, text=text, reply_text=reply_text,
            value=value if known else None, secrets=self._secrets(node, (span,)),
        )  # fmt: skip

    def _value(self, node: int, transfer: Transfer, t_ns: int) -> tuple[dict[str, Scalar | None], Scalar | None]:
        """Return the tags and the value that a transfer has moved so far; the tags' names alone if it moved no data."""
        data, known = bytes(transfer.data), self.nodes.get(node)
        if known is None:
            return {}, data.hex()
        if not data:
            named = known.tags.names(TouchedSpan("read", "object", transfer.index, 1, transfer.subindex))
            return dict.fromkeys(named), None
        return known.value(transfer.index, transfer.subindex, data, t_ns)

    def _find_pdos(self) -> None:
        self._pdos = {cob: pdo for node in self.nodes.values() for cob, pdo in node.pdos.items()}


def _span(transfer: Transfer) -> TouchedSpan:
    return TouchedSpan("read" if transfer.upload else "write", "object", transfer.index, 1, transfer.subindex)
