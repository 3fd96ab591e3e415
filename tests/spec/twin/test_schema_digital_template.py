"""Schemas Document, BluePrint, TechnicalManual, BillOfMaterials, Generic, DigitalTemplate."""

from __future__ import annotations

import hashlib
import re
from pathlib import Path

import pytest
from spec_rig import CLOCK, observatory

from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.twin.model.model import DigitalModel
from fieldtwin.twin.plant.declared import declared_variables
from fieldtwin.twin.plant.physical import EmbeddedControlSystem
from fieldtwin.twin.prototype.prototype import DigitalTwinPrototype
from fieldtwin.twin.site.system import load_system
from fieldtwin.twin.template.check import examine, put_together
from fieldtwin.twin.template.pack import TemplateExtras, collect, pack
from fieldtwin.twin.template.package import FolderPackage
from fieldtwin.twin.template.template import (
    DOCUMENTS,
    BillOfMaterials,
    BluePrint,
    DigitalTemplate,
    Document,
    DocumentKind,
    Generic,
    TechnicalManual,
)


def template(tmp_path: Path) -> DigitalTemplate:
    """The observatory's template, with a document of each kind, read back from its package."""
    system, prototype = observatory()
    documents: dict[DocumentKind, tuple[Path, ...]] = {}
    for kind in DOCUMENTS:
        documents[kind] = (tmp_path / f"{kind}.txt",)
        documents[kind][0].write_text(f"a {kind}")
    pack(system, collect(system, (), prototype.path), TemplateExtras(documents), "1.0", tmp_path / "T")
    package = FolderPackage(tmp_path / "T")
    package.verify()
    return put_together(package.manifest, examine(package.path, package.manifest), package.path, CLOCK)


@pytest.mark.parametrize("kind", [BluePrint, TechnicalManual, BillOfMaterials, Generic])
def test_Document_each_kind_is_a_document(kind: type[Document]) -> None:
    assert issubclass(kind, Document)
    assert kind is not Document


def test_DigitalTemplate_is_documents_and_the_embedded_control_system_and_the_digital_model(tmp_path: Path) -> None:
    made = template(tmp_path)
    assert {type(document) for document in made.documents} == {BluePrint, TechnicalManual, BillOfMaterials, Generic}
    assert type(made.ecs) is EmbeddedControlSystem
    assert type(made.digital_model) is DigitalModel
    assert list(made.digital_model.variables) == list(DigitalModel(declared_variables(made.ecs.system)).variables)
    for document in made.documents:
        path = tmp_path / "T" / document.path
        assert path.read_text() == f"a {document.kind}"
        assert document.sha256 == hashlib.sha256(path.read_bytes()).hexdigest()


def test_DigitalTemplate_every_part_has_its_hash_and_a_wrong_one_is_named(tmp_path: Path) -> None:
    """System, prototype, profiles, EDS, recordings, the model, documents of each kind: change one byte of each."""
    manifest = template(tmp_path).manifest
    kinds = {file.kind for file in manifest.files}
    assert kinds == {"system", "prototype", "profile", "eds", "recording", "model", "document"}
    for file in manifest.files:
        path = tmp_path / "T" / file.path
        whole = path.read_bytes()
        path.write_bytes(bytes([whole[0] ^ 1]) + whole[1:])
        with pytest.raises(
            FileInvalid,
            match=f"{re.escape(file.path)}: the file has changed since it was packed; expected SHA-256 {file.sha256}",
        ):
            FolderPackage(tmp_path / "T").verify()
        path.write_bytes(whole)
        path.rename(tmp_path / "away")
        with pytest.raises(FileInvalid, match=f"'{re.escape(file.path)}' is missing"):
            FolderPackage(tmp_path / "T")
        (tmp_path / "away").rename(path)
    FolderPackage(tmp_path / "T").verify()


def test_DigitalTemplate_holds_the_physical_twins_own_configuration_and_a_model_of_its_own(tmp_path: Path) -> None:
    """Prose, rows 2 and 8: the same file, byte for byte; and a model separate from any twin's."""
    system, prototype = observatory()
    made = template(tmp_path)
    assert made.ecs.system.path.read_bytes() == system.path.read_bytes()
    again = load_system(str(made.ecs.system.path))
    assert made.digital_model is not DigitalTwinPrototype(again, prototype, CLOCK).model
