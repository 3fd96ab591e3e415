"""Files of a TwinCAT project as the source of a program."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from st_bench import scan

from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.plc.binding import load_program
from fieldtwin.plc.st.syntax.twincat import is_twincat, to_st

HEAD = '<?xml version="1.0" encoding="utf-8"?>\n<TcPlcObject Version="1.1.0.1" ProductVersion="3.1.4024.0">\n'
MAIN = f"""{HEAD}  <POU Name="MAIN" Id="{{1}}" SpecialFunc="None">
    <Declaration><![CDATA[// FUNCTION in a comment
PROGRAM MAIN
VAR
  ramp : FB_Ramp;
  n : INT;
  mode : E_Mode := E_Mode.Up;
END_VAR
]]></Declaration>
    <Implementation>
      <ST><![CDATA[ramp(step := GVL.STEP, mode := mode);
n := ramp.level;
IF n > 5 AND mode = E_Mode.Up THEN mode := E_Mode.Down; END_IF]]></ST>
    </Implementation>
  </POU>
</TcPlcObject>"""
RAMP = f"""{HEAD}<POU Name="FB_Ramp" Id="{{2}}"><Declaration>
FUNCTION_BLOCK FB_Ramp
VAR_INPUT step : INT; mode : E_Mode; END_VAR
VAR_OUTPUT level : INT; END_VAR
</Declaration><Implementation><ST>IF mode = E_Mode.Up THEN level := level + step; END_IF
IF level &gt; 100 THEN level := 100; END_IF
</ST></Implementation></POU></TcPlcObject>"""
MODE = f"""{HEAD}<DUT Name="E_Mode" Id="{{3}}"><Declaration><![CDATA[{{attribute 'qualified_only'}}
TYPE E_Mode : (Down, Up); END_TYPE
]]></Declaration></DUT></TcPlcObject>"""
GVL = f"""{HEAD}<GVL Name="GVL" Id="{{4}}"><Declaration><![CDATA[{{attribute 'qualified_only'}}
VAR_GLOBAL CONSTANT
  STEP : INT := 3;
END_VAR]]></Declaration></GVL></TcPlcObject>"""


@pytest.fixture
def project(tmp_path: Path) -> Path:
    """A TwinCAT project: a program, a function block, an enumeration and a list of global variables, each in a file."""
    for name, text in (("MAIN.TcPOU", MAIN), ("FB_Ramp.TcPOU", RAMP), ("E_Mode.TcDUT", MODE), ("GVL.TcGVL", GVL)):
        folder = tmp_path / name.rpartition(".")[2]
        folder.mkdir(exist_ok=True)
        (folder / name).write_text("\ufeff" + text.replace("\n", "\r\n"), encoding="utf-8", newline="")
    (tmp_path / "plc.plcproj").write_text("<Project/>")
    return tmp_path


def test_a_project_of_several_files_runs(project: Path) -> None:
    made: Any = load_program(str(project), dialect="twincat")
    for number in range(1, 5):
        scan(made, number)
    assert (made.n, made.mode) == (6, 0)


@pytest.mark.parametrize(
    ("file", "before", "after", "place"),
    [
        ("TcPOU/MAIN.TcPOU", "n := ramp", "n := rampe", "14:6"),
        ("TcPOU/MAIN.TcPOU", "ramp(step", "rampe(step", "13:20"),
        ("TcPOU/MAIN.TcPOU", "  n : INT", "  n : INTT", "8:7"),
        ("TcPOU/FB_Ramp.TcPOU", "level := 100;", "level := 100", "8:34"),
        ("TcDUT/E_Mode.TcDUT", "(Down, Up)", "(Down, Down)", "4:6"),
        ("TcGVL/GVL.TcGVL", ":= 3", ":= TRUE", "5:17"),
    ],
)
def test_errors_have_line_and_column_of_the_file(project: Path, file: str, before: str, after: str, place: str) -> None:
    path = project / file
    path.write_bytes(path.read_bytes().replace(before.encode(), after.encode()))
    with pytest.raises(FileInvalid) as caught:
        load_program(str(project), dialect="twincat")
    places = [f"{Path(error.path).name}:{error.line}:{error.column}" for error in (caught.value, *caught.value.others)]
    assert f"{path.name}:{place}" in places


ACTIONS = """  <Action Name="Reset" Id="{5}">
      <Implementation>
        <ST><![CDATA[n := 0;
calls := calls + 1;]]></ST>
      </Implementation>
    </Action><Action Name="Nothing"/>
  </POU>"""


def test_actions_are_called_and_errors_in_them_have_their_place(tmp_path: Path) -> None:
    path = tmp_path / "MAIN.TcPOU"
    text = f"""{HEAD}<POU Name="MAIN" Id="{{1}}"><Declaration><![CDATA[PROGRAM MAIN
VAR n : INT := 5; calls : INT; END_VAR]]></Declaration>
    <Implementation><ST>n := n + 1; IF n > 6 THEN Reset(); Nothing(); END_IF</ST></Implementation>
{ACTIONS}</TcPlcObject>"""
    path.write_text(text.replace("n > 6", "n &gt; 6"))
    made: Any = load_program(str(path), dialect="twincat")
    for number in range(1, 4):
        scan(made, number)
    assert (made.n, made.calls) == (1, 1)
    path.write_text(path.read_text().replace("calls := calls", "calls := call"))
    with pytest.raises(FileInvalid, match=r"MAIN\.TcPOU:9:10: .*call"):
        load_program(str(path), dialect="twincat")


DRIVE = f"""{HEAD}<Itf Name="I_Drive" Id="{{6}}"><Declaration><![CDATA[{{attribute 'x'}}
// PROGRAM in a comment
INTERFACE I_Drive
]]></Declaration>
  <Method Name="Start" Id="{{7}}"><Declaration><![CDATA[METHOD Start : BOOL
VAR_INPUT
  rpm : INT;
END_VAR
]]></Declaration></Method>
  <Property Name="Speed" Id="{{8}}"><Declaration><![CDATA[PROPERTY Speed : INT]]></Declaration>
    <Get Name="Get" Id="{{9}}"><Declaration><![CDATA[]]></Declaration></Get>
  </Property>
</Itf></TcPlcObject>"""
MOTOR = f"""{HEAD}<POU Name="FB_Motor" Id="{{10}}">
  <Declaration><![CDATA[FUNCTION_BLOCK FB_Motor IMPLEMENTS I_Drive
VAR
  _speed : INT;
  calls : INT;
END_VAR
]]></Declaration>
  <Implementation><ST><![CDATA[calls := calls + 1;]]></ST></Implementation>
  <Folder Name="Methods" Id="{{11}}" />
  <Method Name="Start" Id="{{12}}" FolderPath="Methods\\">
    <Declaration><![CDATA[METHOD PUBLIC Start : BOOL
VAR_INPUT
  rpm : INT;
END_VAR
]]></Declaration>
    <Implementation><ST><![CDATA[Speed := rpm;
Start := THIS^.Speed > 0;
Reset();]]></ST></Implementation>
  </Method>
  <Property Name="Speed" Id="{{13}}"><Declaration><![CDATA[PROPERTY PUBLIC Speed : INT]]></Declaration>
    <Get Name="Get" Id="{{14}}"><Declaration><![CDATA[VAR
END_VAR
]]></Declaration>
      <Implementation><ST><![CDATA[Speed := _speed;]]></ST></Implementation></Get>
    <Set Name="Set" Id="{{15}}"><Declaration><![CDATA[VAR half : INT; END_VAR
]]></Declaration><Implementation><ST><![CDATA[half := Speed / 2;
_speed := half * 2;]]></ST></Implementation></Set>
  </Property><Action Name="Reset" Id="{{16}}"><Implementation><ST><![CDATA[calls := 0;]]></ST></Implementation></Action>
</POU></TcPlcObject>"""
USER = f"""{HEAD}<POU Name="MAIN" Id="{{17}}"><Declaration><![CDATA[PROGRAM MAIN
VAR motor : FB_Motor; drive : I_Drive; n : INT; ok : BOOL; END_VAR]]></Declaration>
<Implementation><ST><![CDATA[motor();
drive := motor;
ok := drive.Start(rpm := n + 3);
n := drive.Speed;]]></ST></Implementation></POU></TcPlcObject>"""


@pytest.fixture
def classes(tmp_path: Path) -> Path:
    """A TwinCAT project with an interface, a function block with a method and a property, and a program that uses both."""
    for name, text in (("I_Drive.TcIO", DRIVE), ("FB_Motor.TcPOU", MOTOR), ("MAIN.TcPOU", USER)):
        (tmp_path / name).write_text(text, encoding="utf-8")
    return tmp_path


def test_methods_properties_and_interfaces_of_a_project_run(classes: Path) -> None:
    made: Any = load_program(str(classes), dialect="twincat")
    scan(made)
    assert (made.n, made.ok, made.st_body.v_motor.v_calls) == (2, True, 0)
    scan(made, 2)
    assert made.n == 4


@pytest.mark.parametrize(
    ("file", "before", "after", "token"),
    [
        ("FB_Motor.TcPOU", "Reset();", "Rest();", "Rest"),
        ("FB_Motor.TcPOU", "rpm : INT", "rpm : INTT", "INTT"),
        ("FB_Motor.TcPOU", "Speed := _speed;", "Speed := _spee;", "_spee"),
        ("FB_Motor.TcPOU", "_speed := half", "_speed := hal ", "hal "),
        ("FB_Motor.TcPOU", "calls := 0", "calls := 0.5", "0.5"),
        ("I_Drive.TcIO", "rpm : INT", "rpm : INTT", "INTT"),
        ("I_Drive.TcIO", "PROPERTY Speed : INT", "PROPERTY Speed : INTT", "INTT"),
    ],
)
def test_errors_in_methods_have_line_and_column_of_the_file(
    classes: Path, file: str, before: str, after: str, token: str
) -> None:
    path = classes / file
    text = path.read_text().replace(before, after)
    path.write_text(text)
    at = text.index(token, text.index(after))
    with pytest.raises(FileInvalid) as caught:
        load_program(str(classes), dialect="twincat")
    places = [f"{Path(error.path).name}:{error.line}:{error.column}" for error in (caught.value, *caught.value.others)]
    assert f"{file}:{text.count(chr(10), 0, at) + 1}:{at - text.rfind(chr(10), 0, at)}" in places


def test_parts_that_are_not_supported_are_named() -> None:
    drawn = "<Implementation><NWL/></Implementation>"
    parts = (
        f'<Method Name="Start" Id="{{5}}"><Declaration>METHOD Start</Declaration>{drawn}</Method>\n'
        f'<Property Name="Level" Id="{{6}}"><Get Name="Get">{drawn}</Get></Property><Transition Name="Full"/>\n</POU>'
    )
    with pytest.raises(FileInvalid) as caught:
        to_st(MAIN.replace("</POU>", parts), "MAIN.TcPOU")
    assert [str(error) for error in (caught.value, *caught.value.others)] == [
        "MAIN.TcPOU:17:88: the body of MAIN.Start is not Structured Text; expected ST; got NWL",
        "MAIN.TcPOU:18:65: the body of MAIN.Level.Get is not Structured Text; expected ST; got NWL",
        "MAIN.TcPOU:18:105: Full of MAIN: transitions are not supported",
    ]
    with pytest.raises(FileInvalid, match="the body of MAIN is not Structured Text; expected ST; got NWL"):
        to_st(MAIN.replace("<ST>", "<NWL>").replace("</ST>", "</NWL>"))
    action = f'<Action Name="Stop">{drawn}</Action></POU>'
    with pytest.raises(FileInvalid, match=r"the body of MAIN\.Stop is not Structured Text"):
        to_st(MAIN.replace("</POU>", action))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (MAIN[:-5], "not XML"),
        (
            MAIN.replace("<TcPlc", '<!DOCTYPE x [<!ENTITY a "b">]><TcPlc', 1),
            "a document type declaration is not allowed",
        ),
        (f"{HEAD}</TcPlcObject>", ""),
        (f"{HEAD}<Other><Implementation><X/></Implementation></Other></TcPlcObject>", ""),
    ],
)
def test_a_damaged_file_is_refused(text: str, message: str) -> None:
    if message:
        with pytest.raises(FileInvalid, match=message):
            to_st(text, "MAIN.TcPOU")
    else:
        assert not to_st(text).strip()


def test_the_encoding_that_a_decoded_text_declares_does_not_count() -> None:
    for name in ("utf-99", "ISO-8859-1", "UTF-16"):
        assert to_st(MAIN.replace('encoding="utf-8"', f'encoding="{name}"')) == to_st(MAIN)


@given(st.sampled_from([MAIN, MOTOR]), st.integers(0, len(MOTOR)), st.integers(0, 40), st.text(max_size=8))
def test_a_file_with_random_damage_is_read_or_refused(whole: str, at: int, removed: int, inserted: str) -> None:
    text = whole[:at] + inserted + whole[at + removed :]
    try:
        found = to_st(text)
    except FileInvalid:
        return
    assert found.count("\n") <= text.count("\n") + text.count("\r")


def test_a_file_of_twincat_is_known_by_its_root() -> None:
    assert is_twincat("\ufeff" + MAIN)
    assert not is_twincat("<project/>")


def test_a_comment_with_the_word_function_is_not_the_kind_of_an_object(tmp_path: Path) -> None:
    path = tmp_path / "Version.TcGVL"
    path.write_text(f"""{HEAD}<GVL Name="Version" Id="{{5}}"><Declaration><![CDATA[{{attribute 'linkalways'}}
// This FUNCTION has been made (* by a tool *)
(* of a FUNCTION *) VAR_GLOBAL CONSTANT major : INT := 3; END_VAR
]]></Declaration></GVL></TcPlcObject>""")
    assert "END_FUNCTION" not in to_st(path.read_text())
