"""The software that must be equal on two computers so that the same seed gives the same run: Python, fieldtwin and its packages.

The installed versions are compared, and not a lock file: a lock file states what should be installed.
"""

from __future__ import annotations

import hashlib
import platform
import re
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache
from importlib.metadata import PackageNotFoundError, distribution

from fieldtwin.__about__ import __version__
from fieldtwin.gateway.core.errors import UsageError
from fieldtwin.twin.site.data_files import data_root
from fieldtwin.twin.template.software import modules_hash

_NAME = re.compile(r"[A-Za-z0-9._-]+")
PACKAGES_SHOWN = 5


class NotReproducible(UsageError):
    """A worker whose runs could differ from those of this computer. `where` names the worker."""


@dataclass(frozen=True, slots=True)
class Environment:
    """The software of a computer. `python` is the interpreter with its minor version, `modules` the hash over fieldtwin's
    modules, and `packages` has the version of every package that fieldtwin needs.
    """

    python: str
    version: str
    modules: str
    packages: tuple[tuple[str, str], ...]

    def differences(self, other: Environment) -> list[tuple[str, str, str]]:
        """Return what differs from `other`: its name, the value here and the value there."""
        pairs = [
            ("Python", self.python, other.python),
            ("fieldtwin", self.version, other.version),
            ("fieldtwin's modules", self.modules[:12], other.modules[:12]),
        ]
        here, there = dict(self.packages), dict(other.packages)
        pairs += [(name, here.get(name, "none"), there.get(name, "none")) for name in sorted(here | there)]
        return [(name, one, two) for name, one, two in pairs if one != two]


@cache
def local_environment() -> Environment:
    """Return the software of this computer. It is read once for each process."""
    major, minor, _ = platform.python_version_tuple()
    python = f"{platform.python_implementation()} {major}.{minor}"
    return Environment(python, __version__, modules_hash(), tuple(sorted(_needed("fieldtwin").items())))


def _needed(root: str) -> dict[str, str]:
    """Return the installed version of each package that `root` needs, directly or not, without its extras."""
    found: dict[str, str] = {}
    left = [root]
    while left:
        try:
            package = distribution(left.pop())
        except PackageNotFoundError:
            continue  # for a different platform or Python version
        name = package.metadata["Name"].lower().replace("_", "-")
        if name in found:
            continue
        found[name] = package.version
        left += [match[0] for text in package.requires or () if "extra ==" not in text and (match := _NAME.match(text))]
    found.pop(root, None)  # its version and its modules are compared separately
    return found


def check_environment(wanted: Environment, worker: str) -> None:
    """Raise `NotReproducible` if the software of this computer, which runs `worker`, differs from `wanted`."""
    differ = local_environment().differences(wanted)
    if not differ:
        return
    more = f" and {len(differ) - PACKAGES_SHOWN} more" if len(differ) > PACKAGES_SHOWN else ""
    shown = differ[:PACKAGES_SHOWN]
    raise NotReproducible(
        "this worker has different software, so its runs could not be reproduced",
        where=f"worker {worker}",
        expected=", ".join(f"{name} {there}" for name, _, there in shown) + more,
        got=", ".join(f"{name} {here}" for name, here, _ in shown) + more,
        hint="install the same wheel and packages on all workers, for example with the same container image",
    )


def check_shipped(shipped: Iterable[tuple[str, str]], worker: str) -> None:
    """Raise `NotReproducible` if a shipped file that the campaign uses has different contents on this computer."""
    for name, digest in shipped:
        path = data_root() / name
        if not path.is_file() or hashlib.sha256(path.read_bytes()).hexdigest() != digest:
            raise NotReproducible(
                f"the shipped file {name} is different on this worker",
                where=f"worker {worker}",
                hint="install the same wheel on all workers",
            )
