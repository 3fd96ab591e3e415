"""Studio shows the gateway's present values, although it asks the gateway only for changes and texts."""

from __future__ import annotations

import asyncio
import json
import shutil
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest
from test_plc_load import Asked, eventually, relay
from test_writing import process

from fieldtwin.gateway.core.clock import NS_PER_S
from fieldtwin.gateway.core.control import ControlClient
from fieldtwin.gateway.core.image.image import INPUTS, RegionReader, RegionWriter
from fieldtwin.gateway.core.values import NEVER, Quality, Reason, TagValue
from fieldtwin.gateway.runtime.gateway_status import GatewayStatus
from fieldtwin.gateway.wallclock import WallClock
from fieldtwin.run.processes.run_record import FILE, SYSTEM_FILE, read_record
from fieldtwin.studio.live.attachment import Attachment
from fieldtwin.studio.live.instances import GATEWAY_SOCKET, FoundInstance
from fieldtwin.studio.live.present_tags import PresentTags
from fieldtwin.studio.live.process_image import CONFIG
from fieldtwin.studio.live.tag_history import Point, TagHistory
from fieldtwin.twin.plant.physical import image_layout
from fieldtwin.twin.site.system import load_system

TAG, TEXT, NAMED = "inclinometer.slope_long", "ctd.serial", "ctd.status"
CHANGING = ("inclinometer.slope_long", "inclinometer.slope_lateral")


class Site:
    """The observatory's tags with a process image, which the test publishes in place of the gateway."""

    def __init__(self) -> None:
        system = load_system("observatory")
        layout = image_layout(system)
        memory = memoryview(bytearray(layout.size))
        layout.format(memory)
        self.image = layout.attach(memory)
        self.writer: RegionWriter = self.image.writer(INPUTS)
        self.reader: RegionReader = self.image.reader(INPUTS)
        self.history = TagHistory(
            [TAG, TEXT, NAMED, *(f"{d.name}.{t}" for d in system.devices.values() for t in d.profile.tags)]
        )
        self.present = PresentTags(system, {"ctd.sample_count"}, self.history)

    def publish(self, t_ns: int, **values: TagValue) -> None:
        """Publish all tags at `t_ns`. Tags without a value in `values` (by name, "__" for the dot) were never read."""
        named = {name.replace("__", "."): value for name, value in values.items()}
        self.writer.publish([named.get(tag, NEVER) for tag in self.writer.shape.index], t_ns)

    def seen(self, tag: str, now_ns: int = 10 * NS_PER_S) -> tuple[object, str, str, float | None]:
        status = self.present.statuses(self.reader.snapshot(), now_ns)[tag]
        return status.value, status.quality, status.reason, status.age_s


@pytest.fixture
def site() -> Iterator[Site]:
    made = Site()
    yield made
    made.image.release()


def good(value: float, t_s: int) -> TagValue:
    return TagValue(value, Quality.GOOD, Reason.NONE, t_s * NS_PER_S)


def test_a_number_has_its_age_and_the_name_that_the_profile_gives_to_it(site: Site) -> None:
    assert site.seen(TAG) == (None, "bad", "never read", None)
    site.publish(
        5 * NS_PER_S, inclinometer__slope_long=good(1.5, 4), ctd__status=good(1, 5), ctd__sample_count=good(7, 5)
    )
    assert site.seen(TAG) == (1.5, "good", "none", 6.0)
    statuses = site.present.statuses(site.reader.snapshot(), 0)
    assert statuses[NAMED].text == dict(load_system("observatory").devices["ctd"].profile.tags["status"].values)[1]
    assert statuses["ctd.sample_count"].value != 7, "the value of a secret is masked"


def test_a_change_counts_if_it_is_newer_than_the_publication(site: Site) -> None:
    site.publish(5 * NS_PER_S, inclinometer__slope_long=good(1.5, 4))
    site.history.add(TAG, Point(4 * NS_PER_S, 1.25, "good", "none"))
    assert site.seen(TAG)[0] == 1.5
    site.history.add(TAG, Point(6 * NS_PER_S, 2.5, "good", "none"))
    assert site.seen(TAG) == (2.5, "good", "none", 4.0)
    site.history.add(TAG, Point(7 * NS_PER_S, 2.5, "bad", "timeout"))
    assert site.seen(TAG) == (2.5, "bad", "timeout", 6.0)
    assert not [point for name, point in site.present.missing(site.reader.snapshot()) if name == TAG]


def test_a_value_that_becomes_stale_and_a_lost_change_are_added_to_the_history_once(site: Site) -> None:
    def add_missing() -> list[Point]:
        found = site.present.missing(site.reader.snapshot())
        for name, point in found:
            site.history.add(name, point)
        return [point for name, point in found if name == TAG]

    site.history.add(TAG, Point(3 * NS_PER_S, 1.5, "good", "none"))
    site.publish(5 * NS_PER_S, inclinometer__slope_long=good(1.5, 4))
    assert add_missing() == []
    stale = TagValue(1.5, Quality.BAD, Reason.STALE, 4 * NS_PER_S)
    site.publish(6 * NS_PER_S, inclinometer__slope_long=stale)
    assert add_missing() == [Point(6 * NS_PER_S, 1.5, "bad", "stale")]
    assert add_missing() == []
    site.publish(
        7 * NS_PER_S, inclinometer__slope_long=good(3.5, 7)
    )  # no change was reported: the gateway had dropped it
    assert add_missing() == [Point(7 * NS_PER_S, 3.5, "good", "none")]


def test_a_text_comes_from_the_gateway(site: Site) -> None:
    assert site.present.texts == [TEXT]
    assert site.seen(TEXT) == (None, "bad", "never read", None)
    site.present.take_texts({TEXT: ("0042", "good", "none", 2 * NS_PER_S)}, 5 * NS_PER_S)
    assert site.seen(TEXT) == ("0042", "good", "none", 8.0)
    site.history.add(TEXT, Point(6 * NS_PER_S, "0043", "good", "none"))
    assert site.seen(TEXT)[0] == "0043"


def names(asked: Asked) -> set[str]:
    """Return the lists of tags whose values Studio has asked for."""
    return {json.dumps(args["names"]) for command, args in asked.requests if command == "watch"}


@pytest.mark.long
@pytest.mark.timeout(180)
def test_studio_shows_what_the_gateway_has_without_asking_for_all_tags(
    tmp_path_factory: pytest.TempPathFactory,
) -> None:
    root: Path = tmp_path_factory.mktemp("h")
    run_dir, observed_dir = root / "run" / "observatory", root / "o"

    async def main() -> None:
        observed_dir.mkdir()
        for name in (FILE, SYSTEM_FILE, CONFIG):
            shutil.copy(run_dir / name, observed_dir / name)
        asked, record = Asked(), read_record(run_dir)
        gateway = await ControlClient.connect_unix(run_dir / GATEWAY_SOCKET)
        async with (
            relay(observed_dir / GATEWAY_SOCKET, run_dir / GATEWAY_SOCKET, asked),
            Attachment(FoundInstance("observatory", observed_dir, True, record), WallClock()) as studio,
        ):
            await eventually(lambda: studio.gateway is not None, "the gateway answers", 60)
            for name in (await gateway.ask("get", GatewayStatus)).tags:
                for _ in range(600):
                    want = (await gateway.ask("get", GatewayStatus)).tags[name]
                    seen = studio.gateway.tags[name] if studio.gateway is not None else None
                    fields = ("quality", "reason") if name in CHANGING else ("quality", "reason", "value", "text")
                    if seen is not None and all(getattr(seen, f) == getattr(want, f) for f in fields):
                        break
                    await asyncio.sleep(0.1)
                else:
                    pytest.fail(f"{name}: Studio shows {seen}, and the gateway has {want}")
            await eventually(lambda: names(asked) == {"[]", json.dumps([TEXT])}, "only texts are asked for", 60)
            all_tags = list((await gateway.ask("get", GatewayStatus)).tags)
            await eventually(
                lambda: studio.gateway is not None and list(studio.gateway.tags) == all_tags, "all tags", 60
            )
            assert (await gateway.ask("get", GatewayStatus, brief=True)).tags == {}
        await gateway.aclose()
        assert all(args["brief"] is True for args in asked.statuses)

    with process("run", "observatory", "--prototype", "--log", "text", root=root, ready="started"):
        asyncio.run(main())


PROFILE = """device: fieldtwin/pump
source: "made for this test"
protocol: modbus
numbering: sent
tags:
  mode: {{at: "holding:0", poll: fast, values: {{1: {name}}}}}
"""
SYSTEM = """fieldtwin: 1
system: pump
buses: {lan: {url: "tcp://192.0.2.1:502"}}
devices: {p: {profile: pump_profile.yaml, bus: lan, unit: 1, poll: {fast: {every_ms: 100}}}}
"""
PROTOTYPE = """prototype_of: pump.yaml
buses: {lan: {listen: "tcp://127.0.0.1:0"}}
devices: {p: {model: profile, values: {mode: 1}}}
"""


@pytest.mark.long
@pytest.mark.timeout(180)
def test_studio_follows_a_reload_and_a_gateway_that_is_started_again(tmp_path_factory: pytest.TempPathFactory) -> None:
    root: Path = tmp_path_factory.mktemp("h")
    run_dir, observed_dir = root / "run" / "pump", root / "o"
    (root / "pump_profile.yaml").write_text(PROFILE.format(name="idle"))
    (root / "pump.yaml").write_text(SYSTEM)
    (root / "pump.prototype.yaml").write_text(PROTOTYPE)
    start = ("run", "pump.yaml", "--prototype", "--log", "text")

    async def main(running: ExitStack) -> None:
        observed_dir.mkdir()
        for name in (SYSTEM_FILE, GATEWAY_SOCKET):
            (observed_dir / name).symlink_to(run_dir / name)
        shutil.copy(run_dir / CONFIG, observed_dir / CONFIG)
        record = read_record(
            run_dir
        )  # the directory that Studio observes has no record, which would tell it of another run
        async with Attachment(FoundInstance("pump", observed_dir, True, record), WallClock()) as studio:

            def text() -> object:
                return studio.gateway.tags["p.mode"].text if studio.gateway is not None else None

            await eventually(lambda: text() == "idle", "the value has its name", 60)
            (root / "pump_profile.yaml").write_text(PROFILE.format(name="ready"))
            gateway = await ControlClient.connect_unix(run_dir / GATEWAY_SOCKET)
            assert (await gateway.call("reload"))["applied"] is True
            await gateway.aclose()
            await eventually(lambda: text() == "ready", "the value has its new name", 60)
            await asyncio.to_thread(running.close)
            await eventually(lambda: studio.gateway is None, "the gateway has ended", 60)
            stopped_ns = studio.now_ns()
            await asyncio.to_thread(running.enter_context, process(*start, root=root, ready="started"))
            await eventually(lambda: text() == "ready", "the next gateway answers", 60)
            await eventually(
                lambda: studio.history.changes("p.mode", stopped_ns, studio.now_ns()), "its changes are read", 60
            )
            points, _ = studio.history.between("p.mode", 0, studio.now_ns())
            assert [point.t_ns for point in points] == sorted(point.t_ns for point in points)
            assert studio.changes_lost == 0

    with ExitStack() as running:
        running.enter_context(process(*start, root=root, ready="started"))
        asyncio.run(main(running))
