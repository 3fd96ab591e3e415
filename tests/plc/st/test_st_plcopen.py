"""PLCopen XML exports become Structured Text whose errors name lines of the export."""

from __future__ import annotations

from pathlib import Path

import pytest
from st_bench import program, scan

from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.plc.st.plcopen.convert import convert
from fieldtwin.plc.st.plcopen.elements import is_plcopen
from fieldtwin.plc.st.program import load_source

EXPORT = """<?xml version="1.0" encoding="utf-8"?>
<project xmlns="http://www.plcopen.org/xml/tc6_0200" xmlns:xhtml="http://www.w3.org/1999/xhtml">
  <fileHeader companyName="" productName="" productVersion="1" creationDateTime="2026-01-01T00:00:00"/>
  <types>
    <dataTypes>
      <dataType name="Mode"><baseType><enum><values><value name="idle"/><value name="busy" value="4"/>
      </values></enum></baseType></dataType>
      <dataType name="Pair"><baseType><struct>
        <variable name="a"><type><INT/></type><initialValue><simpleValue value="3"/></initialValue></variable>
        <variable name="b"><type><array><dimension lower="0" upper="2"/><baseType><REAL/></baseType></array></type></variable>
      </struct></baseType></dataType>
    </dataTypes>
    <pous>
      <pou name="Twice" pouType="function">
        <interface><returnType><INT/></returnType>
          <inputVars><variable name="x"><type><INT/></type></variable></inputVars></interface>
        <body><ST><xhtml:p><![CDATA[Twice := x * 2;]]></xhtml:p></ST></body>
      </pou>
      <pou name="Main" pouType="program">
        <interface>
          <inputVars><variable name="go"><type><BOOL/></type></variable></inputVars>
          <outputVars><variable name="n"><type><INT/></type></variable></outputVars>
          <localVars retain="true"><variable name="kept"><type><DINT/></type></variable></localVars>
          <localVars>
            <variable name="m"><type><derived name="Mode"/></type></variable>
            <variable name="p"><type><derived name="Pair"/></type>
              <initialValue><structValue><value member="b"><arrayValue>
                <value repetitionValue="3"><simpleValue value="1.5"/></value></arrayValue></value></structValue>
              </initialValue></variable>
            <variable name="s"><type><string length="5"/></type></variable>
            <variable name="t"><type><derived name="TON"/></type></variable>
          </localVars>
        </interface>
        <body>
          <ST>
            <xhtml:p>
IF go AND m &lt;&gt; busy THEN
  m := busy;
END_IF
t(IN := go, PT := T#10ms);
n := Twice(p.a) + REAL_TO_INT(p.b[2] * 2.0);
kept := kept + 1;
            </xhtml:p>
          </ST>
        </body>
      </pou>
    </pous>
  </types>
  <instances><configurations/></instances>
</project>
"""


def test_an_export_runs() -> None:
    assert is_plcopen("\ufeff\n <project/>")
    assert not is_plcopen("PROGRAM p END_PROGRAM")
    made = program(convert(EXPORT).text)
    made.go = True  # type: ignore[attr-defined]
    for number in (1, 2, 3):
        scan(made, number)
    assert (made.n, made.m, made.kept) == (9, 4, 3)  # type: ignore[attr-defined]
    assert made.retained() == {"kept": 3}
    assert made.st_body.v_t.Q


def test_errors_name_lines_of_the_export(tmp_path: Path) -> None:
    path = tmp_path / "plant.xml"
    path.write_text(EXPORT.replace("kept := kept + 1;", "kept := kept + s;"))
    with pytest.raises(FileInvalid, match=r"plant\.xml:42:\d+: operands of \+"):
        load_source(path)


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (("<ST>", "<LD>"), "not XML"),
        (("<body><ST><xhtml:p><![CDATA[Twice := x * 2;]]></xhtml:p></ST></body>", ""), "POU Twice has no body"),
        (('pouType="program"', 'pouType="class"'), "a POU of unknown kind"),
        (('<project xmlns', '<!DOCTYPE x [<!ENTITY e "e">]><project xmlns'), "document type"),
        (('name="kept"', 'name="a b"'), "without a usable name"),
    ],
)  # fmt: skip
def test_a_file_that_is_not_an_export_of_structured_text_is_refused(change: tuple[str, str], told: str) -> None:
    with pytest.raises(FileInvalid) as e:
        convert(EXPORT.replace(*change), "plant.xml")
    assert told in str(e.value)
    assert e.value.line > 0
