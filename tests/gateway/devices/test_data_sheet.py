"""A CANopen profile is compared with its EDS before a run: an object that the EDS lacks, or a type of another size, is an error
with its place in the profile."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.gateway.core.files.profile_file import load_profile
from fieldtwin.gateway.devices.data_sheet import check_data_sheet
from fieldtwin.site.check import check_site
from fieldtwin.twin.site.data_files import data_root
from fieldtwin.twin.site.system import load_system

DEVICES = data_root() / "profiles" / "devices"
SYSTEM = """fieldtwin: 1
system: hall
buses: {can0: {url: "can:socketcan/can0"}}
devices: {io: {profile: io-cia401.yaml, bus: can0, node: 6, poll: {values: {every_ms: 500}}}}
"""


@pytest.fixture
def profile(tmp_path: Path) -> Path:
    """A copy of the shipped I/O module's profile and EDS, in which a test changes the profile."""
    for name in ("io-cia401.yaml", "io-cia401.eds"):
        shutil.copy(DEVICES / name, tmp_path)
    return tmp_path / "io-cia401.yaml"


def changed(profile: Path, *changes: tuple[str, str]) -> None:
    text = profile.read_text()
    for old, new in changes:
        assert text.count(old) == 1, old
        text = text.replace(old, new)
    profile.write_text(text)


def line_of(profile: Path, tag: str) -> int:
    return next(n for n, line in enumerate(profile.read_text().splitlines(), 1) if line.strip().startswith(tag))


@pytest.mark.parametrize("path", sorted(DEVICES.glob("*.yaml")), ids=lambda path: path.stem)
def test_shipped_profiles_fit_their_data_sheets(path: Path) -> None:
    check_data_sheet(load_profile(path))


def test_type_of_another_size_is_an_error_at_the_type(profile: Path) -> None:
    changed(
        profile, ('outputs_1:         {object: "6200:01", type: uint8', 'outputs_1: {object: "6200:01", type: uint32')
    )
    with pytest.raises(FileInvalid) as error:
        check_data_sheet(load_profile(profile))
    assert (error.value.line, error.value.expected, error.value.got) == (
        line_of(profile, "outputs_1"),
        "uint8",
        "uint32",
    )
    assert "6200h:01 of io-cia401.eds, which is UNSIGNED8" in error.value.message


def test_integer_type_does_not_fit_a_real_object_of_the_same_size(profile: Path) -> None:
    eds = profile.with_suffix(".eds")
    head, _, rest = eds.read_text().partition("[6200sub1]")
    eds.write_text(head + "[6200sub1]" + rest.replace("DataType=0x0005", "DataType=0x0008", 1))
    changed(
        profile, ('outputs_1:         {object: "6200:01", type: uint8', 'outputs_1: {object: "6200:01", type: uint32')
    )
    with pytest.raises(FileInvalid, match="REAL32; expected float32; got uint32"):
        check_data_sheet(load_profile(profile))


def test_object_that_the_eds_lacks_is_an_error_that_names_its_subindexes(profile: Path) -> None:
    changed(profile, ('"6200:02"', '"6200:03"'))
    with pytest.raises(FileInvalid, match=r'no object 6200h:03; expected "6200:01", "6200:02"') as error:
        check_data_sheet(load_profile(profile))
    assert error.value.line == line_of(profile, "outputs_2")


def test_tag_in_a_range_of_names_is_reported_at_the_range(profile: Path) -> None:
    changed(profile, ("analogue_in_1..4:  ", "analogue_in_1..5:  "))
    with pytest.raises(FileInvalid, match="no object 6401h:05") as error:
        check_data_sheet(load_profile(profile))
    assert error.value.line == line_of(profile, "analogue_in_1..5")


def test_sign_of_an_integer_and_a_missing_file_are_no_errors(profile: Path) -> None:
    changed(profile, ("type: int16, scale: 0.00030517578125, unit: V}", "type: uint16}"))
    check_data_sheet(load_profile(profile))
    profile.with_suffix(".eds").unlink()
    check_data_sheet(load_profile(profile))


def test_loader_and_check_site_report_every_error_of_a_profile_once(profile: Path, tmp_path: Path) -> None:
    changed(profile, ('"6200:02"', '"6200:03"'), ('"6000:01", type: uint8', '"6000:01", type: int16'))
    system = tmp_path / "hall.yaml"
    system.write_text(SYSTEM)
    with pytest.raises(FileInvalid) as error:
        load_system(str(system))
    assert [e.line for e in (error.value, *error.value.others)] == [
        line_of(profile, t) for t in ("inputs_1", "outputs_2")
    ]
    assert len(check_site(tmp_path).errors) == 2


def test_input_of_a_device_whose_profile_has_an_error_is_no_further_error(profile: Path, tmp_path: Path) -> None:
    changed(profile, ("type: uint8, access: rw}\n  outputs_2", "type: uint9, access: rw}\n  outputs_2"))
    (tmp_path / "lamp.st").write_text("PROGRAM Lamp\nVAR_INPUT\n  on : USINT;\nEND_VAR\nEND_PROGRAM\n")
    programs = "plc: {programs: {lamp: {source: lamp.st, inputs: {on: {tag: io.inputs_1}}}}}\n"
    (tmp_path / "hall.yaml").write_text(SYSTEM + programs)
    (error,) = check_site(tmp_path).errors
    assert error.path.endswith("io-cia401.yaml")
