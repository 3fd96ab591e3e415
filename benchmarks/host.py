"""How quiet the host was during a benchmark: the CPU time that the hypervisor took away (steal), and the load.

On a shared host a timing says little about the program when other virtual machines take its processors. Such a benchmark is
inconclusive: it neither reached nor missed its goals.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import NamedTuple

MOST_STEAL = 0.02
"""Greatest share of the CPU time that the hypervisor may take away during a timing."""
MOST_LOAD = 2.0
"""Greatest load average for each CPU, the benchmark's own processes included."""


class HostState(NamedTuple):
    """One look at the host: CPU ticks since boot (proc(5), `/proc/stat`), and the load average of the last minute."""

    stolen: int
    ticks: int
    load: float

    @classmethod
    def read(cls, stat: Path = Path("/proc/stat")) -> HostState:
        fields = [int(field) for field in stat.read_text().split("\n", 1)[0].split()[1:9]]
        return cls(stolen=fields[7], ticks=sum(fields), load=os.getloadavg()[0])


class HostChange(NamedTuple):
    """The host between two looks."""

    before: HostState
    after: HostState

    @property
    def steal(self) -> float:
        """The share of the CPU time that the hypervisor took away, 0 to 1."""
        return (self.after.stolen - self.before.stolen) / max(self.after.ticks - self.before.ticks, 1)

    @property
    def load_per_cpu(self) -> float:
        """The greater of the two load averages, for each CPU."""
        return max(self.before.load, self.after.load) / (os.cpu_count() or 1)

    def __str__(self) -> str:
        loads = f"load {self.before.load:.1f} before and {self.after.load:.1f} after"
        return f"host: {os.cpu_count()} CPUs, {loads}, steal {self.steal:.1%}"

    def disturbance(self) -> str:
        """Return why timings between the two looks say little, or "" if the host was quiet."""
        if self.steal > MOST_STEAL:
            return f"the hypervisor took {self.steal:.1%} of the CPU time away (at most {MOST_STEAL:.0%})"
        if self.load_per_cpu > MOST_LOAD:
            return f"the load was {self.load_per_cpu:.1f} for each CPU (at most {MOST_LOAD:g})"
        return ""


AT_START = HostState.read()
"""The host when the benchmark began, which is when it imported this module."""
