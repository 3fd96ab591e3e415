"""A server with 10,000 variables: it starts, all of them can be browsed, and each has the value of the process image."""

from __future__ import annotations

import asyncio
from collections.abc import Iterator
from pathlib import Path

import pytest
from asyncua import Client, ua

from fieldtwin.gateway.core.image.image import INPUTS, Image
from fieldtwin.gateway.core.values import Quality, Reason, TagValue
from fieldtwin.gateway.wallclock import WallClock
from fieldtwin.northbound.opcua.server import OpcuaServer
from fieldtwin.northbound.samples import ImageSamples
from fieldtwin.twin.plant.physical import attached, image_layout, make_image
from fieldtwin.twin.site.system import System, load_system

pytestmark = [pytest.mark.long, pytest.mark.timeout(600)]
DEVICES, TAGS = 100, 100
LOST_NS = 3600 * 10**9


@pytest.fixture
def system(tmp_path: Path) -> System:
    tags = "".join(f"  t{n}: {{at: 'holding:{n}', type: uint16, unit: degC, range: [0, 50000]}}\n" for n in range(TAGS))
    profile = f'device: test/many\nsource: "a test"\nprotocol: modbus\ntags:\n{tags}'
    (tmp_path / "many.yaml").write_text(profile, encoding="utf-8")
    devices = "".join(f"  d{n}: {{profile: ./many.yaml, bus: lan, unit: {n + 1}}}\n" for n in range(DEVICES))
    path = tmp_path / "site.yaml"
    path.write_text(
        "fieldtwin: 1\nsystem: site\nbuses: {lan: {url: 'tcp://192.0.2.1:502'}}\n"
        f"devices:\n{devices}serve: {{scada: {{kind: opcua, url: 'opc.tcp://127.0.0.1:0'}}}}\n",
        encoding="utf-8",
    )
    return load_system(str(path))


@pytest.fixture
def image(system: System, tmp_path: Path) -> Iterator[Image]:
    layout = image_layout(system)
    make_image(layout, tmp_path / "image")
    with attached(layout, tmp_path / "image") as image:
        yield image


async def no_writes(command: str, **args: object) -> None:
    raise AssertionError("this server has no gateway")


async def browsed(client: Client) -> list[str]:
    """Return the identifiers of all variables in the DeviceSet's ParameterSets, in their order."""
    found = []
    devices = await client.nodes.objects.get_child("3:DeviceSet")
    for device in await devices.get_children(nodeclassmask=ua.NodeClass.Object):
        name = (await device.read_browse_name()).Name
        if name == "PLC":
            continue
        parameters = await device.get_child("3:ParameterSet")
        found += [str(each.nodeid.Identifier) for each in await parameters.get_children()]
    return found


def test_ten_thousand_variables_are_browsable_and_have_the_values_of_the_image(system: System, image: Image) -> None:
    clock = WallClock()
    names = [f"d{device}.t{tag}" for device in range(DEVICES) for tag in range(TAGS)]
    values = [TagValue(n, Quality.GOOD, t_ns=clock.monotonic_ns()) for n in range(len(names))]
    values[-1] = TagValue(1, Quality.BAD, Reason.WRONG_DEVICE)

    async def serve() -> None:
        server = OpcuaServer(system.serving.opcua[0], system, clock, no_writes)
        await server.build()
        writer, reader = image.writer(INPUTS), image.reader(INPUTS)
        order = {name: n for n, name in enumerate(names)}
        writer.publish([values[order[tag.name]] for tag in reader.latest.shape.layout.tags], clock.monotonic_ns())
        inputs = server.variables.inputs
        await server.publish(inputs, ImageSamples(inputs, LOST_NS, Reason.GATEWAY_DEAD).changes(reader.snapshot(), 0))
        await server.listen()
        try:
            listening = server.status().listening
            assert listening is not None
            async with Client(listening, timeout=60, watchdog_intervall=60) as client:
                assert await browsed(client) == names
                nodes = [client.get_node(f"ns=2;s={name}") for name in names]
                read = [
                    value
                    for start in range(0, len(nodes), 1000)
                    for value in await client.read_attributes(nodes[start : start + 1000])
                ]
            assert [value.Value.Value for value in read[:-1]] == list(range(len(names) - 1))
            assert {value.StatusCode.name for value in read[:-1]} == {"Good"}
            assert (read[-1].StatusCode.name, read[-1].Value.Value) == ("BadConfigurationError", None)
        finally:
            await server.aclose()

    asyncio.run(serve())
