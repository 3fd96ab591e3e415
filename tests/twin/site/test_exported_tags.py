"""The `metrics` section of a system file: the tags that its patterns export, and its errors with their places."""

from __future__ import annotations

from pathlib import Path

import pytest

from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.twin.plant.reloading import compare
from fieldtwin.twin.site.exported_tags import MOST_TAGS, ExportedTag
from fieldtwin.twin.site.system import System, load_system

PROFILE = """\
device: test/tank
protocol: modbus
source: made up
defaults: {poll: values}
tags:
  level:  {at: "input:0", type: float32, unit: m}
  volume: {at: "input:2", scale: 0.5, unit: m3}
  full:   {at: "discrete:0"}
  dose:   {at: "holding:35", scale: 0.1, access: wo}
  code:   {at: "holding:30", access: rw, secret: true}
  serial: {at: "holding:40", type: string, registers: 4}
"""
SYSTEM = """\
fieldtwin: 1
system: plant
buses: {line: {url: "tcp://192.0.2.1:502"}}
devices:
  tank:  {profile: tank.yaml, bus: line, unit: 1, poll: {values: {every_ms: 1000}}}
  tank2: {profile: tank.yaml, bus: line, unit: 2, poll: {values: {every_ms: 1000}}}
"""


def loaded(folder: Path, patterns: str, profile: str = PROFILE, system: str = SYSTEM) -> System:
    (folder / "tank.yaml").write_text(profile, encoding="utf-8")
    (folder / "plant.yaml").write_text(f"{system}metrics: {{tags: {patterns}}}\n", encoding="utf-8")
    return load_system(str(folder / "plant.yaml"))


def names(folder: Path, patterns: str) -> list[str]:
    return [tag.name for tag in loaded(folder, patterns).exported_tags]


def test_a_pattern_exports_the_tags_with_a_number_and_a_unit(tmp_path: Path) -> None:
    assert loaded(tmp_path, '["tank.*"]').exported_tags == (
        ExportedTag("tank", "level", "m"), ExportedTag("tank", "volume", "m3"), ExportedTag("tank", "full", ""),
    )  # fmt: skip


def test_patterns_are_joined_in_their_order_and_a_tag_occurs_once(tmp_path: Path) -> None:
    assert names(tmp_path, '[tank2.volume, "tank?.level", "*.level"]') == [
        "tank2.volume", "tank2.level", "tank.level",
    ]  # fmt: skip


def test_without_the_section_nothing_is_exported(tmp_path: Path) -> None:
    loaded(tmp_path, "[tank.level]")
    (tmp_path / "plant.yaml").write_text(SYSTEM, encoding="utf-8")
    assert load_system(str(tmp_path / "plant.yaml")).exported_tags == ()


@pytest.mark.parametrize(
    ("patterns", "column", "says"),
    [
        ("[tonk.level]", 18, "no device 'tonk'"),
        ("[tank.levle]", 18, "'tank' has no tag 'levle'"),
        ("[tank.level, tank.code]", 30, "'tank.code' is secret"),
        ("[tank.serial]", 18, "'tank.serial' is text, and a metric is a number"),
        ("[tank.dose]", 18, "'tank.dose' cannot be read"),
        ('["*.pressure"]', 18, r"'\*\.pressure' matches no tag"),
        ('["*.co*"]', 18, r"'\*\.co\*' matches no tag that can be exported: tank\.code is secret"),
        ("[tank]", 18, "metrics.tags.0"),
        ("[]", 11, "metrics.tags is empty"),
    ],
)
def test_an_invalid_pattern_is_an_error_with_its_place(tmp_path: Path, patterns: str, column: int, says: str) -> None:
    with pytest.raises(FileInvalid, match=rf"plant\.yaml:7:{column}: .*{says}"):
        loaded(tmp_path, patterns)


def test_the_nearest_tag_is_suggested(tmp_path: Path) -> None:
    with pytest.raises(FileInvalid, match=r"did you mean 'tank\.level'\?"):
        loaded(tmp_path, '["tank.lev?"]')


def test_more_tags_than_the_limit_are_an_error(tmp_path: Path) -> None:
    tags = "".join(f'  t{n}: {{at: "input:{100 + n}"}}\n' for n in range(MOST_TAGS // 2 - 2))
    assert len(loaded(tmp_path, '["*.t*", "tank.level", "tank2.level"]', PROFILE + tags).exported_tags) == MOST_TAGS - 2
    with pytest.raises(FileInvalid, match=r"plant\.yaml:7:26: .*match 1,002 tags.*at most 1,000"):
        loaded(tmp_path, '["*.t*", "*.*"]', PROFILE + tags)


def test_a_pattern_is_not_judged_while_a_device_that_it_may_match_has_an_error(tmp_path: Path) -> None:
    with pytest.raises(FileInvalid) as caught:
        loaded(tmp_path, '["tank2.level", "tank2.*"]', system=SYSTEM.replace("line, unit: 2", "lane, unit: 2"))
    assert "lane" in str(caught.value)
    assert caught.value.others == ()


def test_a_tag_that_becomes_secret_needs_a_restart(tmp_path: Path) -> None:
    before = loaded(tmp_path, '["tank.*"]')
    secret = PROFILE.replace("scale: 0.5, unit: m3", "scale: 0.5, unit: m3, secret: true")
    changes = compare(before, loaded(tmp_path, '["tank.*"]', secret))
    assert [(c.what, c.live) for c in changes if not c.live] == [("metrics", False)]
    changes = compare(before, loaded(tmp_path, '["tank.level"]'))
    assert [c.live for c in changes] == [False]


def test_a_text_without_a_device_names_the_form(tmp_path: Path) -> None:
    with pytest.raises(FileInvalid) as error:
        loaded(tmp_path, "[level]")
    assert "metrics.tags.0 does not have the required form; expected text such as meter.*; got 'level'" in str(
        error.value
    )
