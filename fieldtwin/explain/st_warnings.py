"""The warnings of Structured Text (`fieldtwin.plc.st.dialects`)."""

from __future__ import annotations

from fieldtwin.explain.explanation import Explanation
from fieldtwin.plc.st.dialects import FINDINGS, WARNINGS

_MEANINGS = {
    "ST001": (
        "A POU assigns to one of its inputs. The standard forbids it (IEC 61131-3, 6.5.2); CODESYS, TwinCAT and matiec "
        "accept it. The next call, and for a PROGRAM the next scan, replaces the value by that of the caller or of the tag.",
        "Copy the input to a local variable and change the copy.",
    ),
    "ST002": (
        "A value is converted to a type that cannot represent every value of the source type, such as DINT to INT. "
        "Bits that do not fit are cut off, and a REAL loses digits.",
        "Write the conversion (`DINT_TO_INT`) where the loss is intended; otherwise declare a wider type.",
    ),
    "ST003": (
        "A BYTE, WORD, DWORD or LWORD is used as an unsigned number of its width, or a number as a bit string. No value changes.",
        "Declare the variable as an integer type, or write the conversion, such as `WORD_TO_UINT`.",
    ),
    "ST004": (
        "SHL, SHR, ROL or ROR of an integer; the standard defines them for bit strings only. "
        "SHR of a signed integer copies its sign.",
        "Declare the variable as a bit string, or convert it first.",
    ),
    "ST005": (
        "AND, OR, XOR or NOT of an integer. It is computed bit by bit, with negative numbers in two's complement.",
        "Declare the variable as a bit string, or convert it first.",
    ),
    "ST006": (
        "An enumeration is used as a number, or a number as an enumeration. A number that the enumeration does not have "
        "stops the task when it is assigned.",
        "Use the names of the values, or an integer variable.",
    ),
    "ST007": (
        "The compiler skips a pragma of a different tool. C code between `{{` and `}}` is not executed, "
        "so a function that relies on it computes something else. In the dialects codesys and twincat, attributes that change "
        "no result, such as `hide` and `symbol`, are skipped without this warning.",
        "Check the spelling of the attribute, and whether the program needs the pragma. Write the part in Structured Text if it "
        "does.",
    ),
    "ST008": (
        "The operands are of a signed and an unsigned type. They are computed in the smallest signed type that holds both, "
        "LINT at most; CODESYS may compute in a narrower one.",
        "Convert one operand to the type of the other.",
    ),
    "ST009": (
        "A function block declares FB_exit or FB_reinit. A controller of CODESYS calls FB_exit before an instance is deleted or "
        "copied, and FB_reinit after an online change has copied it. Here no instance is deleted while its program runs, an "
        "online change creates new instances with FB_init, and they get the values of the old ones. Only calls in the program "
        "execute the two methods.",
        "Move what has to happen at a start into FB_init. For a reaction to an online change, compare values in the body.",
    ),
    "ST010": (
        "SHL, ROL or ROR of a constant without a type, such as `SHL(1, n)`, whose result depends on its width. Here the constant "
        "has the type of its context, such as that of the variable to which the result is assigned. Manuals of CODESYS say that "
        "a constant has the narrowest type that holds it, so a controller may lose bits.",
        "Write the type of the constant, such as `SHL(DWORD#1, n)`.",
    ),
    "ST011": (
        "A statement in a FOR alters the control variable of the loop, which IEC 61131-3 does not allow. The next iteration has "
        "the altered value plus the step, so the loop can run more often or less often than its limits say, or without end.",
        "Leave the loop with EXIT, skip an iteration with CONTINUE, or use WHILE.",
    ),
    "ST100": (
        "A comment `fieldtwin: allow ID: REASON` accepts a warning in its line or the next one. This one names no warning, "
        "has no reason, or there is no such warning any more.",
        "Correct the id, write the reason, or remove the comment.",
    ),
    "ST101": (
        "No statement of the POU uses the variable, and it has no address.",
        "Remove the variable, or use it.",
    ),
    "ST102": (
        "REAL numbers are rounded after each operation, so two numbers that should be equal often differ in their last digit.",
        "Compare the difference with a tolerance: `ABS(a - b) < 0.001`.",
    ),
    "ST103": (
        "The CASE has no branch for some values of the enumeration, and no ELSE. In these states it does nothing.",
        "Add the branches, or an ELSE that leads to a safe state; an empty `ELSE ;` shows that nothing is intended.",
    ),
    "ST104": (
        "No statement assigns the output, and it has no initial value. Its tag always has the initial value of its type.",
        "Assign the output, give it an initial value, or remove it.",
    ),
    "ST105": (
        "An instance of TON, TOF, TP, R_TRIG, F_TRIG, CTU, CTD or CTUD is called in some branches of an IF or CASE only. In the "
        "other scans it sees neither time nor edges: a timer does not restart, and an edge in between is lost.",
        "Call the instance once in every scan, outside of the IF or CASE, and put the condition into its input.",
    ),
    "ST106": (
        "A division by zero stops the task. No condition or comparison in the POU uses the divisor.",
        "Test the divisor before the division, or limit it: `x / MAX(y, 1)`.",
    ),
    "ST107": (
        "A statement follows RETURN, EXIT or CONTINUE in the same body, or a condition is always FALSE.",
        "Remove the statement, or correct the condition.",
    ),
    "ST108": (
        "Programs of different tasks assign the same global variable, also through the function blocks and functions that they "
        "use. Its value depends on which task ran last.",
        "Let one task write the variable; give each task its own one, and combine them in one place.",
    ),
    "ST109": (
        "Two addresses of different sizes, such as %QX0.0 and %QW0, are separate variables in fieldtwin and in OpenPLC. In "
        "CODESYS and TwinCAT they share bits, so the program would behave differently there.",
        "Use addresses that do not overlap, or bits of one variable: `word.3`.",
    ),
    "ST110": (
        "The system file binds variables of BOOL, numbers, times and enumerations to tags. A STRING or an array in VAR_INPUT or "
        "VAR_OUTPUT of a PROGRAM keeps its initial value, or what the program assigns, unless a CONFIGURATION connects it.",
        "Connect it in a CONFIGURATION, use a variable for each element, or MESSAGES for texts.",
    ),
    "ST111": (
        "An input is bound to a tag that can have values which the variable cannot hold, such as an INT to an unsigned register; "
        "such a value stops the task. Or an output is a subrange that is wider than the limits of its tag; the gateway refuses "
        "such a value.",
        "Declare the variable with a type that holds all values of the tag, such as UINT, or correct `range` in the profile.",
    ),
    "ST112": (
        "The system file binds an input of the program to a tag, and no statement of the program uses the input.",
        "Use the input, or remove it and its binding.",
    ),
    "ST113": (
        "TIME and LTIME are bound as a number of ns. The profile states a different unit for the tag, such as ms, so the time is "
        "wrong by a factor.",
        "Bind an integer or REAL variable, and compute the time in the program: `T#1ms * ms`.",
    ),
    "ST114": (
        "The system file allows writes to the tag (`writable`), and neither a program nor a server in the system file writes it.",
        "Bind an output of a program to it, or remove it from `writable`.",
    ),
    "ST115": (
        "A STRING is declared at %I* or %Q*. On a controller it gets the bytes of a device, but the system file can only bind "
        "BOOL, numbers, times and enumerations. The variable keeps its initial value, or what the program assigns.",
        "Use an array of BYTE, whose elements can be bound, or MESSAGES for texts.",
    ),
    "ST116": (
        "The system file has `machine_code: true` for the program, but no machine code could be made. The program runs as Python "
        "code, with the same results, and takes more time in each scan.",
        "Install what the warning names: a C compiler and the headers of Python (on Debian gcc and python3-dev). Or remove "
        "`machine_code`.",
    ),
}

ST_WARNINGS = tuple(
    Explanation(
        id,
        "warning of Structured Text",
        title,
        *_MEANINGS[id],
        source="docs/reference/structured-text.md",
    )
    for id, title in (WARNINGS | FINDINGS).items()
)
