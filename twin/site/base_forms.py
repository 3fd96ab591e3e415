"""The base class of the forms of system files, and the types of values that several of them use."""

from __future__ import annotations

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

Name = Annotated[str, Field(pattern=r"^[a-zA-Z][a-zA-Z0-9_]*$")]
Milliseconds = Annotated[int, Field(ge=1, le=3_600_000)]
Pause = Annotated[int, Field(ge=0, le=60_000)]
Address = Annotated[int, Field(ge=0, le=0xFFFF)]
TagName = Annotated[str, Field(pattern=r"^[a-zA-Z][a-zA-Z0-9_]*\.[a-zA-Z][a-zA-Z0-9_]*$")]


class SiteModel(BaseModel):
    """Base class: unknown keys are refused, and values are not coerced."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)
