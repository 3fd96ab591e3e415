"""The samples that follow from publications of a real process image: value, status, source time; loss of the writer; texts."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldtwin.gateway.core.image.image import Image, ImageLayout, RegionFlag, RegionLayout, TagKind, TagSpec
from fieldtwin.gateway.core.values import Quality, Reason, TagValue
from fieldtwin.northbound.samples import ImageSamples, Sample, TextSamples

MS = 1_000_000
LOST_NS = 1000 * MS
GOOD = (Quality.GOOD, Reason.NONE)
Publish = Callable[..., None]


@pytest.fixture
def image() -> Image:
    layout = ImageLayout((RegionLayout("inputs", (TagSpec("a.x", TagKind.REAL), TagSpec("a.n", TagKind.INT))),))
    memory = memoryview(bytearray(layout.size))
    layout.format(memory)
    return layout.attach(memory)


class Setup:
    """A writer of the image, and the samples of its tag ``a.x``."""

    def __init__(self, image: Image) -> None:
        self.writer, self.reader = image.writer("inputs"), image.reader("inputs")
        self.samples = ImageSamples(["a.x"], LOST_NS, Reason.GATEWAY_DEAD)

    def after(self, value: TagValue, t_ns: int, flags: RegionFlag = RegionFlag.NONE) -> list[Sample]:
        """Publish at `t_ns`, and return the new samples."""
        self.writer.publish([value, TagValue(1, Quality.GOOD, t_ns=t_ns)], t_ns, flags=flags)
        return self.at(t_ns)

    def at(self, now_ns: int) -> list[Sample]:
        return [sample for _, sample in self.samples.changes(self.reader.snapshot(), now_ns)]


def good(value: float, t_ns: int) -> TagValue:
    return TagValue(value, Quality.GOOD, t_ns=t_ns)


def bad(value: float | None, reason: Reason, t_ns: int) -> TagValue:
    return TagValue(value, Quality.BAD, reason, t_ns)


def test_nothing_is_known_before_the_first_publication(image: Image) -> None:
    assert Setup(image).at(5 * MS) == []


def test_a_good_value_has_the_time_of_its_reply(image: Image) -> None:
    setup = Setup(image)
    assert setup.after(good(1.5, 90 * MS), 100 * MS) == [Sample(1.5, *GOOD, 90 * MS)]
    assert setup.after(good(1.5, 90 * MS), 110 * MS) == []
    assert setup.after(good(1.5, 190 * MS), 200 * MS) == [Sample(1.5, *GOOD, 190 * MS)]


def test_a_value_that_turns_bad_has_the_time_at_which_that_was_published(image: Image) -> None:
    setup = Setup(image)
    setup.after(good(1.5, 90 * MS), 100 * MS)
    assert setup.after(bad(1.5, Reason.TIMEOUT, 90 * MS), 300 * MS) == [
        Sample(None, Quality.BAD, Reason.TIMEOUT, 300 * MS)
    ]
    assert setup.after(bad(1.5, Reason.TIMEOUT, 90 * MS), 310 * MS) == []
    assert setup.after(bad(1.5, Reason.REFUSED, 90 * MS), 400 * MS) == [
        Sample(None, Quality.BAD, Reason.REFUSED, 400 * MS)
    ]
    assert setup.after(good(2.5, 490 * MS), 500 * MS) == [Sample(2.5, *GOOD, 490 * MS)]


def test_values_are_bad_when_the_writer_dies_and_good_when_it_is_back(image: Image) -> None:
    setup = Setup(image)
    setup.after(good(1.5, 90 * MS), 100 * MS)
    assert setup.at(100 * MS + LOST_NS) == []
    assert setup.at(101 * MS + LOST_NS) == [Sample(None, Quality.BAD, Reason.GATEWAY_DEAD, 100 * MS + LOST_NS)]
    assert setup.at(500 * MS + LOST_NS) == []
    back = 600 * MS + LOST_NS
    assert setup.after(good(1.5, back), back) == [Sample(1.5, *GOOD, back)]


def test_values_are_out_of_service_while_the_writer_has_stopped_intentionally(image: Image) -> None:
    setup = Setup(image)
    setup.after(good(1.5, 90 * MS), 100 * MS)
    assert setup.after(good(1.5, 90 * MS), 200 * MS, RegionFlag.STOPPED) == [
        Sample(None, Quality.BAD, Reason.NOT_OPERATIONAL, 200 * MS)
    ]


VALUES = st.builds(
    TagValue,
    st.none() | st.floats(allow_nan=False),
    st.sampled_from(Quality),
    st.sampled_from(Reason),
    st.integers(0, 50),
)


@given(st.lists(VALUES, max_size=20))
def test_the_latest_sample_always_equals_the_image_and_times_of_bad_values_never_go_back(
    values: list[TagValue],
) -> None:
    layout = ImageLayout((RegionLayout("inputs", (TagSpec("a.x", TagKind.REAL), TagSpec("a.n", TagKind.INT))),))
    memory = memoryview(bytearray(layout.size))
    layout.format(memory)
    with layout.attach(memory) as image:
        setup, latest = Setup(image), None
        for n, value in enumerate(values):
            if value.quality is Quality.GOOD and value.value is None:
                continue
            before = latest
            now_ns = 100 + n
            latest = (setup.after(value, now_ns) or [latest])[-1]
            assert latest is not None
            assert (latest.quality, latest.reason) == (value.quality, value.reason)
            assert latest.value == (None if value.quality is Quality.BAD else value.value)
            if value.quality is Quality.GOOD:
                assert latest.source_ns == value.t_ns
            elif before is not None and before[1:3] == latest[1:3]:
                assert latest.source_ns >= before.source_ns
            elif value.quality is Quality.BAD:
                assert latest.source_ns == now_ns


def test_texts_follow_the_gateways_answers_and_are_bad_without_it() -> None:
    texts = TextSamples(["a.name", "a.raw"], ["a.raw"])
    answer: dict[str, Any] = {"a.name": ["SN-1", "good", "none", 5], "a.raw": ["00ff", "good", "none", 6]}
    assert dict(texts.changes(answer, 9)) == {
        "a.name": Sample("SN-1", *GOOD, 5),
        "a.raw": Sample(b"\x00\xff", *GOOD, 6),
    }
    assert dict(texts.changes(answer, 19)) == {}
    assert dict(texts.lost(29)) == {
        "a.name": Sample(None, Quality.BAD, Reason.GATEWAY_DEAD, 29),
        "a.raw": Sample(None, Quality.BAD, Reason.GATEWAY_DEAD, 29),
    }
    assert dict(texts.lost(39)) == {}
    assert dict(texts.changes(answer, 49))["a.name"] == Sample("SN-1", *GOOD, 5)
