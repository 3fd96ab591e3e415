"""An AASX package that carries a template: a shell with the identity of the template, its Modbus interfaces, and its file.

The shell has three submodels: TemplateIdentification and DigitalTemplate, which are fieldtwin's own and state only facts of the
manifest, and AssetInterfacesDescription (IDTA 02017-1-1) if a device is reached over Modbus TCP. The template is a supplementary
file of the package, with unchanged bytes.
"""

from __future__ import annotations

import hashlib
import io
import re
from collections.abc import Sequence
from typing import Any

from basyx.aas import model
from basyx.aas.adapter import aasx
from basyx.aas.model import datatypes

from fieldtwin.descriptions.aas.interface import Interface
from fieldtwin.descriptions.aas.interface_writer import identifier, interfaces_submodel
from fieldtwin.descriptions.aas.shell_file import MAX_UNPACKED_BYTES, read_shells
from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.twin.template.template import Manifest

_SUBMODEL = "DigitalTemplate"
_FILE = "Template"
_HASH = "TemplateSha256"


def template_package(template: bytes, manifest: Manifest, interfaces: Sequence[Interface], path: str) -> bytes:
    """Return an AASX package with the bytes of a template. Raises `FileInvalid` if the template is too large to be read back."""
    if len(template) > MAX_UNPACKED_BYTES // 2:
        most = f"at most {MAX_UNPACKED_BYTES // 2} bytes"
        raise FileInvalid("the template is too large for a package", path=path, expected=most, got=str(len(template)))
    files: Any = aasx.DictSupplementaryFileContainer()  # type: ignore[no-untyped-call]
    part = f"/aasx/files/{_word(manifest.system)}.zip".lower()  # the SDK's relationships have lower case
    name = files.add_file(part, io.BytesIO(template), "application/zip")
    submodels = [_identification(manifest), _file_of(manifest, name, template)]
    if interfaces:
        submodels.append(interfaces_submodel(identifier("interfaces", manifest.id), interfaces))
    shell = model.AssetAdministrationShell(
        model.AssetInformation(model.AssetKind.TYPE, identifier("template", manifest.id)),
        identifier("shell", manifest.id),
        id_short=_word(manifest.system),
        submodel={model.ModelReference.from_referable(each) for each in submodels},
    )
    out = io.BytesIO()
    store: Any = model.DictIdentifiableStore([shell, *submodels])
    with aasx.AASXWriter(out) as writer:
        # As JSON, because readers of versions 3.0 and 3.1 of the metamodel accept it: in XML their namespaces differ.
        writer.write_aas(shell.id, store, files, write_json=True)
    return out.getvalue()


def template_of_package(data: bytes, path: str) -> bytes:
    """Return the template that a package carries. Raises `FileInvalid` if it carries none, or not with the bytes of its hash."""
    objects, files, _ = read_shells(data, path)
    found = [each for each in objects if isinstance(each, model.Submodel) and each.id_short == _SUBMODEL]
    if len(found) != 1:
        raise FileInvalid("the package carries no template", path=path, expected=f"one submodel {_SUBMODEL}")
    elements = {each.id_short: each for each in found[0].submodel_element}
    file, stated = elements.get(_FILE), elements.get(_HASH)
    template = files.get(str(file.value)) if isinstance(file, model.File) else None
    if template is None or not isinstance(stated, model.Property):
        raise FileInvalid("the package carries no template", path=path, expected=f"a file {_FILE}, and its {_HASH}")
    actual = hashlib.sha256(template).hexdigest()
    if actual != stated.value:
        raise FileInvalid("the template is damaged", path=path, expected=f"SHA-256 {stated.value}", got=actual)
    return template


def _identification(manifest: Manifest) -> Any:
    facts = {
        "System": manifest.system,
        "TemplateId": manifest.id,
        "SoftwareName": "fieldtwin",
        "SoftwareVersion": manifest.software.version,
        "SoftwareModulesSha256": manifest.software.modules_sha256,
    }
    elements = [_text(key, value) for key, value in facts.items()]
    return model.Submodel(identifier("identification", manifest.id), elements, id_short="TemplateIdentification")


def _file_of(manifest: Manifest, name: str, template: bytes) -> Any:
    elements = [
        model.File(_FILE, "application/zip", name),
        _text(_HASH, hashlib.sha256(template).hexdigest()),
        _text("SystemFile", manifest.system_file),
        *([_text("PrototypeFile", manifest.prototype_file)] if manifest.prototype_file else []),
    ]
    return model.Submodel(identifier("file", manifest.id), elements, id_short=_SUBMODEL)


def _text(key: str, value: str) -> model.Property:
    return model.Property(key, datatypes.String, value)


def _word(text: str) -> str:
    """Return a name with the characters of an idShort."""
    return re.sub("[^A-Za-z0-9]+", "_", f"Template_{text}").rstrip("_")[:128]
