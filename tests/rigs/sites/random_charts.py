"""Random sequential function charts."""

from __future__ import annotations

from collections.abc import Sequence

from hypothesis import strategies as st


def random_charts() -> st.SearchStrategy[tuple[list[str], list[tuple[list[str], list[str]]]]]:
    """Return random safe charts: a step is replaced by a sequence, an alternative or a simultaneous branch, several times."""

    def built(choices: list[tuple[int, int]]) -> tuple[list[str], list[tuple[list[str], list[str]]]]:
        steps, moves = ["s0", "s1"], [(["s0"], ["s1"]), (["s1"], ["s0"])]
        for kind, place in choices:
            sources, targets = moves.pop(place % len(moves))
            a, b, n = f"s{len(steps)}", f"s{len(steps) + 1}", kind % 3
            if n == 0:  # a sequence
                steps.append(a)
                moves += [(sources, [a]), ([a], targets)]
            elif n == 1:  # an alternative branch
                steps += [a, b]
                moves += [(sources, [a]), ([a], targets), (sources, [b]), ([b], targets)]
            else:  # a simultaneous branch
                steps += [a, b]
                moves += [(sources, [a, b]), ([a, b], targets)]
        return steps, moves

    return st.lists(st.tuples(st.integers(0, 2), st.integers(0, 50)), max_size=6).map(built)


def text_of_chart(steps: Sequence[str], moves: Sequence[tuple[Sequence[str], Sequence[str]]]) -> str:
    """Return a program with a chart. The first step is the initial one. The condition of transition n is bit n of the input c."""
    text = "PROGRAM p VAR_INPUT c : DWORD; END_VAR\n"
    text += "".join(f"{'INITIAL_STEP' if step == steps[0] else 'STEP'} {step}: END_STEP\n" for step in steps)
    for n, (sources, targets) in enumerate(moves):
        text += f"TRANSITION FROM ({', '.join(sources)}) TO ({', '.join(targets)}) := c.{n}; END_TRANSITION\n"
    return text + "END_PROGRAM"
