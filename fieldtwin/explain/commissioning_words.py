"""The words with which `identify`, `scan`, `infer` and `compare` state how certain a result is."""

from __future__ import annotations

from fieldtwin.explain.explanation import Explanation

_COMMISSIONING = "docs/how-to/commissioning.md"
_INFERRING = "docs/how-to/infer.md"
_TO_CERTAIN = "Compare the values with the manual or the display of the device."
_TO_CHANGE = (
    "Make more passes while values change: `fieldtwin dump --passes 20 --every 15s`. Compare the draft with the manual."
)

_IDENTIFY: dict[str, tuple[str, str]] = {
    "certain": (
        "Vendor and product code, the data sheet, or the SunSpec model agree with the profile.",
        "Nothing. Register values alone are never certain, because sister models share maps.",
    ),
    "likely": (
        "The server ID (function 11h) agrees, or at least six values are plausible that could have been nonsense.",
        _TO_CERTAIN,
    ),
    "possible": (
        "A few plausible values agree, a text is where the profile has one, or the device has the same CiA profile.",
        _TO_CERTAIN + " A different profile may fit as well.",
    ),
    "ruled out": (
        "The device identifies itself differently, refuses an identifying register, or has values that make no sense for this "
        "profile.",
        "`fieldtwin identify --all` shows the reasons.",
    ),
}
_INFER: dict[str, tuple[str, str]] = {
    "certain": (
        "The probability of this type is at least 99.97 %, from at least six different samples, and no other type looks alike.",
        "Name the tag and give it a unit.",
    ),
    "likely": (
        "The probability of this type is at least 80 %. A value that has never changed is at best likely.",
        _TO_CHANGE,
    ),
    "guess": ("The probability of this type is at least 50 %.", _TO_CHANGE),
    "unknown": (
        "No type has a probability of 50 %. The draft has a plain `uint16` for each register.",
        _TO_CHANGE,
    ),
}

COMMISSIONING_WORDS: tuple[Explanation, ...] = (
    *(
        Explanation(f"identify {word}", "certainty", "how well a profile fits", *text, _COMMISSIONING, (word,))
        for word, text in _IDENTIFY.items()
    ),
    *(
        Explanation(f"infer {word}", "certainty", "how sure a type is", *text, _INFERRING, (word,))
        for word, text in _INFER.items()
    ),
    Explanation(
        "compare fidelity", "certainty", "agreement with a recording",
        "Fidelity of values: the share of exchanges that are alike. Fidelity of timing: the mean ratio of the smaller to the "
        "larger latency, over the 5 % to 95 % quantiles, with a millisecond added to both.",
        "`--least` sets the required fidelity of values, `--tolerance` the permitted difference of values, and `--latency` that "
        "of latencies.",
        "docs/how-to/compare.md", ("fidelity",),
    ),
)  # fmt: skip
