"""The virtual context: the paper's Emulator, and the rulings on order, bounds and the end of a recording."""

from __future__ import annotations

import sys
from collections.abc import Sequence

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldtwin.emulators.context import RELEASE_AT, EndOfRecording, Recorded, UsedUp, VirtualContext
from fieldtwin.gateway.core.errors import Bug, FileInvalid, UnknownCommand
from fieldtwin.gateway.core.values import COMMAND, RECORDING, RESPONSE

A, B = COMMAND(b"a"), COMMAND(b"b")


def recorded(number: int) -> Recorded:
    return Recorded(float(number), RECORDING(bytes([number])), number / 1000)


def context(numbers: Sequence[int], policy: EndOfRecording = EndOfRecording.HOLD) -> VirtualContext:
    return VirtualContext([A, B], [(A, recorded(n)) for n in numbers], when_used_up=policy)


def taken(subject: VirtualContext, command: COMMAND, times: int) -> list[int]:
    return [subject.take(command).data[0] for _ in range(times)]


def test_a_command_takes_a_recording_of_the_context_and_removes_it() -> None:
    subject = context([1, 2, 2])
    assert len(subject) == 3
    result = subject.take(A)
    assert isinstance(result, RESPONSE)
    assert result == RECORDING(b"\x01")
    assert (len(subject), subject.left(A), subject.taken) == (2, 2, 1)


def test_the_command_must_be_in_the_list() -> None:
    subject = context([1])
    assert subject.command_list == (A, B)
    with pytest.raises(UnknownCommand, match="63"):
        subject.take(COMMAND(b"c"))
    with pytest.raises(UnknownCommand):
        subject.add(COMMAND(b"c"), recorded(1))
    assert len(subject) == 1


def test_without_a_list_it_is_derived_from_the_recording() -> None:
    subject = VirtualContext(recordings=[(B, recorded(1)), (A, recorded(2)), (B, recorded(3))])
    assert subject.command_list == (B, A)
    assert (taken(subject, B, 2), taken(subject, A, 1), len(subject)) == ([1, 3], [2], 0)


@given(st.lists(st.tuples(st.sampled_from([A, B]), st.integers(0, 255))))
def test_order_is_kept_and_duplicates_survive(entries: list[tuple[COMMAND, int]]) -> None:
    subject = VirtualContext([A, B], [(command, recorded(n)) for command, n in entries])
    for command in (A, B):
        expected = [n for c, n in entries if c == command]
        assert taken(subject, command, len(expected)) == expected
    assert len(subject) == 0


def test_time_and_latency_come_along() -> None:
    assert context([7]).take_recorded(A) == Recorded(7.0, RECORDING(b"\x07"), 0.007)


def test_used_up_it_holds_loops_or_is_an_error() -> None:
    assert taken(context([1, 2], EndOfRecording.HOLD), A, 5) == [1, 2, 2, 2, 2]
    assert taken(context([1, 2], EndOfRecording.LOOP), A, 5) == [1, 2, 1, 2, 1]
    error = context([1, 2], EndOfRecording.ERROR)
    assert taken(error, A, 2) == [1, 2]
    with pytest.raises(UsedUp):
        error.take(A)


@pytest.mark.parametrize("policy", EndOfRecording)
def test_a_command_without_any_recording_has_nothing_to_hold(policy: EndOfRecording) -> None:
    with pytest.raises(UsedUp):
        context([1], policy).take(B)


def test_a_single_command_may_have_another_policy() -> None:
    subject = context([1, 2], EndOfRecording.LOOP)
    subject.add(B, recorded(9))
    subject.set_policies({B.data: EndOfRecording.HOLD})
    assert (taken(subject, A, 3), taken(subject, B, 3)) == ([1, 2, 1], [9, 9, 9])


def test_a_full_context_drops_its_oldest_and_counts_it() -> None:
    subject = VirtualContext([A, B], max_entries=3)
    for number, command in enumerate((A, B, A, A, B)):
        subject.add(command, recorded(number))
    assert (len(subject), subject.dropped) == (3, 2)
    assert (taken(subject, A, 2), taken(subject, B, 1)) == ([2, 3], [4])


@given(st.lists(st.sampled_from(["add a", "add b", "take a", "take b"]), max_size=60), st.sampled_from(EndOfRecording))
def test_it_never_holds_more_than_its_bound(steps: list[str], policy: EndOfRecording) -> None:
    subject = VirtualContext([A, B], when_used_up=policy, max_entries=4)
    model: dict[str, list[int]] = {"a": [], "b": []}
    for number, step in enumerate(steps):
        command, name = step.split()
        command = COMMAND(name.encode())
        if command == "add":
            subject.add(command, recorded(number))
            model[name].append(number)
            assert len(subject) <= 4
        elif subject.left(command):
            got = subject.take(command).data[0]
            assert got in model[name]
        assert len(subject) == subject.left(A) + subject.left(B)


def test_endlessly_many_different_commands_are_refused() -> None:
    subject = VirtualContext(max_entries=2)
    for number in range(2):
        subject.add(COMMAND(bytes([number])), recorded(number))
    with pytest.raises(FileInvalid, match="too many"):
        subject.add(COMMAND(b"\x02"), recorded(2))


@pytest.mark.parametrize("policy", EndOfRecording)
def test_copies_begin_at_the_first_start_and_are_independent(policy: EndOfRecording) -> None:
    first = VirtualContext([A, B], [(A, recorded(1)), (B, recorded(9)), (A, recorded(2))], when_used_up=policy)
    second, third = first.copy(), first.copy().copy()
    assert taken(second, A, 2) == [1, 2]
    assert (len(first), len(second), len(third)) == (3, 1, 3)
    assert second.command_list == third.command_list == (A, B)
    for subject in (first, third):
        assert (taken(subject, A, 2), taken(subject, B, 1), len(subject)) == ([1, 2], [9], 0)
    assert second.left(B) == 1
    if policy is not EndOfRecording.ERROR:
        assert taken(second, A, 2) == ([2, 2] if policy is EndOfRecording.HOLD else [1, 2])
    with pytest.raises(UnknownCommand):
        second.take(COMMAND(b"c"))


def test_shared_series_are_not_extended() -> None:
    first = context([1])
    second = first.copy()
    for subject in (first, second):
        with pytest.raises(Bug, match="cop"):
            subject.add(A, recorded(2))
    second.take(A)
    with pytest.raises(Bug, match="after something was taken"):
        second.copy()


def test_taken_items_of_a_long_recording_are_released() -> None:
    subject = context([n % 256 for n in range(3 * RELEASE_AT)])
    before = sys.getsizeof(subject._series[A.data].recorded)
    assert taken(subject, A, 3 * RELEASE_AT - 1) == [n % 256 for n in range(3 * RELEASE_AT - 1)]
    assert subject.left(A) == 1
    assert sys.getsizeof(subject._series[A.data].recorded) < before / 2
