"""fieldtwin: run a plant's own control software without the plant.

Each name of the public Python API is loaded when it is first used, so that importing this package takes no time.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from fieldtwin.__about__ import __version__

if TYPE_CHECKING:
    from fieldtwin.commissioning.scan.node_scan import scan_can_bus as scan_can_bus
    from fieldtwin.gateway.core.errors import FieldtwinError as FieldtwinError
    from fieldtwin.gateway.core.files.profile_file import load_profile as load_profile
    from fieldtwin.run.live.options import RunOptions as RunOptions
    from fieldtwin.run.live.session import RunSession as RunSession
    from fieldtwin.twin.prototype.file import load_prototype as load_prototype
    from fieldtwin.twin.site.system import load_system as load_system

_PUBLIC = {
    "FieldtwinError": "fieldtwin.gateway.core.errors",
    "RunOptions": "fieldtwin.run.live.options",
    "RunSession": "fieldtwin.run.live.session",
    "load_profile": "fieldtwin.gateway.core.files.profile_file",
    "load_prototype": "fieldtwin.twin.prototype.file",
    "load_system": "fieldtwin.twin.site.system",
    "scan_can_bus": "fieldtwin.commissioning.scan.node_scan",
}

__all__ = [
    "FieldtwinError",
    "RunOptions",
    "RunSession",
    "__version__",
    "load_profile",
    "load_prototype",
    "load_system",
    "scan_can_bus",
]


def __getattr__(name: str) -> Any:
    if name in _PUBLIC:
        return getattr(import_module(_PUBLIC[name]), name)
    raise AttributeError(f"module 'fieldtwin' has no attribute {name!r}")


def __dir__() -> list[str]:
    return list(__all__)
