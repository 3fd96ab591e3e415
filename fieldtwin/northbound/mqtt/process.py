"""The process of an MQTT server: ``python -m fieldtwin.northbound.mqtt.process CONFIG.json``.

It reads numbers from the process image and texts from the gateway's control channel, and reports its status there. Commands go
to the gateway, which decides on them and records them in the audit log.
"""

from __future__ import annotations

import asyncio
import sys
from pathlib import Path

from fieldtwin.gateway.core.clock import NS_PER_MS
from fieldtwin.gateway.core.concurrency.nursery import Nursery
from fieldtwin.gateway.core.concurrency.stop_signal import stop_signal
from fieldtwin.gateway.core.errors import FieldtwinError
from fieldtwin.gateway.core.image.image import Image
from fieldtwin.gateway.runtime.gateway_status import AlarmEvent, ServerStatus
from fieldtwin.gateway.runtime.outputs.refusals import RefusalCause
from fieldtwin.gateway.wallclock import WallClock
from fieldtwin.northbound.alarm_changes import follow_alarms, quality_of
from fieldtwin.northbound.following import Changes, ImageFollower, follow_texts
from fieldtwin.northbound.mqtt.publication import WriteRequest
from fieldtwin.northbound.mqtt.publications import publication_of
from fieldtwin.northbound.mqtt.publisher import Publisher
from fieldtwin.northbound.mqtt.served_tags import served_tags
from fieldtwin.northbound.mqtt.session_numbers import SessionNumbers
from fieldtwin.northbound.process_config import ServerProcessConfig, server_of
from fieldtwin.northbound.samples import Sample, TextSamples
from fieldtwin.northbound.status_report import report_status
from fieldtwin.northbound.utc_times import UtcTimes
from fieldtwin.twin.plant.channel import Channel
from fieldtwin.twin.plant.child_main import child_main
from fieldtwin.twin.plant.physical import attached, layout_in
from fieldtwin.twin.site.resolved import read_resolved
from fieldtwin.twin.site.servers.serving_mqtt import MqttServeConfig
from fieldtwin.twin.site.system import System

NOT_WRITABLE = RefusalCause.NOT_WRITABLE.value


class MqttProcess:
    """One MQTT server with its connections to the run, which runs until it is stopped."""

    def __init__(self, config: ServerProcessConfig) -> None:
        self._run_dir = Path(config.run_dir)
        [system] = read_resolved(config.resolved)
        assert isinstance(system, System)
        self._system = system
        server = server_of(system, config)
        assert isinstance(server, MqttServeConfig)
        self._config = server = server.for_prototype() if config.prototype else server
        self._clock = WallClock()
        self._times = UtcTimes(self._clock)
        self._tags = served_tags(system)
        self._publication = publication_of(
            server, system.name, self._run_dir.name, self._tags, self._clock.utc_ns() // NS_PER_MS
        )
        self._publisher = Publisher(
            server.broker,
            self._publication,
            self._clock,
            SessionNumbers(self._run_dir / f"mqtt-{server.name}.session").next,
            self._decide,
        )
        self._gateway = Channel(self._run_dir / "gateway.sock", "gateway")
        self._writes = Channel(self._run_dir / "gateway.sock", "gateway")
        self._alarms = Channel(self._run_dir / "gateway.sock", "gateway")

    async def run(self) -> int:
        stop = stop_signal()
        with attached(layout_in(self._run_dir, self._system), self._run_dir / "image") as image:
            async with Nursery() as nursery:
                running = [
                    nursery.start(
                        report_status(self._run_dir, self._config.name, self.status, self._clock), "status reports"
                    ),
                    nursery.start(self._follow_image(image), "process image"),
                    nursery.start(self._follow_texts(), "texts"),
                    nursery.start(self._publisher.run(), "publisher"),
                ]
                nursery.start(self._follow_alarms(), "alarms")
                stopping = asyncio.ensure_future(stop.wait())
                await asyncio.wait([*running, stopping], return_when=asyncio.FIRST_COMPLETED)
                stopping.cancel()
                if (error := nursery.failure()) is not None:
                    raise error
        await self._gateway.aclose()
        await self._writes.aclose()
        await self._alarms.aclose()
        return 0

    def status(self) -> ServerStatus:
        """Return the broker while messages are published there, and the counters."""
        publisher, publication = self._publisher, self._publication
        backlog = publication.backlog
        publishes = publisher.is_connected and not publisher.error
        return ServerStatus(
            listening=f"{self._config.url} {publication.place}" if publishes else None,
            error=publisher.error,
            counters={
                **publication.counters,
                "sessions": publisher.sessions,
                "garbled": publisher.garbled,
                "dropped": backlog.dropped,
                "waiting": backlog.waiting,
            },
            clients=[],
            kind="mqtt",
        )

    async def _follow_image(self, image: Image) -> None:
        of_devices = {tag.source: tag.name for tag in self._tags if tag.device and not tag.is_text}
        of_programs = {tag.source: tag.name for tag in self._tags if not tag.device and not tag.is_alarm}

        async def publish(tags: Changes, variables: Changes, now_ns: int) -> None:
            self._times.follow()
            for source, sample in tags:
                self._note(of_devices[source], sample, now_ns)
            for source, sample in variables:
                self._note(of_programs[source], sample, now_ns)
            self._publication.end_look()
            self._publisher.wake()

        follower = ImageFollower(self._system, of_devices, of_programs, self._config.every_ms)
        await follower.run(image, self._clock, publish)

    async def _follow_texts(self) -> None:
        names = {tag.source: tag.data_type for tag in self._tags if tag.is_text and not tag.is_alarm}
        texts = TextSamples(names, [name for name, kind in names.items() if kind == "ByteString"])

        async def publish(changes: Changes, now_ns: int) -> None:
            for name, sample in changes:
                self._note(name, sample, now_ns)
            self._publisher.wake()

        await follow_texts(self._gateway, texts, self._clock, publish)

    async def _follow_alarms(self) -> None:
        names = {tag.source: tag.name for tag in self._tags if tag.is_alarm}

        async def publish(changes: list[AlarmEvent]) -> None:
            self._times.follow()
            for change in changes:
                sample = Sample(None if change.quality == "bad" else change.state, *quality_of(change), change.t_ns)
                self._note(names[change.name], sample, self._clock.monotonic_ns())
            self._publisher.wake()

        await follow_alarms(self._alarms, names, self._clock, self._config.every_ms * NS_PER_MS, publish)

    def _note(self, name: str, sample: Sample, now_ns: int) -> None:
        self._publication.note(name, sample, self._times.ms(sample.source_ns or now_ns))

    async def _decide(self, request: WriteRequest) -> bool:
        """Pass a write on to the gateway. A write that this server refuses is recorded in the gateway's audit log as well."""
        by = f"mqtt {self._config.name}"
        try:
            if request.refusal or request.value is None:
                await self._writes.call(
                    "refuse", tag=request.tag, value="", reason=request.refusal, cause=NOT_WRITABLE, by=by
                )
                return False
            await self._writes.call("write", tag=request.tag, value=request.value, by=by)
        except FieldtwinError:
            return False
        return True


def main(argv: list[str]) -> int:
    """Run the process; an error is printed to stderr as one line."""
    return child_main(argv, ServerProcessConfig, lambda config: MqttProcess(config).run())


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
