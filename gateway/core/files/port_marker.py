"""The marker file next to the link of a virtual serial port. It shows whether the program that made the link still runs.

A program that is killed leaves its link, and the kernel gives the number of its pseudo-terminal to the next program that opens
one. The link then leads to the terminal of another program. The marker is a file in the folder of the link. It names the
pseudo-terminal, and the program that made the port keeps it locked; the kernel releases the lock when that program ends, however
it ends. A link without a marker belongs to the user, and is not checked.
"""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path

from fieldtwin.gateway.core.errors import Unreachable

try:
    import fcntl
except ImportError:  # Windows, which has no pseudo-terminals
    LOCKS = False
else:
    LOCKS = True

LINKS_MAX = 40
"""The number of links that Linux follows in one path."""
_SUFFIX = ".fieldtwin"


def mark_port(link: Path, device: str) -> int:
    """Write the marker of `link`, which leads to `device`. Return a descriptor; the port counts as open until the descriptor
    is closed.

    Raises `OSError`.
    """
    marker = _marker(link)
    beside = marker.with_name(f"{marker.name}.{os.getpid()}")  # locked before a reader can find it
    beside.unlink(missing_ok=True)
    descriptor = os.open(beside, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o644)
    try:
        os.fchmod(descriptor, 0o644)  # every user that may open the port can check it, with any umask
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        os.write(descriptor, device.encode())
        beside.replace(marker)
    except BaseException:
        os.close(descriptor)
        beside.unlink(missing_ok=True)
        raise
    return descriptor


def remove_port(link: Path, device: str) -> None:
    """Remove the link and the marker of the port `device`, unless a different port has replaced them."""
    with suppress(OSError):
        if os.readlink(link) == device:
            link.unlink()
    marker = _marker(link)
    with suppress(OSError):
        if marker.read_text() == device:
            marker.unlink()


def remove_dead_port(link: Path) -> None:
    """Remove `link` if the program that made it has ended."""
    if (device := _dead_device(link)) is not None:
        remove_port(link, device)


def remove_dead_ports(folder: Path) -> None:
    """Remove the links in `folder` whose programs have ended. No other program may make ports there meanwhile."""
    for marker in folder.glob(f".*{_SUFFIX}"):
        remove_dead_port(folder / marker.name.removeprefix(".").removesuffix(_SUFFIX))


def refuse_dead_port(path: Path, where: str) -> None:
    """Raise `Unreachable` if `path`, or a link that it leads to, was made by a program that has ended."""
    for _ in range(LINKS_MAX):
        try:
            target = path.readlink()
        except OSError:
            return  # no link: a device, or nothing
        if _dead_device(path) is not None:
            raise Unreachable(
                "the program that made this virtual serial port has ended, and its link may lead to a foreign terminal",
                where=where,
                hint=f"start the emulator again, or remove {path}",
            )
        path = path.parent / target


def _dead_device(link: Path) -> str | None:
    """Return the pseudo-terminal that `link` leads to if the program that made the link has ended, otherwise None."""
    if not LOCKS:
        return None
    try:
        device = os.readlink(link)
        marker = os.open(_marker(link), os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
    except OSError:
        return None
    try:
        if os.read(marker, len(device) + 1) != device.encode():
            return None  # the user has put a different link there
        fcntl.flock(marker, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except OSError:
        return None  # the program that made the port holds the lock
    finally:
        os.close(marker)
    return device


def _marker(link: Path) -> Path:
    return link.with_name(f".{link.name}{_SUFFIX}")
