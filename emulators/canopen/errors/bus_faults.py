"""CAN controller events that a node notices: error-passive, bus-off, overrun, and a second node on its identifiers.

EMCY codes follow CiA 301 v4.2, table 26: 8110h overrun, 8120h error-passive, 8140h recovered from bus-off, 8150h
collision of identifiers. A node in bus-off cannot send, so 8140h is sent afterwards.
"""

from __future__ import annotations

from collections.abc import Callable

from fieldtwin.emulators.canopen.errors import emcy
from fieldtwin.emulators.canopen.errors.error_control import ERROR_CONTROL, ErrorReaction
from fieldtwin.emulators.canopen.sdo.channels import RESPONSE
from fieldtwin.emulators.canopen.service import Core, NodeService
from fieldtwin.gateway.core.can_error import CanErrorState, reported_state, reports_overrun
from fieldtwin.gateway.core.canframe import CanFrame

OVERRUN, PASSIVE, RECOVERED, COLLISION = 0x8110, 0x8120, 0x8140, 0x8150

_MUTE = "bus-off"


class BusFaults(NodeService):
    """The node's reaction to events of its controller: silence, emergencies and the reaction of 1029h."""

    def __init__(self, core: Core, emergency: emcy.Emergency, react: ErrorReaction) -> None:
        self._core = core
        self._emergency = emergency
        self._react = react
        self.state = CanErrorState.ACTIVE
        self.on_second_node: Callable[[int], None] | None = None
        """A function that is called with the identifier when a second node sends on an identifier of this node, once until the
        next reset.
        """
        self._reported = False

    def reset(self, now_ns: int) -> None:
        """Keep the controller's state at a reset, and report an error that is still present again."""
        self._reported = False
        if self.state is CanErrorState.PASSIVE:
            self._raise(PASSIVE, now_ns)

    def changed(self, state: CanErrorState, now_ns: int) -> None:
        """Process a change of the controller's state. A repeated state has no effect; a warning counts as error-active."""
        state = CanErrorState.ACTIVE if state is CanErrorState.WARNING else state
        before, self.state = self.state, state
        if state is before:
            return
        if state is CanErrorState.BUS_OFF:
            self._core.mutes.add(_MUTE)
            self._react(now_ns)
            return
        self._core.mutes.discard(_MUTE)
        if state is CanErrorState.ACTIVE:
            self._emergency.clear_error(PASSIVE, now_ns)
        if before is CanErrorState.BUS_OFF:
            self._emergency.report(RECOVERED, now_ns, register=emcy.COMMUNICATION)
        if state is CanErrorState.PASSIVE:
            self._raise(PASSIVE, now_ns)

    def overrun(self, now_ns: int) -> None:
        """Report that frames were lost because they arrived faster than the node read them."""
        self._emergency.report(OVERRUN, now_ns, register=emcy.COMMUNICATION)

    def heard(self, frame: CanFrame, now_ns: int) -> bool:
        """Return whether the identifier of a received data frame is reserved for this node.

        Such a frame is an error that lasts until a reset.
        """
        node_id, emcy_id = self._core.node_id, self._core.data.number(0x1014, 0, 1 << 31)
        own = {ERROR_CONTROL + node_id, RESPONSE + node_id} | ({emcy_id} if emcy_id <= 0x7FF else set())
        if frame.can_id not in own:
            return False
        self._raise(COLLISION, now_ns)
        if self.on_second_node is not None and not self._reported:
            self._reported = True
            self.on_second_node(frame.can_id)
        return True

    def on_error_frame(self, frame: CanFrame, now_ns: int) -> None:
        """Process an error frame of the node's own controller, from the kernel or the software bus."""
        if reports_overrun(frame):
            self.overrun(now_ns)
        state = reported_state(frame)
        if state is not None:
            self.changed(state, now_ns)

    def _raise(self, code: int, now_ns: int) -> None:
        self._emergency.raise_error(code, now_ns, register=emcy.COMMUNICATION)
