"""The warnings of Structured Text (`fieldtwin.plc.st.dialects`)."""

from __future__ import annotations

from fieldtwin.explain.explanation import Explanation
from fieldtwin.plc.st.dialects import WARNINGS

_MEANINGS = {
    "ST001": (
        "A POU assigns to one of its inputs. The standard forbids it (IEC 61131-3, 6.5.2); CODESYS, TwinCAT and matiec "
        "accept it. The next call, and for a PROGRAM the next scan, replaces the value by that of the caller or of the tag.",
        "Copy the input to a local variable and change the copy.",
    ),
    "ST002": (
        "A value is converted to a type that does not hold every value of its own type, such as DINT to INT. "
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
        "An enumeration is used as a number, or a number as an enumeration. A number that is no value of the enumeration "
        "stops the task when it is assigned.",
        "Use the names of the values, or an integer variable.",
    ),
    "ST007": (
        "The compiler skips a pragma of a different tool. C code between `{{` and `}}` is not executed, "
        "so a function that relies on it computes something else.",
        "Check whether the program needs the pragma. Write the part in Structured Text if it does.",
    ),
    "ST008": (
        "The operands are of a signed and an unsigned type. They are computed in the smallest signed type that holds both, "
        "LINT at most; CODESYS may compute in a narrower one.",
        "Convert one operand to the type of the other.",
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
    for id, title in WARNINGS.items()
)
