"""Schemas EmbeddedControlSystem, PhysicalTwin, DigitalTwinPrototype: the parts from which `fieldtwin run` builds both."""

from __future__ import annotations

from pathlib import Path

from spec_rig import CLOCK, copy_systems, observatory
from support import run

from fieldtwin.emulators.emulator import EmulatedUnit
from fieldtwin.gateway.connections.os_connector import OsConnector
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.devices.canopen_device import CanopenDriver
from fieldtwin.gateway.devices.register_device import SensorDriver
from fieldtwin.gateway.devices.transmitter import TransmitterDriver
from fieldtwin.gateway.runtime.audit_log import AuditLog
from fieldtwin.gateway.runtime.gateway import Gateway
from fieldtwin.gateway.store.exchange_log import ExchangeLog
from fieldtwin.plc.relay import ControlLogic, Relay
from fieldtwin.twin.model.model import DigitalModel
from fieldtwin.twin.plant.mapping import MappedConnector
from fieldtwin.twin.plant.physical import EmbeddedControlSystem, PhysicalTwin, attached
from fieldtwin.twin.prototype.file import load_prototype
from fieldtwin.twin.prototype.prototype import DigitalTwinPrototype
from fieldtwin.twin.site.system import load_system


def gateway_of(ecs: EmbeddedControlSystem, run_dir: Path, mapping: dict[Endpoint, Endpoint] | None) -> dict[str, type]:
    """Build the gateway as its process does, for a plant or for a prototype; return its drivers."""
    run_dir.mkdir()
    ecs.prepare(run_dir)
    audit = AuditLog(run_dir / "audit.jsonl", CLOCK)
    log = ExchangeLog(run_dir / "store.sqlite", system=ecs.system.name, prototype=mapping is not None)
    connector = OsConnector() if mapping is None else MappedConnector(OsConnector(), mapping)
    try:
        with attached(ecs.layout, run_dir / "image") as image:
            gateway = ecs.gateway(connector, CLOCK, image, audit, log, allow_writes=False)
            assert isinstance(gateway, Gateway)
            return {name: type(driver) for name, driver in gateway.drivers.items()}
    finally:
        log.close()
        audit.close()


DRIVERS = {"ctd": SensorDriver, "inclinometer": CanopenDriver, "modem": TransmitterDriver}


def test_EmbeddedControlSystem_contains_sensor_driver_transmitter_driver_and_control_logic(tmp_path: Path) -> None:
    async def main() -> None:
        ecs = EmbeddedControlSystem(observatory()[0])
        assert gateway_of(ecs, tmp_path / "run", None) == DRIVERS
        (program,) = (config.bind().program for config in ecs.control_logic)
        assert isinstance(program, Relay)
        assert isinstance(program.logic, ControlLogic)

    run(main())


def test_EmbeddedControlSystem_hands_the_PLC_what_the_gateway_has(tmp_path: Path) -> None:
    ecs = EmbeddedControlSystem(observatory()[0])
    (tmp_path / "run").mkdir()
    plc = ecs.prepare(tmp_path / "run")
    assert plc.programs == ecs.control_logic
    assert plc.image_layout().describe() == ecs.layout.describe()
    with attached(ecs.layout, Path(plc.image_path)):
        pass


def test_PhysicalTwin_contains_sensor_transmitter_and_ecs() -> None:
    system = observatory()[0]
    twin = PhysicalTwin(system)
    assert list(twin.sensors) == ["ctd", "inclinometer"]
    assert list(twin.transmitters) == ["modem"]
    assert isinstance(twin.ecs, EmbeddedControlSystem)
    assert {**twin.sensors, **twin.transmitters} == system.devices


def test_DigitalTwinPrototype_is_the_physical_twins_own_software_and_configuration(tmp_path: Path) -> None:
    async def main() -> None:
        system, prototype = observatory()
        physical, twin = PhysicalTwin(system), DigitalTwinPrototype(system, prototype, CLOCK)
        assert type(twin.ecs) is type(physical.ecs)
        assert twin.ecs.system is physical.ecs.system
        assert twin.ecs.control_logic == physical.ecs.control_logic
        assert twin.ecs.layout.describe() == physical.ecs.layout.describe()
        elsewhere = {bus.endpoint: Endpoint.parse("tcp://127.0.0.1:1") for bus in system.buses.values()}
        drivers = gateway_of(twin.ecs, tmp_path / "prototype", elsewhere)
        assert drivers == gateway_of(physical.ecs, tmp_path / "plant", None) == DRIVERS
        told = [(tmp_path / run_dir / "image").read_bytes() for run_dir in ("plant", "prototype")]
        assert told[0] == told[1]

    run(main())


def test_DigitalTwinPrototype_emulates_every_sensor_and_actuator(tmp_path: Path) -> None:
    async def main() -> None:
        system, prototype = observatory()
        twin = DigitalTwinPrototype(system, prototype, CLOCK)
        assert twin.real == ()
        field = twin.field(tmp_path)
        await field.open()
        try:
            assert set(field.devices) == set(system.devices)
            assert set(field.listening) == set(system.buses)
            assert isinstance(field.devices["ctd"].unit, EmulatedUnit)
            assert isinstance(field.devices["modem"].unit, EmulatedUnit)
            assert field.devices["inclinometer"].node is not None
            assert len(field.devices["ctd"].unit.emulator.virtual_context) > 1000
        finally:
            await field.aclose()

    run(main())


def test_DigitalTwinPrototype_with_a_bus_left_to_the_plant_says_which_devices_are_real(tmp_path: Path) -> None:
    systems = copy_systems(tmp_path)
    path = systems / "observatory.prototype.yaml"
    text = path.read_text(encoding="utf-8").replace('can0:  {listen: "can:fieldtwin/127.0.0.1:0"}', "can0: plant")
    path.write_text(text, encoding="utf-8")
    system = load_system(str(systems / "observatory.yaml"))
    twin = DigitalTwinPrototype(system, load_prototype(system), CLOCK)
    assert twin.real == ("inclinometer",)


def test_DigitalTwinPrototype_has_a_digital_model_of_its_own() -> None:
    twin = DigitalTwinPrototype(*observatory(), CLOCK)
    assert type(twin.model) is DigitalModel
    assert twin.model.state.name == "STANDBY"
