"""The base class of the forms of system files, and the types of values that several of them use."""

from __future__ import annotations

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

Name = Annotated[str, Field(pattern=r"^[a-zA-Z][a-zA-Z0-9_]*$")]
Milliseconds = Annotated[int, Field(ge=1, le=3_600_000)]
Pause = Annotated[int, Field(ge=0, le=60_000)]
Address = Annotated[int, Field(ge=0, le=0xFFFF)]
TagName = Annotated[str, Field(pattern=r"^[a-zA-Z][a-zA-Z0-9_]*\.[a-zA-Z][a-zA-Z0-9_]*$")]
_PATH = r"[a-zA-Z][a-zA-Z0-9_]*(\.[a-zA-Z_][a-zA-Z0-9_]*|\[-?[0-9]+(,-?[0-9]+)*\])*"
VariableName = Annotated[str, Field(pattern=f"^{_PATH}$", max_length=255)]
"""A variable of a program, or the path of a located part of one, such as ``pump.fault`` or ``fans[2].run``."""
SourceName = Annotated[str, Field(pattern=rf"^[a-zA-Z][a-zA-Z0-9_]*\.{_PATH}$", max_length=511)]
"""A tag, or a variable of another program with the name of the program before it."""


class SiteModel(BaseModel):
    """Base class: unknown keys are refused, and values are not coerced."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)
