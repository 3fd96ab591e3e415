"""The pydantic models of a network file: systems, and the acoustic channel between their modems.

Only prototypes (systems with emulated devices) use network files; a run of a real plant never reads one.
"""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import ConfigDict, Field

from fieldtwin.twin.site.base_forms import Name, SiteModel

WATER = "water"
"""The name of the acoustic channel in faults, where it takes the place of a bus name."""
SHIP = "ship"
"""The name of the topside modem among the modems of the acoustic channel."""

Place = Annotated[list[float], Field(min_length=2, max_length=3)]


class AcousticForm(SiteModel):
    """The acoustic channel: its range, propagation speed, data rate and losses."""

    range_m: float = Field(gt=0, le=1_000_000)
    sound_m_per_s: float = Field(default=1500.0, ge=100, le=10_000)
    bytes_per_s: float = Field(default=80.0, gt=0, le=1_000_000)
    overhead_bytes: int = Field(default=8, ge=0, le=1024, description="bytes of each packet in addition to its payload")
    loss: float = Field(
        default=0.0, ge=0.0, lt=1.0, description="share of the packets that each listener loses, at random"
    )

    model_config = ConfigDict(extra="forbid", frozen=True, strict=False)


class MemberForm(SiteModel):
    """A system of the network, which of its devices is the modem, and the modem's position."""

    system: str
    modem: Name
    at_m: Place
    prototype: str | None = Field(default=None, description="default: the prototype file next to the system file")

    model_config = ConfigDict(extra="forbid", frozen=True, strict=False)


class TopsideForm(SiteModel):
    """The source of commands: a topside modem that sends each command several times, because none is acknowledged."""

    at_m: Place
    says: int = Field(default=3, ge=1, le=10)
    every_s: float = Field(default=20.0, gt=0, le=3600)

    model_config = ConfigDict(extra="forbid", frozen=True, strict=False)


class NetworkForm(SiteModel):
    """Several systems whose modems hear each other, all run as prototypes, and the acoustic channel between them."""

    fieldtwin: Literal[1]
    network: Name
    seed: int = 1
    water: AcousticForm
    systems: dict[Name, MemberForm] = Field(min_length=2, max_length=100)
    ship: TopsideForm | None = None
