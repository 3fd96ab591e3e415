"""The AAS's Asset Interfaces Description (IDTA 02017-1-1) of a Modbus device, in a file of Asset Administration Shells.

An export is JSON with a shell and its submodel. An import reads JSON, XML and AASX packages. The description has neither the
operations of a property nor a scale. The library `basyx-python-sdk` reads and writes the files (extra `aas`).
"""

from __future__ import annotations

import re

from fieldtwin.descriptions.aas.interface import interface_of
from fieldtwin.descriptions.conversion import Exported, Imported, Loss, Settings, Source
from fieldtwin.descriptions.maps.documents import Document
from fieldtwin.descriptions.maps.modbus_form_reader import import_properties
from fieldtwin.descriptions.maps.modbus_forms import base_uri
from fieldtwin.gateway.core.errors import FileInvalid, UsageError
from fieldtwin.gateway.core.files.profile import DeviceProfile
from fieldtwin.installation import install_hint


def require_library() -> None:
    """Raise `UsageError` with the command that installs the extra, if `basyx-python-sdk` is missing."""
    try:
        import basyx.aas.adapter.aasx  # noqa: F401
    except ImportError as e:
        raise UsageError("Asset Administration Shells need basyx-python-sdk", hint=install_hint("aas")) from e


def import_description(source: Source, settings: Settings) -> Imported:
    """Return the profile of one unit of a Modbus interface. Settings: ``interface``, ``select``, ``numbering``."""
    require_library()
    from fieldtwin.descriptions.aas.interface_reader import modbus_interfaces
    from fieldtwin.descriptions.aas.shell_file import read_shells

    path = str(source.path)
    objects, _, skipped = read_shells(source.data, path)
    found = dict(modbus_interfaces(objects))
    if not found:
        expected = "a submodel AssetInterfacesDescription with a base modbus+tcp://HOST:PORT"
        raise FileInvalid("the file describes no Modbus interface", path=path, expected=expected)
    name = settings.get("interface", "") or next(iter(found))
    if name not in found or (len(found) > 1 and "interface" not in settings):
        shown = ", ".join(list(found)[:40])
        raise UsageError(
            f"{path}: which interface", expected=f"--set interface=, one of {shown}", got=settings.get("interface", "")
        )
    document = Document(path, found[name], lambda loc: (0, 0))  # the SDK keeps no lines
    imported = import_properties(
        document, (), found[name], "an Asset Interfaces Description", settings, states_access=False
    )
    losses = tuple(Loss("the file", "an element", message) for message in skipped)
    return Imported(imported.profile, (*losses, *imported.losses))


def export_description(profile: DeviceProfile, settings: Settings) -> Exported:
    """Return a shell with the interface of the profile, as JSON. Settings: ``endpoint``, of Modbus TCP."""
    require_library()
    from basyx.aas import model

    from fieldtwin.descriptions.aas.interface_writer import identifier, interfaces_submodel
    from fieldtwin.descriptions.aas.shell_file import shell_json

    losses: list[Loss] = []
    base = base_uri(profile, settings.get("endpoint", ""), losses)
    interface = interface_of(profile, base, "InterfaceMODBUS", losses)
    submodel = interfaces_submodel(identifier("interfaces", profile.name, base), [interface])
    asset = model.AssetInformation(model.AssetKind.TYPE, identifier("device", profile.name))
    shell = model.AssetAdministrationShell(
        asset,
        identifier("shell", profile.name, base),
        id_short=re.sub("[^A-Za-z0-9]+", "_", f"Device_{profile.name}").rstrip("_"),
        submodel={model.ModelReference.from_referable(submodel)},
    )
    return Exported(shell_json([shell, submodel]), tuple(losses))
