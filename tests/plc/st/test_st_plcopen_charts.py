"""Bodies in Sequential Function Chart of PLCopen XML files (TC6 XML 2.01, 6.5.1)."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as some
from st_bench import scan

from fieldtwin.gateway.core.errors import FileInvalid
from fieldtwin.plc.st.compiler.compile import compile_unit
from fieldtwin.plc.st.plcopen.read import read_plcopen
from fieldtwin.plc.st.program import program_class
from fieldtwin.plc.st.syntax import tree as t
from fieldtwin.plc.st.syntax.written import text_of

XHTML = 'xmlns="http://www.w3.org/1999/xhtml"'
INTERFACE = """<interface>
<inputVars><variable name="go"><type><BOOL/></type></variable><variable name="stop"><type><BOOL/></type></variable></inputVars>
<outputVars><variable name="q"><type><BOOL/></type></variable><variable name="n"><type><INT/></type></variable></outputVars>
</interface>"""


def link(*sources: str) -> str:
    return (
        "<connectionPointIn>" + "".join(f'<connection refLocalId="{one}"/>' for one in sources) + "</connectionPointIn>"
    )


def element(tag: str, local: str, *inputs: str, x: int = 0, y: int = 0, inside: str = "", **attributes: str) -> str:
    more = "".join(f' {name}="{value}"' for name, value in attributes.items())
    points = (
        "".join(link(one) for one in inputs) if tag == "simultaneousConvergence" else link(*inputs) if inputs else ""
    )
    return f'<{tag} localId="{local}"{more}><position x="{x}" y="{y}"/>{points}{inside}</{tag}>\n'


def step(local: str, name: str, *inputs: str, x: int = 0, initial: bool = False) -> str:
    start = {"initialStep": "true"} if initial else {}
    return element("step", local, *inputs, x=x, name=name, **start)


def inline(text: str) -> str:
    return f'<condition><inline name=""><ST><p {XHTML}>{text}</p></ST></inline></condition>'


def transition(local: str, *inputs: str, x: int = 0, condition: str = inline("TRUE"), **attributes: str) -> str:
    return element("transition", local, *inputs, x=x, inside=condition, **attributes)


def project(body: str, more: str = "", kind: str = "program") -> str:
    return (
        '<project xmlns="http://www.plcopen.org/xml/tc6_0201"><types><pous>'
        f'<pou name="Main" pouType="{kind}">{INTERFACE}{more}<body><SFC>\n{body}</SFC></body></pou></pous></types></project>'
    )


def chart(body: str, more: str = "") -> t.Chart:
    (pou,) = read_plcopen(project(body, more), "main.xml").pous
    assert pou.chart is not None
    return pou.chart


def moves(read: t.Chart) -> set[tuple[frozenset[str], frozenset[str]]]:
    return {(frozenset(one.sources), frozenset(one.targets)) for one in read.transitions}


def running(body: str, interface: str = "") -> Any:
    text = project(body).replace("</interface>", f"{interface}</interface>")
    unit = compile_unit(read_plcopen(text, "main.xml"), "main.xml", ("main.xml",))
    return program_class(unit, "Main")()


FILLING = (
    step("1", "Idle", "9", initial=True)
    + transition("2", "1", condition='<condition><reference name="go"/></condition>')
    + step("3", "Run", "2")
    + transition("4", "3", condition=inline(":= stop;"))
    + element("jumpStep", "5", "4", targetName="Idle")
    + transition("9", "99")
    + step("99", "Never", "98")
    + transition("98", "3", x=5, condition=inline("n &gt; 10"))
    + element(
        "actionBlock", "6", "3",
        inside='<action localId="7" qualifier="N"><reference name="q"/></action>'
        f'<action localId="8" qualifier="P1"><inline><ST><p {XHTML}>n := n\n+ 1;</p></ST></inline></action>',
    )
)  # fmt: skip


def test_steps_transitions_jumps_and_actions_run() -> None:
    made = running(FILLING)
    seen = []
    for number, (go, stop) in enumerate(
        [(False, False), (True, False), (False, False), (False, True), (True, False)], 1
    ):
        made.go, made.stop = go, stop
        scan(made, number)
        seen.append((made.q, made.n))
    assert seen == [(False, 0), (True, 1), (True, 1), (False, 1), (True, 2)]


def test_alternatives_are_tried_by_priority_and_then_from_left_to_right() -> None:
    read = chart(
        step("1", "A", "8", initial=True)
        + element("selectionDivergence", "2", "1")
        + transition("3", "2", x=30)
        + transition("4", "2", x=10)
        + transition("5", "2", x=90, priority="1")
        + element("selectionConvergence", "6", "3", "4", "5")
        + step("7", "B", "6")
        + transition("8", "7", x=99)
    )
    assert [(one.pos.element.split()[1], one.priority) for one in read.transitions] == [
        ("4", None), ("3", None), ("5", 1), ("8", None),
    ]  # fmt: skip
    assert moves(read) == {(frozenset({"A"}), frozenset({"B"})), (frozenset({"B"}), frozenset({"A"}))}


names = some.lists(some.sampled_from("ABCDE"), min_size=1, max_size=3, unique=True)


@given(some.lists(some.tuples(names, names), min_size=1, max_size=6))
def test_every_form_of_branch_is_read(wanted: list[tuple[list[str], list[str]]]) -> None:
    body = ""
    out_of: dict[str, str] = {}
    for name in "ABCDE":  # each step with its divergence, if several transitions leave it
        leaving = [n for n, (sources, _) in enumerate(wanted) if name in sources]
        out_of[name] = f"2{ord(name)}" if len(leaving) > 1 else f"1{ord(name)}"
        if len(leaving) > 1:
            body += element("selectionDivergence", f"2{ord(name)}", f"1{ord(name)}")
    for n, (sources, targets) in enumerate(wanted):
        before = out_of[sources[0]]
        if len(sources) > 1:
            body += element("simultaneousConvergence", f"4{n}", *(out_of[name] for name in sources))
            before = f"4{n}"
        body += transition(f"3{n}", before)
        if len(targets) > 1:
            body += element("simultaneousDivergence", f"5{n}", f"3{n}")
    for name in "ABCDE":
        arriving = [
            f"5{n}" if len(targets) > 1 else f"3{n}" for n, (_, targets) in enumerate(wanted) if name in targets
        ]
        if len(arriving) > 1:
            body += element("selectionConvergence", f"6{ord(name)}", *arriving)
        body += step(
            f"1{ord(name)}", name, *([f"6{ord(name)}"] if len(arriving) > 1 else arriving), initial=name == "A"
        )
    assert moves(chart(body)) == {(frozenset(sources), frozenset(targets)) for sources, targets in wanted}


READY = f'<transition name="ready"><body><ST><p {XHTML}>:= go AND NOT stop;</p></ST></body></transition>'
NAMED = f"<transitions>{READY}</transitions>"
CONTACTS = (
    element("leftPowerRail", "50")
    + element("contact", "51", "50", inside="<variable>go</variable>")
    + element("contact", "52", "51", inside="<variable>stop</variable>", negated="true")
    + element("inVariable", "53", inside="<expression>n = 3</expression>")
)


@pytest.mark.parametrize(
    ("condition", "text"),
    [
        ('<condition><reference name="READY"/></condition>', "go AND NOT stop"),
        ('<condition><reference name="go"/></condition>', "go"),
        (inline("go OR stop"), "go OR stop"),
        (f"<condition>{link('53')}</condition>", "n = 3"),
        (f"<condition>{link('1')}</condition>", "A.X"),
    ],
)
def test_a_condition_is_a_name_a_text_or_a_connection(condition: str, text: str) -> None:
    read = chart(step("1", "A", "2", initial=True) + transition("2", "1", condition=condition) + CONTACTS, NAMED)
    assert text_of(read.transitions[0].condition) == text


@pytest.mark.parametrize(("go", "stop", "leaves"), [(False, False, False), (True, True, False), (True, False, True)])
def test_contacts_at_a_condition_are_a_network(go: bool, stop: bool, leaves: bool) -> None:
    made = running(
        step("1", "A", "4", initial=True)
        + transition("2", "1", condition=f"<condition>{link('52')}</condition>")
        + step("3", "B", "2")
        + transition("4", "3", condition=inline("FALSE"))
        + CONTACTS
    )
    scan(made, 1)
    made.go, made.stop = go, stop
    scan(made, 2)
    assert made.internal("B.X").value is leaves


TIMER = """<block localId="20" typeName="TON" instanceName="t"><position x="0" y="0"/><inputVariables>
<variable formalParameter="IN"><connectionPointIn><connection refLocalId="1"/></connectionPointIn></variable>
<variable formalParameter="PT"><connectionPointIn><connection refLocalId="21"/></connectionPointIn></variable>
</inputVariables><inOutVariables/><outputVariables><variable formalParameter="Q"><connectionPointOut/></variable>
</outputVariables></block>
<inVariable localId="21"><position x="0" y="0"/><expression>T#20ms</expression></inVariable>
"""
OF_TIMER = '<connectionPointIn><connection refLocalId="20" formalParameter="Q"/></connectionPointIn>'


def test_a_timer_beside_the_chart_decides_a_transition_as_openplc_editor_draws_it() -> None:
    made = running(
        step("1", "A", "4", initial=True)
        + transition("2", "1", condition=f"<condition>{OF_TIMER}</condition>")
        + step("3", "B", "2")
        + transition("4", "3", condition=inline("FALSE"))
        + element("actionBlock", "6", "3", inside='<action localId="0"><reference name="q"/></action>')
        + TIMER,
        interface='<localVars><variable name="t"><type><derived name="TON"/></type></variable></localVars>',
    )
    seen = []
    for number in range(1, 7):
        scan(made, number)
        seen.append(made.q)
    assert seen == [False, False, False, True, True, True]  # A.X is seen from the second scan on, and 20 ms later Q


LOOP = step("1", "A", "2", initial=True)


@pytest.mark.parametrize(
    ("body", "said"),
    [
        (step("1", "A", initial=True) + transition("2", "1"), "localId 2 of Main: the transition has no step after it"),
        (LOOP + transition("2"), "localId 2 of Main: the transition has no step before it"),
        (LOOP + transition("2", "1", condition=""), "localId 2 of Main: the transition has no condition"),
        (LOOP + transition("2", "3"), "a connection to the element 3, which does not exist"),
        (LOOP + transition("2", "3") + element("selectionDivergence", "3", "3"), "a loop of divergences"),
        (LOOP + transition("2", "3") + transition("3", "1"), "a transition follows a transition"),
        (step("1", "1a", "2") + transition("2", "1"), "the step has no usable name: '1a'"),
    ],
)
def test_a_wrong_chart_is_refused_with_the_element(body: str, said: str) -> None:
    with pytest.raises(FileInvalid, match=said):
        chart(body)


@pytest.mark.parametrize(
    ("body", "said"),
    [
        (LOOP + element("macroStep", "9"), "Main has the element macroStep"),
        (
            LOOP + transition("2", "1", condition="<condition><inline><LD/></inline></condition>"),
            "another language than ST",
        ),
        (
            LOOP + transition("2", "1") + element("actionBlock", "3", "1", inside="<action/>"),
            "neither a name nor statements",
        ),
    ],
)
def test_a_chart_with_an_unsupported_part_is_not_imported(body: str, said: str) -> None:
    unit = read_plcopen(project(body), "main.xml")
    assert not unit.pous
    assert said in unit.missing[0].reason


def test_an_error_in_an_inline_action_has_its_line() -> None:
    text = project(FILLING.replace("+ 1;", "+ nothing;"))
    line = 1 + text[: text.index("+ nothing")].count("\n")
    with pytest.raises(FileInvalid, match="nothing") as caught:
        compile_unit(read_plcopen(text, "main.xml"), "main.xml", ("main.xml",))
    assert caught.value.line == line


def test_an_indicator_of_an_action_is_read_and_has_to_be_a_bool() -> None:
    block = '<action localId="8" qualifier="L" duration="T#20ms" indicator="stop"><reference name="q"/></action>'
    body = LOOP + transition("2", "1") + element("actionBlock", "3", "1", inside=block)
    (association,) = chart(body).steps[0].associations
    assert [text_of(one) for one in association.arguments] == ["T#20ms", "stop"]
    with pytest.raises(FileInvalid, match="the indicator of action q; expected BOOL; got INT"):
        running(body.replace('indicator="stop"', 'indicator="n"'))


def named_transition(language: str) -> str:
    return f"<transitions><transition name='Ready'><body>{language}</body></transition></transitions>"


IN_FBD = (
    '<FBD><inVariable localId="1"><position x="0" y="0"/><connectionPointOut/><expression>go</expression></inVariable>'
    '<inVariable localId="2"><position x="0" y="9"/><connectionPointOut/><expression>stop</expression>'
    '</inVariable><block localId="3" typeName="AND"><position x="9" y="0"/><inputVariables>'
    + "".join(
        f'<variable formalParameter="IN{n}" edge="{edge}"><connectionPointIn><connection refLocalId="{n}"/>'
        "</connectionPointIn></variable>"
        for n, edge in ((1, "none"), (2, "falling"))
    )
    + '</inputVariables><outputVariables><variable formalParameter="OUT"><connectionPointOut/></variable></outputVariables>'
    '</block><outVariable localId="4"><position x="20" y="0"/><connectionPointIn><connection refLocalId="3"/>'
    "</connectionPointIn><expression>Ready</expression></outVariable></FBD>"
)
IN_ST = f"<ST><p {XHTML}>IF go THEN\nReady := NOT stop; END_IF</p></ST>"


@pytest.mark.parametrize("language", [IN_FBD, IN_ST])
def test_a_named_transition_may_have_a_body(language: str) -> None:
    body = (
        step("1", "A", "4", initial=True)
        + transition("2", "1", condition='<condition><reference name="Ready"/></condition>')
        + step("3", "B", "2")
        + transition("4", "3", condition=inline("NOT go"))
    )
    text = project(body, named_transition(language))
    made = program_class(compile_unit(read_plcopen(text, "main.xml"), "main.xml", ("main.xml",)), "Main")()
    seen = []
    for number, (go, stop) in enumerate([(False, False), (True, True), (True, False), (False, False), (True, True)], 1):
        made.go, made.stop = go, stop  # type: ignore[attr-defined]
        scan(made, number)
        found = made.internal("B.X")
        assert found is not None
        seen.append(found.value)
    assert seen == [False, False, True, False, False]


def test_the_body_of_an_action_may_be_a_chart() -> None:
    inner = (
        step("1", "Red", "4", initial=True) + transition("2", "1", condition=inline("go")) + step("3", "Green", "2")
        + transition("4", "3", condition=inline("go"))
        + element(
            "actionBlock", "6", "3",
            inside=f'<action localId="8" qualifier="P1"><inline><ST><p {XHTML}>n := n + 1;</p></ST></inline></action>',
        )
    )  # fmt: skip
    actions = f"<actions><action name='Blink'><body><SFC>{inner}</SFC></body></action></actions>"
    outer = (
        LOOP
        + transition("2", "1", condition=inline("FALSE"))
        + element("actionBlock", "6", "1", inside='<action localId="7"><reference name="Blink"/></action>')
    )
    text = project(outer, actions)
    made = program_class(compile_unit(read_plcopen(text, "main.xml"), "main.xml", ("main.xml",)), "Main")()
    seen = []
    for number in range(1, 7):
        made.go = True  # type: ignore[attr-defined]
        scan(made, number)
        seen.append(made.n)  # type: ignore[attr-defined]
    assert seen == [0, 1, 1, 2, 2, 3]
