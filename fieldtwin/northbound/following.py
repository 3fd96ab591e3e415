"""How the process of a server follows the values of a run: numbers in the process image, texts in the gateway's answers."""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Iterable, Iterator

from fieldtwin.gateway.core.clock import NS_PER_MS, NS_PER_S, Clock
from fieldtwin.gateway.core.errors import FieldtwinError
from fieldtwin.gateway.core.image.image import INPUTS, OUTPUTS, Image
from fieldtwin.gateway.core.values import Reason
from fieldtwin.northbound.samples import ImageSamples, Sample, TextSamples
from fieldtwin.twin.plant.channel import Channel
from fieldtwin.twin.plant.physical import gateway_lost_ms, plc_lost_ms
from fieldtwin.twin.site.system import System

TEXTS_EVERY_NS = NS_PER_S // 2
"""The interval in which texts are requested from the gateway, in nanoseconds."""
Changes = Iterator[tuple[str, Sample]]


class ImageFollower:
    """Looks at the process image every `every_ms`, for the tags `tags` of devices and the variables `variables` of programs."""

    def __init__(self, system: System, tags: Iterable[str], variables: Iterable[str], every_ms: int) -> None:
        self._tags = ImageSamples(tags, gateway_lost_ms(system) * NS_PER_MS, Reason.GATEWAY_DEAD)
        self._variables = ImageSamples(variables, plc_lost_ms(system) * NS_PER_MS, Reason.HEARTBEAT_LOST)
        self._every_ns = every_ms * NS_PER_MS

    async def run(
        self, image: Image, clock: Clock, publish: Callable[[Changes, Changes, int], Awaitable[None]]
    ) -> None:
        """Call `publish` at each look with the changes of tags, those of variables, and its time, until cancelled."""
        inputs, outputs = image.reader(INPUTS), image.reader(OUTPUTS)
        next_ns = clock.monotonic_ns()
        while True:
            now_ns = clock.monotonic_ns()
            tags = self._tags.changes(inputs.snapshot(), now_ns)
            await publish(tags, self._variables.changes(outputs.snapshot(), now_ns), now_ns)
            next_ns = max(next_ns + self._every_ns, now_ns)
            await clock.sleep_until_ns(next_ns)


async def follow_texts(
    gateway: Channel, texts: TextSamples, clock: Clock, publish: Callable[[Changes, int], Awaitable[None]]
) -> None:
    """Ask the gateway for all texts twice a second, until cancelled. They are bad while it does not answer.

    `publish` is called with the changes, and with the time of the request. Without texts nothing is asked.
    """
    while True:
        now_ns = clock.monotonic_ns()
        if texts.names:
            try:
                answer = await gateway.call("watch", since=None, names=texts.names)
            except FieldtwinError:
                await publish(texts.lost(now_ns), now_ns)
            else:
                await publish(texts.changes(answer["tags"], answer["now_ns"]), now_ns)
        await clock.sleep_until_ns(now_ns + TEXTS_EVERY_NS)
