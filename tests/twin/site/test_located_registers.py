"""`addresses: openplc` of a Modbus server: the registers of located variables, as OpenPLC's documentation states them."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.gateway.runtime.plc_variables import is_of_writes
from fieldtwin.gateway.runtime.serve import ServedTag
from fieldtwin.twin.plant.physical import image_layout, program_warnings
from fieldtwin.twin.site.system import System, load_system

EXAMPLE = Path(__file__).resolve().parents[3] / "examples" / "first-bug"


def system_of(
    folder: Path, declared: str, server: str = "addresses: openplc", programs: str = "", keys: str = ""
) -> System:
    """Return a system whose program declares these variables, with a Modbus server."""
    for name in ("level.yaml", "starter.yaml"):
        shutil.copy(EXAMPLE / name, folder)
    (folder / "p.st").write_text(f"PROGRAM p VAR {declared} END_VAR END_PROGRAM")
    system = (EXAMPLE / "tank.yaml").read_text()
    section = f"plc: {{programs: {{{programs or f'p: {{source: p.st{keys}}}'}}}}}\n"
    section += f'serve: {{hmi: {{url: "tcp://127.0.0.1:0", {server}}}}}\n'
    (folder / "tank.yaml").write_text(system[: system.index("plc:")] + section)
    return load_system(str(folder / "tank.yaml"))


def served(system: System) -> list[ServedTag]:
    return list(system.serving.serve[0].tags)


@pytest.mark.parametrize(
    ("declared", "place"),
    [
        ("%QX0.0 : BOOL", ("coil", 0, "bool")),
        ("%QX1.7 : BOOL", ("coil", 15, "bool")),
        ("%QX99.7 : BOOL", ("coil", 799, "bool")),
        ("%IX0.1 : BOOL", ("discrete", 1, "bool")),
        ("%IX99.7 : BOOL", ("discrete", 799, "bool")),
        ("%IW0 : INT", ("input", 0, "int16")),
        ("%IW1023 : WORD", ("input", 1023, "uint16")),
        ("%QW0 : UINT", ("holding", 0, "uint16")),
        ("%QW1023 : INT", ("holding", 1023, "int16")),
        ("%MW0 : INT", ("holding", 1024, "int16")),
        ("%MW1023 : SINT", ("holding", 2047, "int16")),
        ("%MD0 : REAL", ("holding", 2048, "float32")),
        ("%MD1 : DWORD", ("holding", 2050, "uint32")),
        ("%MD1023 : DINT", ("holding", 4094, "int32")),
        ("%ML0 : LREAL", ("holding", 4096, "float64")),
        ("%ML1023 : LINT", ("holding", 8188, "int64")),
    ],
)
def test_the_register_of_each_address(tmp_path: Path, declared: str, place: tuple[str, int, str]) -> None:
    (one,) = served(system_of(tmp_path, f"x AT {declared};"))
    assert (one.table, one.address, one.type, one.order) == (*place, "ABCD")


@pytest.mark.parametrize(
    "declared",
    ["%QX100.0 : BOOL", "%QX0.8 : BOOL", "%QW1024 : INT", "%QB0 : BYTE", "%QD0 : DINT", "%MX0.0 : BOOL", "%MW0 : DINT",
     "%MD0 : LREAL", "%ML0 : TIME", "%Q* : BOOL"],
)  # fmt: skip
def test_a_variable_without_a_place_in_the_convention_is_left_out(tmp_path: Path, declared: str) -> None:
    assert served(system_of(tmp_path, f"x AT {declared};")) == []


def test_only_outputs_and_memory_are_written_and_only_if_the_file_says_so(tmp_path: Path) -> None:
    declared = "q AT %QX0.0 : BOOL; m AT %MW0 : INT(0..9); i AT %IX0.0 : BOOL := TRUE;"
    tags = served(system_of(tmp_path, declared, "addresses: openplc, write: true"))
    assert [(one.variable, one.write, one.limits, one.constant) for one in tags] == [
        ("p.q", True, None, None), ("p.m", True, (0.0, 9.0), None), ("", False, None, True),
    ]  # fmt: skip
    assert not any(one.write for one in served(system_of(tmp_path, declared)))


def test_a_program_takes_writes_only_from_a_server_that_writes(tmp_path: Path) -> None:
    for server, expected in (("addresses: openplc, write: true", True), ("addresses: openplc", False)):
        layout = image_layout(system_of(tmp_path, "m AT %MW0 : INT;", server))
        names = {tag.name for region in layout.regions for tag in region.tags}
        assert ("p.st_writes" in names) is expected
        hidden = {name for name in names if is_of_writes(name)}
        assert hidden == ({"p.st_writes", "p.st_writes.consumed"} if expected else set())


def test_bound_variables_are_read_where_their_values_are(tmp_path: Path) -> None:
    system = system_of(
        tmp_path,
        "q AT %QX0.0 : BOOL; i AT %IX0.0 : BOOL;",
        keys=", inputs: {i: {tag: pump.run}}, outputs: {q: pump.run}",
    )
    q, i = served(system)
    assert (q.tag, q.from_plc) == ("pump.run", True)  # the program's output, not the value read back
    assert (i.tag, i.from_plc, i.constant) == ("pump.run", False, None)


def test_programs_of_one_source_share_an_address_and_others_do_not(tmp_path: Path) -> None:
    (tmp_path / "two.st").write_text("PROGRAM a %MW0 := 1; END_PROGRAM PROGRAM b %MW1 := %MW0; END_PROGRAM")
    one = system_of(tmp_path, "", programs="a: {source: two.st:a}, b: {source: two.st:b}")
    assert [tag.address for tag in served(one)] == [1024, 1025]
    with pytest.raises(FileInvalid, match=r"%MW0 is a variable of two programs: p\.m and q\.m"):
        system_of(tmp_path, "m AT %MW0 : INT;", programs="p: {source: p.st}, q: {source: p.st}")


UNUSED = """VAR_GLOBAL
  q AT %QW3 : INT := 5; m AT %MW9 : INT := 9; i AT %IX2.0 : BOOL := TRUE; text AT %MW10 : STRING; a AT %QW20 : ARRAY[1..2] OF INT;
END_VAR
PROGRAM one VAR q : INT; END_VAR END_PROGRAM
PROGRAM two VAR n : INT; END_VAR n := n + 1; END_PROGRAM
"""


def test_a_global_variable_that_no_program_uses_is_served(tmp_path: Path) -> None:
    """OpenPLC serves each address of a project, also if no statement reads or writes it."""
    (tmp_path / "two.st").write_text(UNUSED)
    programs = "one: {source: two.st:one}, two: {source: two.st:two}"
    system = system_of(tmp_path, "", "addresses: openplc, write: true", programs)
    tags = {tag.tag: (tag.table, tag.address, tag.variable, tag.constant) for tag in served(system)}
    assert tags == {
        "one.QW3": ("holding", 3, "one.QW3", None),
        "one.m": ("holding", 1033, "one.m", None),
        "one.i": ("discrete", 16, "", True),
    }
    assert program_warnings(system) == ()


def test_a_global_variable_that_only_one_program_uses_belongs_to_this_program(tmp_path: Path) -> None:
    (tmp_path / "two.st").write_text(UNUSED.replace("n := n + 1", "m := m + 1"))
    system = system_of(tmp_path, "", programs="one: {source: two.st:one}, two: {source: two.st:two}")
    assert sorted(tag.tag for tag in served(system)) == ["one.QW3", "one.i", "two.m"]


@pytest.mark.parametrize(
    ("server", "said"),
    [
        ("unit: 1", "a server needs `tags` or `addresses`"),
        ("tags: {sensor.level: {input: 0}}, write: true", "`write` is for `addresses`"),
        ("addresses: siemens", "openplc"),
        ("addresses: openplc, tags: {pump.run: {coil: 0}}", "overlaps"),
    ],
)
def test_mistakes_in_a_server_are_refused(tmp_path: Path, server: str, said: str) -> None:
    with pytest.raises(FileInvalid, match=said):
        system_of(tmp_path, "q AT %QX0.0 : BOOL;", server)
