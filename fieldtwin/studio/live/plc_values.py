"""The values of a PLC's tags, read from the process image.

The PLC answers on the thread that executes the scans, so a list of thousands of values would delay a scan. The image is shared
memory: reading it costs the PLC nothing, however many tags there are. The PLC itself is queried for its brief status only.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import Any

from msgspec import structs

from fieldtwin.capture.decoding.exchange import SECRET
from fieldtwin.gateway.core.values import Quality, Reason, TagValue
from fieldtwin.gateway.runtime.plc_variables import is_of_writes
from fieldtwin.plc.status import PlcStatus, WholePlcStatus
from fieldtwin.studio.live.present_tags import plain
from fieldtwin.studio.live.process_image import ProcessImage


def whole_plc_status(
    image: ProcessImage, brief: PlcStatus, programs: Mapping[str, Any], secrets: Collection[str], now_ns: int
) -> WholePlcStatus:
    """Return a brief status with the present values. `programs`: the PLC's answer to `about`. Values of `secrets` are masked.

    Raises `FileInvalid` or `Unreachable` if the image cannot be read.
    """

    def shown(tag: str, value: Any) -> Any:
        return SECRET if tag in secrets else plain(value)

    inputs, outputs = image.inputs(), image.outputs()
    values = {tag: shown(tag, outputs.values[n]) for tag, n in outputs.shape.index.items() if not is_of_writes(tag)}
    return WholePlcStatus(
        **structs.asdict(brief),
        inputs={
            tag: _input(brief, inputs.value(n)).describe(now_ns) | {"value": shown(tag, inputs.values[n])}
            for tag, n in inputs.shape.index.items()
            if not is_of_writes(tag)
        },
        outputs=values,
        variables={
            f"{program}.{name}": values.get(about["tag"])
            for program, described in programs.items()
            for name, about in described["variables"].items()
            if about["role"] != "input"
        },
    )


def _input(plc: PlcStatus, seen: TagValue) -> TagValue:
    """Return an input with the quality that it has for the programs: bad while the PLC is stopped or the gateway is dead."""
    if plc.state == "stopped":
        return TagValue(seen.value, Quality.BAD, Reason.NOT_OPERATIONAL, seen.t_ns)
    if not plc.gateway_alive:
        return TagValue(seen.value, Quality.BAD, Reason.GATEWAY_DEAD, seen.t_ns)
    return seen
