"""`fieldtwin explain`: every ID, code and word that fieldtwin prints has an explanation, and its usual spellings find it."""

from __future__ import annotations

import json
from collections.abc import Iterator

import pytest
from click.testing import CliRunner

from fieldtwin.cli.main import cli
from fieldtwin.commissioning.identify.matching import Sureness
from fieldtwin.commissioning.infer.fields import Level
from fieldtwin.conformance.clients.canopen.cases import CASES as CANOPEN_CLIENTS
from fieldtwin.conformance.clients.modbus.cases import CASES as MODBUS_CLIENTS
from fieldtwin.conformance.devices.canopen.cases import CASES as CANOPEN_DEVICES
from fieldtwin.conformance.devices.modbus.cases import CASES as MODBUS_DEVICES
from fieldtwin.emulators.faults.registry import FAULTS
from fieldtwin.explain.cases import spelled_out
from fieldtwin.explain.lookup import everything, explain
from fieldtwin.gateway.core.errors import FieldtwinError, ModbusExceptionReply, UsageError
from fieldtwin.gateway.core.values import Quality, Reason
from fieldtwin.gateway.protocols.canopen.sdo.abort_codes import MEANINGS
from fieldtwin.results.model import Verdict


def kinds_of_errors(base: type[FieldtwinError] = FieldtwinError) -> Iterator[type[FieldtwinError]]:
    for kind in base.__subclasses__():
        if kind.__module__ == FieldtwinError.__module__:
            yield kind
            yield from kinds_of_errors(kind)


PRINTED = {
    "Modbus exceptions": [f"exception {code:02X}" for code in ModbusExceptionReply.NAMES],
    "SDO abort codes": [f"{code:08X}h" for code in MEANINGS],
    "qualities": [str(quality) for quality in Quality],
    "reasons": [str(reason) for reason in Reason if reason is not Reason.NONE],
    "errors": sorted({kind.__name__ for kind in kinds_of_errors()}),
    "exit codes": [f"exit {code}" for code in (0, 1, 2, 3, 4, 5, 70, 130)],
    "faults": list(FAULTS),
    "certainties": [*map(str, Sureness), *map(str, Level), "fidelity"],
    "verdicts": [*(verdict.name for verdict in Verdict), "robustness", "field problem"],
    "cases": [
        *(case.id for cases in (MODBUS_DEVICES, CANOPEN_DEVICES) for case in cases),
        *(case.about.id for case in MODBUS_CLIENTS),
        *(case.about.id for case in CANOPEN_CLIENTS),
    ],
}


@pytest.mark.parametrize("what", PRINTED)
def test_everything_that_is_printed_has_an_explanation(what: str) -> None:
    for word in PRINTED[what]:
        found = explain(word)
        assert word.lower() in {spelling for entry in found for spelling in entry.words}
        for entry in found:
            assert entry.meaning.endswith("."), word
            assert entry.todo.endswith((".", "?")), word
            assert entry.source, word


@pytest.mark.parametrize(
    ("words", "id"),
    [
        ("exception 02h", "exception 02"),
        ("Exception 0x0B", "exception 0B"),
        ("illegal data address", "exception 02"),
        ("0x6020000", "abort 06020000"),
        ("abort 06020000h", "abort 06020000"),
        ("mb-8a", "MB-008a"),
        ("not sampling", "not_sampling"),
        ("wrong-device", "wrong_device"),
        ("crcerror", "CrcError"),
        ("exit code 4", "exit 4"),
    ],
)
def test_usual_spellings_are_understood(words: str, id: str) -> None:
    assert [entry.id for entry in explain(words)] == [id]


def test_a_number_of_a_case_finds_all_its_parts() -> None:
    assert {entry.id for entry in explain("MB-015")} == {"MB-015a", "MB-015b"}


def test_an_unknown_word_is_an_error_with_similar_words() -> None:
    with pytest.raises(UsageError, match=r"similar: .*late-reply"):
        explain("late-replly")


def test_sources_name_their_standards() -> None:
    assert spelled_out("SL 2.4.1; libmodbus PR #860; TCP: TG 4.4.1.3; libmodbus PR #860") == (
        "Modbus over Serial Line V1.02, 2.4.1; libmodbus PR #860; TCP: Modbus Messaging on TCP/IP V1.0b, 4.4.1.3"
    )
    assert spelled_out("7.2.4; CN #205") == "CiA 301, 7.2.4; CANopenNode #205"


def test_the_command_prints_meaning_action_and_source() -> None:
    done = CliRunner().invoke(cli, ["explain", "exception", "02"], standalone_mode=False, catch_exceptions=False)
    text = " ".join(done.stdout.split())
    assert text.startswith(
        "exception 02 Modbus exception: illegal data address At least one of the requested registers"
    )
    assert "What to do: " in text
    assert text.endswith("Source: Modbus Application Protocol V1.1b3, clause 7")


def test_without_a_word_all_are_listed_and_json_has_the_same() -> None:
    listed = CliRunner().invoke(cli, ["explain"], standalone_mode=False, catch_exceptions=False).stdout
    data = json.loads(
        CliRunner().invoke(cli, ["explain", "--json"], standalone_mode=False, catch_exceptions=False).stdout
    )
    assert len(data) == len(everything())
    assert all(entry["id"] in listed for entry in data)
    assert {"id", "kind", "title", "meaning", "todo", "source", "also", "page"} == set(data[0])


def test_a_case_that_the_standard_requires_on_one_transport_says_so() -> None:
    [entry] = [entry for entry in everything() if entry.id == "MB-013"]
    assert "No clause requires it" in entry.meaning
    assert "On TCP: The standard requires it: a failure is a deviation." in entry.meaning


def test_no_entry_lists_a_spelling_twice() -> None:
    for entry in everything():
        assert len({entry.id, *entry.also}) == 1 + len(entry.also), entry
