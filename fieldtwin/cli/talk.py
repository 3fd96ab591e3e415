"""The two consoles: data on stdout, talk on stderr. rich honours NO_COLOR and leaves colour out where there is no terminal."""

from __future__ import annotations

from rich.console import Console

talk = Console(stderr=True, highlight=False)
data = Console(highlight=False)
