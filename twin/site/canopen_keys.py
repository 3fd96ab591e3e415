"""The CANopen keys of a system file, resolved: the messages of a bus's NMT master, and the boot procedure of each node.

DCF files are read here, so that an error in one is reported with file, section and key before any connection is opened.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from fieldtwin.gateway.core.errors import UsageError
from fieldtwin.gateway.core.files.profile import DeviceProfile
from fieldtwin.gateway.core.files.yaml_file import Key, YamlFile
from fieldtwin.gateway.devices.canopen_config import CanopenBusConfig, CanopenNodeConfig, RpdoConfig
from fieldtwin.gateway.devices.canopen_rpdo import BITS
from fieldtwin.gateway.protocols.canopen.boot import Configuration, ExpectedIdentity
from fieldtwin.gateway.protocols.canopen.configure import rpdos_of, tpdos_of
from fieldtwin.gateway.protocols.canopen.eds.concise_dcf import configuration_date, settings_of
from fieldtwin.gateway.protocols.canopen.eds.dictionary import ObjectDictionary, load_dictionary
from fieldtwin.gateway.protocols.canopen.lss.frames import LssAddress
from fieldtwin.gateway.protocols.canopen.pdo.mapping import PDO_BITS
from fieldtwin.twin.site.data_files import find
from fieldtwin.twin.site.schema import BusForm, DeviceForm, IdentityForm

CANOPEN_BUS_KEYS = ("sync", "time_ms", "short_sdo", "sdo_transfer_ms")
CANOPEN_KEYS = ("sdo_transfer_ms", "identity", "dcf", "store", "lss", "tpdos", "rpdo1", "rpdos")


def canopen_bus(file: YamlFile, name: str, form: BusForm, *, is_can: bool) -> CanopenBusConfig:
    """Return the settings of a bus's NMT master. Their keys are refused for a bus that is not CAN."""
    if not is_can:
        _refuse(file, ("buses", name), form.model_fields_set.intersection(CANOPEN_BUS_KEYS), "a CAN bus")
    counter = form.sync.counter if form.sync else 0
    if counter == 1:
        raise file.error(("buses", name, "sync", "counter"), "a SYNC counter", expected="0, or 2 to 240", got="1")
    return CanopenBusConfig(
        sync_ms=form.sync.period_ms if form.sync else 0,
        sync_counter=counter,
        time_ms=form.time_ms or 0,
        short_sdo=form.short_sdo,
        sdo_transfer_s=form.sdo_transfer_ms / 1000,
    )


def canopen_node(
    file: YamlFile, loc: tuple[Key, ...], form: DeviceForm, path: Path, profiles: Iterable[Path], *, is_can: bool
) -> CanopenNodeConfig:
    """Return the settings for the boot of a node. Their keys are refused for a device that is not a CANopen node."""
    if not is_can:
        _refuse(file, loc, form.model_fields_set.intersection(CANOPEN_KEYS), "a CANopen node")
        return CanopenNodeConfig()
    dictionary = _dcf(file, loc, form, path, profiles)
    configuration = _configuration(file, loc, form, dictionary) if dictionary is not None else None
    return CanopenNodeConfig(
        identity=ExpectedIdentity(**form.identity.model_dump()) if form.identity else ExpectedIdentity(),
        dcf=Path(form.dcf).name if form.dcf else "",
        configuration=configuration,
        lss=_address(file, loc, form.identity) if form.lss else None,
        tpdos=tpdos_of(dictionary) if dictionary is not None and form.tpdos == "dcf" else None,
        adopt_tpdos=form.tpdos == "node",
        rpdo1=_rpdo1(form),
        rpdos=rpdos_of(dictionary) if dictionary is not None and form.rpdos == "dcf" else None,
        adopt_rpdos=form.rpdos == "node",
        sdo_transfer_s=form.sdo_transfer_ms / 1000 if form.sdo_transfer_ms else None,
    )


def check_rpdo1(file: YamlFile, loc: tuple[Key, ...], form: DeviceForm, profile: DeviceProfile, sync: bool) -> None:
    """Check that RPDO1's tags may be written and fit into 8 bytes. `sync` states whether the bus has a SYNC producer."""
    if form.rpdo1 is None:
        return
    loc = (*loc, "rpdo1")
    bits = 0
    for i, name in enumerate(form.rpdo1.map):
        tag = profile.tags.get(name)
        if tag is None or not tag.writable or name not in form.writable or name in form.rpdo1.map[:i]:
            raise file.error(
                (*loc, "map", i), f"{name!r} in an RPDO", expected="tags of this device's `writable`, each once"
            )
        if tag.type not in BITS:
            raise file.error(
                (*loc, "map", i), f"{name!r} in an RPDO", expected="a number of a fixed size", got=tag.type
            )
        bits += BITS[tag.type]
    if bits > PDO_BITS:
        raise file.error((*loc, "map"), "this is too long for one RPDO", expected=f"{PDO_BITS} bits", got=f"{bits}")
    if form.rpdo1.transmission == "sync" and not sync:
        raise file.error((*loc, "transmission"), "nothing triggers its values", expected="`sync` of the bus")


def _rpdo1(form: DeviceForm) -> RpdoConfig | None:
    if form.rpdo1 is None:
        return None
    return RpdoConfig(tuple(form.rpdo1.map), form.rpdo1.transmission == "sync", form.rpdo1.event_ms or 0)


def _dcf(
    file: YamlFile, loc: tuple[Key, ...], form: DeviceForm, path: Path, profiles: Iterable[Path]
) -> ObjectDictionary | None:
    if form.dcf is None:
        for key in ("store", "tpdos", "rpdos"):
            if getattr(form, key) in (True, "dcf"):
                raise file.error((*loc, key), f"`{key}` needs a DCF", expected="`dcf`, a DCF file")
        return None
    try:
        dcf = find("devices", form.dcf, beside=path, extra=profiles)
    except UsageError as e:
        raise file.error((*loc, "dcf"), "no such file", expected="a DCF", got=form.dcf) from e
    return load_dictionary(dcf, form.node)


def _configuration(
    file: YamlFile, loc: tuple[Key, ...], form: DeviceForm, dictionary: ObjectDictionary
) -> Configuration:
    settings = settings_of(dictionary)
    if not settings:
        raise file.error(
            (*loc, "dcf"), "this DCF sets no object", expected="objects with ParameterValue", got=dictionary.path
        )
    return Configuration(settings, configuration_date(dictionary), form.store)


def _address(file: YamlFile, loc: tuple[Key, ...], identity: IdentityForm | None) -> LssAddress:
    parts = [getattr(identity, name, None) for name in ("vendor", "product", "revision", "serial")]
    if any(part is None for part in parts):
        raise file.error(
            (*loc, "lss"), "LSS identifies a node by four numbers", expected="`identity` with vendor to serial"
        )
    return LssAddress(*[int(part) for part in parts if part is not None])


def _refuse(file: YamlFile, loc: tuple[Key, ...], keys: set[str], expected: str) -> None:
    for key in sorted(keys):
        raise file.error((*loc, key), f"`{key}` is for CANopen", expected=expected)
