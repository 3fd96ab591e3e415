"""Methods, properties and blocks of variables that CODESYS adds to PLCopen XML (the samples are our own).

The elements and attributes are those of public exports of CODESYS: data/Method, data/Property with SetAccessor and GetAccessor,
AccessModifiers, Inheritance and MixedAttrsVarList, all below ``http://www.3s-software.com/plcopenxml/``.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.plc.program import ScanInfo
from fieldtwin.plc.st.dialects import dialect_of
from fieldtwin.plc.st.program import load_source

DATA = "http://www.3s-software.com/plcopenxml"


def st(text: str) -> str:
    return f'<body><ST><xhtml xmlns="http://www.w3.org/1999/xhtml">{text}</xhtml></ST></body>'


def variable(name: str, kind: str, initial: str = "") -> str:
    value = f'<initialValue><simpleValue value="{initial}"/></initialValue>' if initial else ""
    return f'<variable name="{name}"><type><{kind}/></type>{value}</variable>'


PROPERTY = f"""<data name="{DATA}/property" handleUnknown="implementation">
<Property name="speed" ObjectId="1">
<interface><returnType><INT/></returnType></interface>
<SetAccessor>
<interface><localVars>{variable("limited", "INT")}</localVars></interface>
{st("limited := MIN(speed, highest); own := limited;")}
<addData/></SetAccessor>
<GetAccessor>
<interface/>
{st("speed := own;")}
<addData/></GetAccessor>
<addData/></Property>
</data>"""
METHOD = f"""<data name="{DATA}/method" handleUnknown="implementation">
<Method name="Twice" ObjectId="2">
<interface><returnType><INT/></returnType><inputVars>{variable("x", "INT")}</inputVars>
<localVars>{variable("sum", "INT")}
<addData><data name="{DATA}/mixedattrsvarlist"><MixedAttrsVarList>
<localVars constant="true">{variable("factor", "INT", "2")}</localVars>
<localVars>{variable("sum", "INT", "1")}</localVars>
</MixedAttrsVarList></data></addData></localVars>
<addData><data name="{DATA}/accessmodifiers"><AccessModifiers Private="true"/></data></addData></interface>
{st("sum := sum + factor * x; Twice := sum;")}
</Method></data>"""
EXPORT = f"""<?xml version="1.0"?>
<project xmlns="http://www.plcopen.org/xml/tc6_0200"><types><dataTypes/><pous>
<pou name="Base" pouType="functionBlock"><interface>
<localVars><variable name="own"><type><INT/></type></variable></localVars></interface>
{st("own := own + 1;")}
<addData>{PROPERTY.replace("MIN(speed, highest)", "MIN(speed, 100)")}</addData></pou>
<pou name="Drive" pouType="functionBlock"><interface>
<outputVars>{variable("doubled", "INT")}</outputVars>
<addData><data name="{DATA}/pouinheritance"><Inheritance><Extends>Base</Extends></Inheritance></data></addData></interface>
{st("own := own + 10; doubled := Twice(own);")}
<addData>{METHOD}</addData></pou>
<pou name="Main" pouType="program"><interface>
<localVars><variable name="drive"><type><derived name="Drive"/></type></variable>
{variable("seen", "INT")}{variable("double", "INT")}
</localVars></interface>
{st("drive.speed := 500; drive(); seen := drive.speed + start; double := drive.doubled;")}</pou>
</pous></types><instances><configurations/></instances>
<addData><data name="{DATA}/globalvars"><globalVars name="Gvl">{variable("start", "INT", "1000")}{variable("highest", "INT", "7")}
<addData><data name="{DATA}/mixedattrsvarlist"><MixedAttrsVarList>
<globalVars name="Gvl">{variable("start", "INT", "1000")}</globalVars>
<globalVars name="Gvl" constant="true">{variable("highest", "INT", "7")}</globalVars>
</MixedAttrsVarList></data></addData></globalVars></data></addData>
</project>"""


def loaded(folder: Path, text: str) -> Any:
    path = folder / "plant.xml"
    path.write_text(text, encoding="utf-8")
    return load_source(path, "Main", dialect_of("codesys"))()


def test_properties_methods_and_bases_of_an_export_are_executed(tmp_path: Path) -> None:
    made = loaded(tmp_path, EXPORT)
    made.execute(ScanInfo(0, 1, True))
    assert (made.seen, made.double) == (1110, 221)


def test_a_constant_in_one_of_several_parts_of_a_list_stays_constant(tmp_path: Path) -> None:
    with pytest.raises(FileInvalid, match="highest cannot be assigned to"):
        loaded(tmp_path, EXPORT.replace("drive.speed := 500;", "highest := 8;"))


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("own := limited;", "own := limted;", "a variable 'limted' is not declared"),
        ("speed := own;", "speed := TRUE;", "assigned to speed; expected INT; got BOOL"),
        ("double := drive.doubled;", "double := drive.Twice(3);", "Twice is PRIVATE"),
        ("<Extends>Base</Extends>", "<Extends>Bass</Extends>", "'Bass' is not declared"),
    ],
)
def test_errors_name_the_line_of_the_export(old: str, new: str, message: str, tmp_path: Path) -> None:
    text = EXPORT.replace(old, new)
    with pytest.raises(FileInvalid, match=message) as e:
        loaded(tmp_path, text)
    if "Extends" not in new:
        assert new in text.splitlines()[e.value.line - 1]


def test_a_property_with_an_accessor_in_another_language_is_not_imported(tmp_path: Path) -> None:
    text = EXPORT.replace(st("speed := own;"), "<body><FBD/></body>")
    with pytest.raises(FileInvalid, match=r"GET of the property Base\.speed has no interface and body in ST"):
        loaded(tmp_path, text)


UNION = f"""<data name="{DATA}/union" handleUnknown="implementation">
<union name="Halves">
{variable("whole", "DWORD", "16#10002")}
<variable name="half"><type><array><dimension lower="0" upper="1"/><baseType><WORD/></baseType></array></type></variable>
</union></data>"""


WITHOUT_DRIVE = EXPORT.replace('<derived name="Drive"/>', "<INT/>").replace(
    st("drive.speed := 500; drive(); seen := drive.speed + start; double := drive.doubled;"), st("seen := start;")
)


def test_a_union_of_an_export_is_imported_in_the_dialects_that_have_unions(tmp_path: Path) -> None:
    data = f'<addData><data name="{DATA}/globalvars">'
    text = WITHOUT_DRIVE.replace(data, data.replace("<addData>", f"<addData>{UNION}"))
    assert loaded(tmp_path, text).seen == 0
    (tmp_path / "used.st").write_text(
        "PROGRAM Used VAR h : Halves; n : WORD; END_VAR n := h.half[1] + h.half[0]; END_PROGRAM"
    )
    made: Any = load_source(tmp_path, "Used", dialect_of("codesys"))()
    made.execute(ScanInfo(0, 1, True))
    assert made.n == 3
    with pytest.raises(FileInvalid, match="Halves is a UNION, which the dialects codesys and twincat have"):
        load_source(tmp_path, "Used")


def test_a_block_with_a_property_is_an_error_in_the_standard_only_where_it_is_used(tmp_path: Path) -> None:
    path = tmp_path / "plant.xml"
    path.write_text(EXPORT, encoding="utf-8")
    with pytest.raises(FileInvalid, match="Drive extends Base; Base has a property, which the dialects codesys"):
        load_source(path, "Main")
    path.write_text(WITHOUT_DRIVE, encoding="utf-8")
    made: Any = load_source(path, "Main")()
    made.execute(ScanInfo(0, 1, True))
    assert made.seen == 1000
