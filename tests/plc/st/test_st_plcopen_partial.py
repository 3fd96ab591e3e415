"""A PLCopen XML file with parts that are not supported: the other parts are imported."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner

from fieldtwin.cli.plc.check_command import check
from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.plc.program import ScanInfo
from fieldtwin.plc.st.dialects import dialect_of
from fieldtwin.plc.st.program import load_source

HEAD = """<?xml version="1.0" encoding="utf-8"?>
<project xmlns="http://www.plcopen.org/xml/tc6_0201">
<types><dataTypes/><pous>
"""
TAIL = "</pous></types></project>"
OUT = '<interface><outputVars><variable name="n"><type><INT/></type></variable></outputVars></interface>'


def st(text: str) -> str:
    return f'<body><ST><p xmlns="http://www.w3.org/1999/xhtml"><![CDATA[{text}]]></p></ST></body>'


LIST = f"""<pou name="Old" pouType="functionBlock">
{OUT}
<body><IL><p>LD 1</p></IL></body>
</pou>
"""


def saved(folder: Path, text: str) -> Path:
    path = folder / "plant.xml"
    path.write_text(HEAD + text + TAIL)
    return path


def run(path: Path, name: str = "") -> Any:
    made: Any = load_source(path, name)()
    made.execute(ScanInfo(1_000_000, 1, True))
    return made


def test_the_rest_of_a_file_runs_without_the_block_that_is_not_supported(tmp_path: Path) -> None:
    path = saved(tmp_path, f'{LIST}<pou name="Main" pouType="program">{OUT}{st("n := 7;")}</pou>')
    assert run(path).n == 7
    done = CliRunner().invoke(check, [str(path)], standalone_mode=False)
    assert done.return_value == 0
    assert done.output.splitlines() == [
        f"{path}:6:7: not imported: Old has a body in IL, which is not supported",
        "1 file, no errors: 1 program, 1 not imported",
    ]


def test_the_use_of_a_missing_block_is_an_error_that_names_the_reason_and_both_places(tmp_path: Path) -> None:
    interface = OUT.replace(
        "</interface>",
        '<localVars><variable name="x"><type><derived name="Old"/></type></variable></localVars></interface>',
    )
    path = saved(tmp_path, f'{LIST}<pou name="Main" pouType="program">\n{interface}\n{st("x(); n := x.n;")}</pou>')
    with pytest.raises(FileInvalid) as e:
        load_source(path)
    assert (e.value.line, e.value.others) == (9, ())
    assert e.value.message == f"Old has a body in IL, which is not supported ({path}:6)"


def test_a_missing_program_is_named_if_it_is_the_one_to_run(tmp_path: Path) -> None:
    path = saved(
        tmp_path,
        LIST.replace("functionBlock", "program") + f'<pou name="Main" pouType="program">{OUT}{st("n := 7;")}</pou>',
    )
    assert run(path, "Main").n == 7
    with pytest.raises(FileInvalid, match=r"plant\.xml:6:7: Old has a body in IL, which is not supported"):
        load_source(path, "old")
    with pytest.raises(FileInvalid, match="which PROGRAM is meant; expected Main, Old"):
        load_source(path)


def test_a_file_of_structured_text_can_replace_a_missing_block(tmp_path: Path) -> None:
    interface = OUT.replace(
        "</interface>",
        '<localVars><variable name="x"><type><derived name="Old"/></type></variable></localVars></interface>',
    )
    saved(tmp_path, f'{LIST}<pou name="Main" pouType="program">{interface}{st("x(); n := x.n;")}</pou>')
    (tmp_path / "old.st").write_text("FUNCTION_BLOCK Old VAR_OUTPUT n : INT; END_VAR n := 5; END_FUNCTION_BLOCK")
    assert run(tmp_path).n == 5


def test_actions_of_an_export_run_and_those_that_are_not_supported_are_named_at_their_call(tmp_path: Path) -> None:
    down = '<action name="Down"><body><IL/></body></action>'
    actions = f'<actions><action name="Up">\n{st("n := n + 1;")}</action>{down}</actions>'
    pou = '<pou name="Main" pouType="program">' + OUT + actions
    assert run(saved(tmp_path, f"{pou}{st('Up(); Up();')}</pou>")).n == 2
    path = saved(tmp_path, f"{pou}\n{st('Up(); Down();')}</pou>")
    with pytest.raises(FileInvalid) as e:
        load_source(path)
    assert e.value.message == f"action Main.Down has a body in IL, which is not supported ({path}:5)"
    assert e.value.line == 6


def test_a_type_that_is_not_supported_does_not_refuse_the_others(tmp_path: Path) -> None:
    pointer = "<pointer><baseType><INT/></baseType></pointer>"
    types = f'<dataTypes><dataType name="P"><baseType>{pointer}</baseType></dataType></dataTypes>'
    path = saved(tmp_path, f'<pou name="Main" pouType="program">{OUT}{st("n := 7;")}</pou>')
    path.write_text(path.read_text().replace("<dataTypes/>", types))
    path.write_text(path.read_text().replace("pointer>", "strange>"))
    assert run(path).n == 7
    path.write_text(path.read_text().replace("strange>", "pointer>"))
    use = '<localVars><variable name="p"><type><derived name="P"/></type></variable></localVars></interface>'
    path.write_text(path.read_text().replace("</interface>", use))
    with pytest.raises(FileInvalid, match="POINTER TO is not in the standard"):
        load_source(path)
    load_source(path, dialect=dialect_of("codesys"))
    path.write_text(path.read_text().replace("pointer>", "strange>"))
    with pytest.raises(FileInvalid, match="the type strange is not supported"):
        load_source(path, dialect=dialect_of("codesys"))
