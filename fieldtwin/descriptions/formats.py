"""The table of the formats of device descriptions. The module of a format is imported when it is used.

A new format needs one row here, and a module with the functions that the row promises: `import_description` (an `Importer`) and
`export_description` (an `Exporter`) of `fieldtwin.descriptions.conversion`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib import import_module
from typing import cast

from fieldtwin.descriptions.conversion import Exporter, Importer
from fieldtwin.gateway.core.errors import UsageError
from fieldtwin.gateway.core.files.nearest import did_you_mean


@dataclass(frozen=True, slots=True)
class Format:
    """A format of device descriptions.

    `suffix` is the usual ending of its files, `holds` the content in a few words. `import_settings` and `export_settings` are
    the keys of ``--set`` with their explanations. `one_way` gives the reason if the format is only imported or only exported.
    `extra` is the extra of fieldtwin that the format needs.
    """

    name: str
    suffix: str
    title: str
    holds: str
    module: str
    imports: bool = True
    exports: bool = True
    one_way: str = ""
    extra: str = ""
    import_settings: Mapping[str, str] = field(default_factory=dict)
    export_settings: Mapping[str, str] = field(default_factory=dict)


_NODE = {"node": "node ID, 1 to 127"}
_OBJECTS = {
    "device": "name of the profile, MAKER/TYPE",
    "objects": "which objects become tags: application (2000h to 9FFFh, and the identity), pdo (mapped into PDOs), or all",
}
_CONFIGURED = _NODE | {
    "bitrate": "bit rate in kbit/s, 10 to 1000",
    "OBJECT": "value that the file sets, for instance 1017:00=500",
}

_ONE_DEVICE = {
    "device": "name of the profile, MAKER/TYPE",
    "select": "the device, if the file has several: its name, unit ID, or NAME/UNIT",
}
_ENDPOINT = {"endpoint": "endpoint of the device, such as tcp://192.168.0.7 or rtu:/dev/ttyUSB0"}
_NUMBERING = {"numbering": "addresses without zeroBasedAddressing: true: sent, one (from 1) or printed (40001)"}

FORMATS: dict[str, Format] = {
    row.name: row
    for row in (
        Format(
            "eds",
            ".eds",
            "electronic data sheet (CiA 306)",
            "the object dictionary of a CANopen device",
            "fieldtwin.descriptions.canopen.eds",
            import_settings=_NODE | _OBJECTS,
        ),
        Format(
            "dcf",
            ".dcf",
            "device configuration file (CiA 306)",
            "an object dictionary with the values and the node ID of one node",
            "fieldtwin.descriptions.canopen.dcf",
            import_settings=_NODE | _OBJECTS,
            export_settings=_CONFIGURED,
        ),
        Format(
            "xdd",
            ".xdd",
            "XML device description (CiA 311)",
            "the object dictionary of a CANopen device, with units and names of values",
            "fieldtwin.descriptions.canopen.xdd",
            import_settings=_NODE | _OBJECTS,
        ),
        Format(
            "xdc",
            ".xdc",
            "XML device configuration (CiA 311)",
            "an XDD with the values and the node ID of one node",
            "fieldtwin.descriptions.canopen.xdc",
            import_settings=_NODE | _OBJECTS,
            export_settings=_CONFIGURED,
        ),
        Format(
            "dbc",
            ".dbc",
            "CAN database (Vector)",
            "the PDOs of a CANopen node as messages and signals",
            "fieldtwin.descriptions.canopen.dbc",
            imports=False,
            one_way="it has frames, but no object dictionary from which a profile could be made",
            extra="dbc",
            export_settings=_NODE,
        ),
        Format(
            "telegraf",
            ".conf",
            "inputs.modbus of Telegraf",
            "the registers that Telegraf reads",
            "fieldtwin.descriptions.maps.telegraf",
            import_settings=_ONE_DEVICE,
            export_settings=_ENDPOINT | {"style": "request (usual) or register"},
        ),
        Format(
            "home-assistant",
            ".yaml",
            "modbus of Home Assistant",
            "sensors, binary sensors and switches",
            "fieldtwin.descriptions.maps.home_assistant",
            import_settings=_ONE_DEVICE,
            export_settings=_ENDPOINT,
        ),
        Format(
            "thingsboard",
            ".json",
            "Modbus connector of ThingsBoard's gateway",
            "attributes, time series, attribute updates and RPC",
            "fieldtwin.descriptions.maps.thingsboard",
            import_settings=_ONE_DEVICE,
            export_settings=_ENDPOINT,
        ),
        Format(
            "neuron",
            ".csv",
            "tags of EMQX Neuron's Modbus drivers",
            "groups of tags",
            "fieldtwin.descriptions.maps.neuron",
            import_settings=_ONE_DEVICE | {"start": "start address of the driver, 0 or 1 (usual)"},
        ),
        Format(
            "node-red",
            ".json",
            "flow of Node-RED with node-red-contrib-modbus",
            "requests without types",
            "fieldtwin.descriptions.maps.node_red",
            import_settings=_ONE_DEVICE,
            export_settings=_ENDPOINT,
        ),
        Format(
            "wot",
            ".td.json",
            "W3C Thing Description with the Modbus binding",
            "properties of a thing in registers",
            "fieldtwin.descriptions.maps.wot",
            import_settings=_ONE_DEVICE | _NUMBERING,
            export_settings=_ENDPOINT,
        ),
        Format(
            "aid",
            ".json",
            "Asset Interfaces Description of an Asset Administration Shell (IDTA 02017)",
            "properties of a device in registers",
            "fieldtwin.descriptions.aas.aid",
            extra="aas",
            import_settings=_ONE_DEVICE
            | _NUMBERING
            | {"interface": "idShort of the interface, if the file has several"},
            export_settings=_ENDPOINT,
        ),
        Format(
            "sunspec",
            ".json",
            "SunSpec model definition",
            "the points of one model at a base address",
            "fieldtwin.descriptions.maps.sunspec",
            import_settings={
                "device": "name of the profile, MAKER/TYPE",
                "base": "register of the point ID, as sent",
                "repeat": "repetitions of repeating groups, 0 to 100; default 1",
            },
            export_settings={
                "model": "number of the model",
                "base": "register of the point ID, as sent",
                "length": "registers after the point L; default: up to the last tag",
            },
        ),
    )
}


def format_named(name: str) -> Format:
    """Return the format of this name. Raises `UsageError` with a similar name if the format does not exist."""
    if name not in FORMATS:
        raise UsageError(f"no format is called {name!r}", expected=", ".join(FORMATS), hint=did_you_mean(name, FORMATS))
    return FORMATS[name]


def importer(row: Format) -> Importer:
    """Return the function that imports this format. Raises `UsageError` if it is only exported, or if its extra is missing."""
    if not row.imports:
        raise UsageError(f"{row.name} is only exported: {row.one_way}", expected=_which(imports=True))
    return cast(Importer, import_module(row.module).import_description)


def exporter(row: Format) -> Exporter:
    """Return the function that exports this format. Raises `UsageError` if it is only imported, or if its extra is missing."""
    if not row.exports:
        raise UsageError(f"{row.name} is only imported: {row.one_way}", expected=_which(imports=False))
    return cast(Exporter, import_module(row.module).export_description)


def _which(*, imports: bool) -> str:
    return ", ".join(row.name for row in FORMATS.values() if (row.imports if imports else row.exports))


def check_settings(settings: Mapping[str, str], known: Mapping[str, str], row: Format) -> None:
    """Raise `UsageError` for a setting that the format does not have. An ``OBJECT`` of `known` accepts indexes, such as
    ``1017:00``.
    """
    for key in settings:
        if key not in known and not ("OBJECT" in known and ":" in key):
            raise UsageError(
                f"{row.name} has no setting {key!r}",
                expected=", ".join(known) or "no setting",
                hint=did_you_mean(key, known),
            )
