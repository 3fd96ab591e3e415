"""How the process of a server follows the alarms of a run: it asks the gateway for their changes."""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Iterable

import msgspec
from msgspec.structs import replace

from fieldtwin.gateway.core.clock import Clock
from fieldtwin.gateway.core.errors import FieldtwinError
from fieldtwin.gateway.core.values import Quality, Reason
from fieldtwin.gateway.runtime.alarms.state_machine import AlarmState
from fieldtwin.gateway.runtime.gateway_status import AlarmEvent
from fieldtwin.twin.plant.channel import Channel

GATEWAY_DEAD = "gateway_dead"


async def follow_alarms(
    gateway: Channel,
    names: Iterable[str],
    clock: Clock,
    every_ns: int,
    publish: Callable[[list[AlarmEvent]], Awaitable[None]],
) -> None:
    """Ask the gateway for changes of the alarms `names` every `every_ns`, until cancelled. Without alarms nothing is asked.

    `publish` is called first with every alarm as it is before its first change, and then with the changes. While the gateway
    does not answer, all alarms keep their states with bad quality.
    """
    known = {name: _unknown(name) for name in names}
    if not known:
        return
    await publish(list(known.values()))
    began_ns = number = 0
    while True:
        now_ns = clock.monotonic_ns()
        try:
            answer = await gateway.call("watch", since=None, alarms=number)
        except FieldtwinError:
            changes = [
                replace(each, t_ns=now_ns, quality=str(Quality.BAD), reason=GATEWAY_DEAD, by="")
                for each in known.values()
                if each.reason != GATEWAY_DEAD
            ]
            number = 0
        else:
            if answer["began_ns"] != began_ns and number:  # a new gateway, whose numbers begin again
                began_ns, number = answer["began_ns"], 0
                continue
            began_ns = answer["began_ns"]
            changes = msgspec.convert(answer["alarms"], list[AlarmEvent])
            if not number:  # only the latest state of each alarm counts
                changes = list({each.name: each for each in changes}.values())
            number = max((each.number for each in changes), default=number)
        known |= {each.name: each for each in changes}
        if changes:
            await publish(changes)
        await clock.sleep_until_ns(now_ns + every_ns)


def quality_of(event: AlarmEvent) -> tuple[Quality, Reason]:
    """Return the quality of an alarm, and the reason."""
    return Quality[event.quality.upper()], Reason[event.reason.upper()]


def _unknown(name: str) -> AlarmEvent:
    return AlarmEvent(
        number=0, t_ns=0, name=name, state=AlarmState.NORMAL.value, active=False, quality=str(Quality.BAD),
        reason="never_read", by="",
    )  # fmt: skip
