"""Conversion of frames to python-can's messages, for connections that send through python-can."""

from __future__ import annotations

import can

from fieldtwin.gateway.core.canframe import CanFrame
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import UsageError


def message_of(frame: CanFrame, endpoint: Endpoint) -> can.Message:
    """Return python-can's message for `frame`, which is to be sent at `endpoint`.

    Raises `UsageError` for an error frame, which a node cannot send.
    """
    if frame.error:
        raise UsageError("an error frame cannot be sent", got=str(frame), where=str(endpoint))
    return can.Message(
        arbitration_id=frame.can_id,
        is_extended_id=frame.extended,
        is_remote_frame=frame.remote,
        dlc=frame.dlc,
        data=frame.data,
    )
