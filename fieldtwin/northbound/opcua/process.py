"""The process of an OPC UA server: ``python -m fieldtwin.northbound.opcua.process CONFIG.json``.

It reads numbers from the process image and texts from the gateway's control channel, and reports its status there. The gateway
does nothing else for it, so that neither the library nor a client can delay the polling of a bus.
"""

from __future__ import annotations

import asyncio
import sys
from pathlib import Path

from fieldtwin.gateway.core.clock import NS_PER_MS, NS_PER_S
from fieldtwin.gateway.core.concurrency.nursery import Nursery
from fieldtwin.gateway.core.concurrency.stop_signal import stop_signal
from fieldtwin.gateway.core.errors import EndpointBusy, FieldtwinError, Unreachable
from fieldtwin.gateway.core.image.image import Image
from fieldtwin.gateway.wallclock import WallClock
from fieldtwin.northbound.alarm_changes import follow_alarms
from fieldtwin.northbound.following import Changes, ImageFollower, follow_texts
from fieldtwin.northbound.opcua.server import OpcuaServer
from fieldtwin.northbound.opcua.write_channels import WriteChannels
from fieldtwin.northbound.process_config import ServerProcessConfig, server_of
from fieldtwin.northbound.samples import TextSamples
from fieldtwin.northbound.status_report import report_status
from fieldtwin.twin.plant.channel import Channel
from fieldtwin.twin.plant.child_main import child_main
from fieldtwin.twin.plant.physical import attached, layout_in
from fieldtwin.twin.site.resolved import read_resolved
from fieldtwin.twin.site.servers.serving_opcua import OpcuaServeConfig
from fieldtwin.twin.site.system import System

PERMISSIONS_EVERY_NS = NS_PER_S
LISTEN_EVERY_S = 1.0
"""Pause in seconds before the server tries again to listen at an address that is taken."""
STOPS_WITHIN_S = 1.0


class OpcuaProcess:
    """One OPC UA server with its connections to the run, which runs until it is stopped."""

    def __init__(self, config: ServerProcessConfig) -> None:
        self._run_dir = run_dir = Path(config.run_dir)
        [system] = read_resolved(config.resolved)
        assert isinstance(system, System)
        self._system = system
        server = server_of(system, config)
        assert isinstance(server, OpcuaServeConfig)
        self._config = server
        self._image = run_dir / "image"
        self._clock = WallClock()
        rejected = run_dir / f"opcua-{config.server}-rejected"
        self._writes = WriteChannels(run_dir / "gateway.sock")
        self._server = OpcuaServer(self._config, system, self._clock, self._writes.call, rejected)
        self._gateway = Channel(run_dir / "gateway.sock", "gateway")
        self._permissions = Channel(run_dir / "gateway.sock", "gateway")
        self._alarms = Channel(run_dir / "gateway.sock", "gateway")

    async def run(self) -> int:
        stop = stop_signal()
        with attached(layout_in(self._run_dir, self._system), self._image) as image:
            async with Nursery() as nursery:
                nursery.start(
                    report_status(self._run_dir, self._config.name, self._server.status, self._clock), "status reports"
                )
                serving = nursery.start(self._serve(image), "server")
                stopping = asyncio.ensure_future(stop.wait())
                await asyncio.wait([serving, stopping], return_when=asyncio.FIRST_COMPLETED)
                stopping.cancel()
                if serving.done():
                    serving.result()
            try:
                async with asyncio.timeout(STOPS_WITHIN_S):
                    await self._server.aclose()
            except TimeoutError:
                pass  # a client that does not read must not delay the end of the run
        await self._gateway.aclose()
        await self._permissions.aclose()
        await self._alarms.aclose()
        await self._writes.aclose()
        return 0

    async def _serve(self, image: Image) -> None:
        await self._server.build()
        variables = self._server.variables
        follower = ImageFollower(self._system, variables.inputs, variables.outputs, self._config.every_ms)
        async with Nursery() as nursery:
            nursery.start(follower.run(image, self._clock, self._publish), "process image")
            nursery.start(self._follow_texts(), "texts")
            nursery.start(self._follow_alarms(), "alarms")
            if self._config.security is not None:
                nursery.start(self._follow_permissions(), "tags that clients may write")
            nursery.start(self._listen(), "listener")
            await nursery.wait()

    async def _listen(self) -> None:
        while True:
            try:
                return await self._server.listen()
            except (EndpointBusy, Unreachable) as e:
                self._server.error = str(e)
            await asyncio.sleep(LISTEN_EVERY_S)

    async def _publish(self, tags: Changes, variables: Changes, now_ns: int) -> None:
        await self._server.publish(self._server.variables.inputs, tags)
        await self._server.publish(self._server.variables.outputs, variables)

    async def _follow_texts(self) -> None:
        server, names = self._server, {name: name for name in self._server.variables.texts}
        binary = [name for name in names if server.variables.data_types[name] == "ByteString"]
        texts = TextSamples(names, binary)
        await follow_texts(self._gateway, texts, self._clock, lambda changes, now_ns: server.publish(names, changes))

    async def _follow_alarms(self) -> None:
        every_ns = self._config.every_ms * NS_PER_MS
        await follow_alarms(self._alarms, self._system.alarms, self._clock, every_ns, self._server.publish_alarms)

    async def _follow_permissions(self) -> None:
        """Ask the gateway once a second which tags clients may write, because a reload may change that."""
        while True:
            try:
                tags = await self._permissions.call("client_tags")
            except FieldtwinError:
                tags = []
            await self._server.permit_writes(tags)
            await self._clock.sleep_until_ns(self._clock.monotonic_ns() + PERMISSIONS_EVERY_NS)


def main(argv: list[str]) -> int:
    """Run the process; an error is printed to stderr as one line."""
    return child_main(argv, ServerProcessConfig, lambda config: OpcuaProcess(config).run())


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
