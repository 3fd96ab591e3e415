"""The form of the `alarms` section of a system file."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from fieldtwin.twin.site.base_forms import SiteModel

Delay = Annotated[int, Field(ge=0, le=3_600_000)]
Priority = Literal["low", "medium", "high", "critical"]


class AlarmForm(SiteModel):
    """An alarm (ISA-18.2, IEC 62682): the condition in which it is active, its delays, and what operators see of it."""

    condition: str = Field(description="an expression as in scenarios", examples=["tank.level > 4.5"])
    priority: Priority = "medium"
    text: str = Field(
        default="", max_length=200, description="the text that the operator reads", examples=["Tank level is high"]
    )
    on_delay_ms: Delay = Field(default=0, description="how long the condition is true before the alarm is active, ms")
    off_delay_ms: Delay = Field(
        default=0, description="how long the condition is false before the alarm returns to normal, ms"
    )
    acknowledge: bool = Field(default=True, description="whether an operator must acknowledge it")
