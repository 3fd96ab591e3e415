"""Exports in the forms of CODESYS, OpenPLC Editor and Beremiz run unchanged (the samples are our own)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.plc.program import Role, ScanInfo
from fieldtwin.plc.st.dialects import dialect_of
from fieldtwin.plc.st.program import StProgram, load_source

SHAPES = Path(__file__).parents[2] / "vectors" / "plcopen"
MS = 1_000_000


def loaded(name: str) -> Any:
    return load_source(SHAPES / f"{name}_shape.xml")()


def scan(made: StProgram, number: int) -> None:
    made.execute(ScanInfo(10 * number * MS, number, number == 1))


def roles(made: StProgram) -> dict[str, Role]:
    return {v.name: v.role for v in made.variables.values()}


def test_codesys_qualified_globals_and_enumerations_despite_the_vendors_additions() -> None:
    made = loaded("codesys")
    assert roles(made) == {"level": Role.INPUT, "valve": Role.OUTPUT, "eMode": Role.LOCAL}
    made.level = 1.0
    seen = []
    for number in range(1, 8):
        if number == 3:
            made.level = 3.0
        scan(made, number)
        seen.append((made.valve, made.eMode))
    assert seen == [(True, 10)] * 2 + [(False, 0)] * 5  # in scan 3 the level has been above the ramp for 20 ms
    assert made.st_body.v_stext == "GVL.x"  # a text is not changed
    assert made.variables["eMode"].words == ((0, "Idle"), (10, "Filling"))


def test_openplc_located_variables_are_inputs_and_outputs() -> None:
    made = loaded("openplc")
    assert roles(made) == {
        "button": Role.INPUT, "lamp": Role.OUTPUT, "speed": Role.OUTPUT, "memory": Role.LOCAL, "presses": Role.LOCAL,
    }  # fmt: skip
    made.button = True
    for number in range(1, 5):
        scan(made, number)
    assert (made.presses, made.memory, made.speed) == (1, 4, 8)
    assert made.retained() == {"presses": 1}


def test_beremiz_globals_of_resource_and_configuration_subranges_and_structures() -> None:
    made = loaded("beremiz")
    assert made.variables["load"].limits == (0, 100)
    assert made.load == 10
    made.a, made.b = 85, 90
    scan(made, 1)
    scan(made, 2)
    recipe = made.st_body.v_r
    assert (made.mean, made.load, recipe.m_hot, recipe.m_seconds) == (87.5, 100, True, 3)


def test_errors_name_line_and_column_of_the_export(tmp_path: Path) -> None:
    text = (SHAPES / "codesys_shape.xml").read_text()
    line = next(n for n, row in enumerate(text.splitlines(), 1) if row.startswith("valve := "))
    for wrong, told, column in (
        ("E_Mode.Fillin", "Fillin", 18),
        ("GVL.setpint", "did you mean 'setpoint'?", 22),
    ):
        path = tmp_path / "tank.xml"
        path.write_text(text.replace("valve := eMode = E_Mode.Filling;", f"valve := eMode = {wrong};"))
        with pytest.raises(FileInvalid, match=told) as e:
            load_source(path)
        assert (e.value.line, e.value.column) == (line, column)


def test_a_block_with_an_empty_method_is_refused_where_it_is_used(tmp_path: Path) -> None:
    text = (SHAPES / "codesys_shape.xml").read_text()
    assert text.count("<addData />") == 1
    path = tmp_path / "tank.xml"
    data = '<addData><data name="http://www.3s-software.com/plcopenxml/method"><Method name="Reset"/></data></addData>'
    path.write_text(text.replace("<addData />", data))
    with pytest.raises(
        FileInvalid,
        match=r"tank\.xml:\d+:\d+: the method FB_Ramp\.Reset has no interface and body in ST, which is not supported",
    ):
        load_source(path)


def test_a_method_of_a_block_is_imported(tmp_path: Path) -> None:
    text = (SHAPES / "codesys_shape.xml").read_text()
    path = tmp_path / "tank.xml"
    method = """<addData><data name="http://www.3s-software.com/plcopenxml/method"><Method name="Twice">
<interface><returnType><INT/></returnType><inputVars><variable name="x"><type><INT/></type></variable></inputVars></interface>
<body><ST><xhtml xmlns="http://www.w3.org/1999/xhtml">Twice := 2 * x;</xhtml></ST></body></Method></data></addData>"""
    path.write_text(text.replace("<addData />", method))
    (tmp_path / "main.st").write_text("PROGRAM P VAR ramp : FB_Ramp; n : INT; END_VAR n := ramp.Twice(21); END_PROGRAM")
    made: Any = load_source(tmp_path, "P", dialect_of("codesys"))()
    scan(made, 1)
    assert made.n == 42
    path.write_text(path.read_text().replace("2 * x", "2 * y"))
    with pytest.raises(FileInvalid, match="a variable 'y' is not declared") as e:
        load_source(tmp_path, "P", dialect_of("codesys"))
    assert path.read_text().splitlines()[e.value.line - 1].count("2 * y") == 1
