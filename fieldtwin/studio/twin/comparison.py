"""Compare the variables of a digital model with the plant's present values."""

from __future__ import annotations

from typing import Any, NamedTuple

import msgspec

from fieldtwin.capture.decoding.exchange import SECRET
from fieldtwin.gateway.core.clock import NS_PER_S
from fieldtwin.run.shadow.status import TwinStatus, VariableStatus
from fieldtwin.studio.live.attachment import Attachment

ON_THE_WAY_S = 2.0
"""A change of the plant that is not older than this (seconds) may still be on its way to the model."""
AGREES, DEVIATES, ON_THE_WAY, UNKNOWN = "agrees", "deviates", "on the way", "unknown"


class Compared(msgspec.Struct, frozen=True, kw_only=True):
    """A variable of the model and the plant's value. `plant` is None if the gateway has no such tag or does not answer."""

    name: str
    unit: str
    model: Any
    model_quality: str
    model_reason: str
    model_age_s: float | None
    """Time in seconds since the plant reported the value; None if it never did."""
    plant: Any
    plant_quality: str | None
    plant_reason: str | None
    plant_age_s: float | None
    difference: float | None
    """The model's value minus the plant's, if both are numbers."""
    verdict: str
    """``agrees``, ``deviates``, ``on the way`` (the plant's value has just changed), or ``unknown``."""
    reason: str


def compare(attachment: Attachment, status: TwinStatus) -> list[Compared]:
    """Return every variable of the model, in the order of the system file. Values of secrets are masked."""
    return [_compared(attachment, status, name, variable) for name, variable in status.variables.items()]


class _Plant(NamedTuple):
    """The present value of a variable in the plant."""

    value: Any
    quality: str
    reason: str
    age_s: float | None
    changed_s: float | None
    """Time since the last change that Studio has seen, in seconds."""


def _plant(attachment: Attachment, name: str) -> _Plant | None:
    gateway = attachment.gateway
    if gateway is None:
        return None
    if name in attachment.system.plc.programs:  # this variable of the model says whether the program runs
        runs = gateway.plc.alive
        return _Plant(runs, "good" if runs else "bad", "none" if runs else "heartbeat_lost", None, None)
    tag = gateway.tags.get(name)
    if tag is None:
        return None
    now_ns = attachment.now_ns()
    reads = attachment.history.changes(name, now_ns - int(2 * ON_THE_WAY_S * NS_PER_S), now_ns)
    if not reads:
        return _Plant(tag.value, tag.quality, tag.reason, tag.age_s, None)
    newest = reads[-1][1]  # newer than the status, which is read less often
    changed_ns = [
        now.t_ns for before, now in reads if before is not None and before[1:] != now[1:]
    ]  # not only the time
    changed_s = (now_ns - changed_ns[-1]) / NS_PER_S if changed_ns else None
    return _Plant(newest.value, newest.quality, newest.reason, tag.age_s, changed_s)


def _compared(attachment: Attachment, status: TwinStatus, name: str, variable: VariableStatus) -> Compared:
    plant = _plant(attachment, name)
    verdict, reason = _verdict(attachment, variable, plant)
    model = variable.value
    if name in attachment.system.plc.programs and model is not None:
        model = bool(model)
    is_secret = name in attachment.secrets
    return Compared(
        name=name,
        unit=variable.unit,
        model=SECRET if is_secret else model,
        model_quality=variable.quality,
        model_reason=variable.reason,
        model_age_s=None if variable.t_ms is None else max(0.0, (status.now_ms - variable.t_ms) / 1000),
        plant=None if plant is None else SECRET if is_secret else plant.value,
        plant_quality=plant.quality if plant is not None else None,
        plant_reason=plant.reason if plant is not None else None,
        plant_age_s=plant.age_s if plant is not None else None,
        difference=None if plant is None or is_secret else _difference(variable.value, plant.value),
        verdict=verdict,
        reason=reason,
    )


def _verdict(attachment: Attachment, variable: VariableStatus, plant: _Plant | None) -> tuple[str, str]:
    if plant is None:
        unanswered = "the gateway does not answer, so the plant's value is not known"
        return UNKNOWN, unanswered if attachment.gateway is None else "a message, which the gateway does not keep"
    if variable.quality == plant.quality and (variable.value == plant.value or variable.quality != "good"):
        return AGREES, "" if plant.quality == "good" else f"both are {plant.quality}: {_words(plant.reason)}"
    if plant.changed_s is not None and plant.changed_s < ON_THE_WAY_S:
        return ON_THE_WAY, f"the plant changed {plant.changed_s:.1f} s ago"
    if variable.t_ms is None:
        return DEVIATES, "the plant has never reported it to the model"
    if variable.quality != plant.quality:
        return (
            DEVIATES,
            f"{_said(variable.quality, variable.reason)} in the model, {_said(plant.quality, plant.reason)} in the plant",
        )
    return DEVIATES, "the model has an older value"


def _said(quality: str, reason: str) -> str:
    return quality if reason == "none" else f"{quality} ({_words(reason)})"


def _difference(model: Any, plant: Any) -> float | None:
    numbers = [isinstance(v, int | float) and not isinstance(v, bool) for v in (model, plant)]
    return float(model) - float(plant) if all(numbers) else None


def _words(reason: str) -> str:
    return reason.replace("_", " ")
