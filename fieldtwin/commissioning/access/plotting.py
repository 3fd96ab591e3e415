"""Plot histories. This is the only file that uses matplotlib, an optional extra."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path

from fieldtwin.commissioning.access.watching import History
from fieldtwin.gateway.core.errors import FileInvalid, UsageError
from fieldtwin.gateway.core.files.profile import Tag
from fieldtwin.installation import install_hint

MOST_PANELS = 24
FORMATS = (".png", ".svg", ".pdf")


def check_plot(path: Path) -> None:
    """Raise `UsageError` if matplotlib is missing, so that the user learns this before the recording begins and not at its
    end.
    """
    if path.suffix.lower() not in FORMATS:
        raise UsageError("unsupported image format", expected=", ".join(FORMATS), got=path.name)
    if not _there():
        raise UsageError(
            "--plot needs matplotlib", hint=f"{install_hint('plot')}; or use --json and your own plotting program"
        )


def _there() -> bool:
    try:
        return find_spec("matplotlib") is not None
    except ValueError:  # the module was removed from the running interpreter
        return False


def plot(path: Path, title: str, tags: Sequence[Tag], histories: Mapping[str, History]) -> int:
    """Write a picture with one panel for each tag that has numbers, over the time in seconds.

    Return the number of panels; 0 if there was nothing to draw and no file was written.

    Raises `FileInvalid` when it cannot be written.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    shown = [t for t in tags if any(v is not None for v in histories[t.name].values)][:MOST_PANELS]
    if not shown:
        return 0
    figure = Figure(figsize=(9, 1.2 + 1.5 * len(shown)), layout="constrained")
    FigureCanvasAgg(figure)
    panels = figure.subplots(len(shown), 1, sharex=True, squeeze=False)[:, 0]
    for panel, tag in zip(panels, shown, strict=True):
        history = histories[tag.name]
        values = [float("nan") if v is None else v for v in history.values]
        panel.step(list(history.times_s), values, where="post", linewidth=1)
        panel.set_ylabel(f"{tag.name}\n{tag.unit}".rstrip(), fontsize="small")
        panel.grid(visible=True, linewidth=0.3)
        panel.ticklabel_format(useOffset=False, axis="y")
    panels[-1].set_xlabel("s")
    figure.suptitle(title, fontsize="medium")
    try:
        figure.savefig(path, dpi=120)
    except OSError as e:
        raise FileInvalid(f"cannot write the plot: {e.strerror or e}", path=str(path)) from e
    return len(shown)
