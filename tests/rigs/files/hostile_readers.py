"""Read hostile files in a separate process, with a limit on memory and time: `python hostile_readers.py FOLDER KIND...`.

It prints a JSON line for each file: reader, file, result ("read", or the name of the error), and the error message.
"""

from __future__ import annotations

import copy
import json
import resource
import signal
import sys
import zipfile
from collections.abc import Callable, Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import yaml

from fieldtwin.acoustic.network import load_network
from fieldtwin.capture.decoding.trace_file import read_events
from fieldtwin.capture.formats.can_files import read_can_file
from fieldtwin.capture.formats.csv_table import import_csv
from fieldtwin.capture.formats.packet_file import PacketFile
from fieldtwin.capture.formats.pcap import read_capture
from fieldtwin.capture.recordings.importing import kind_of
from fieldtwin.conformance.core.waivers import load_waivers
from fieldtwin.emulators.canopen.eds.dictionary import load_eds
from fieldtwin.emulators.faults.schema import load_faults
from fieldtwin.emulators.replay.can_log import CanLog
from fieldtwin.gateway.core.errors import FieldtwinError
from fieldtwin.gateway.core.files.candump import LeftOut, read_log
from fieldtwin.gateway.core.files.profile_file import load_profile
from fieldtwin.gateway.core.files.recording import RecordingReader
from fieldtwin.gateway.protocols.canopen.eds.dictionary import load_dictionary
from fieldtwin.plc.st.program import load_source
from fieldtwin.run.shadow.rules import load_planner
from fieldtwin.run.what_if.plan import load_plans
from fieldtwin.run.what_if.state import read_state
from fieldtwin.scenarios.language.form import load_scenario
from fieldtwin.twin.prototype.file import load_prototype
from fieldtwin.twin.site.groups import group_file
from fieldtwin.twin.site.system import load_system
from fieldtwin.twin.template.package import open_package

MEMORY_BYTES = 192 * 1024 * 1024
"""Memory limit for reading, in addition to the program itself."""
SECONDS = 20
"""Time limit per file; a file that is refused at once takes milliseconds."""
SHIPPED = Path(__file__).resolve().parents[3] / "profiles"
SYSTEM = load_system("observatory")

Reader = Callable[[Path], object]


def rows(path: Path) -> object:
    with RecordingReader(path) as reader:
        return list(reader.rows() if reader.header.kind == "signals" else reader.exchanges())


def packets(path: Path) -> object:
    with PacketFile(path) as file:
        return sum(1 for _ in file)


def template(path: Path) -> object:
    with open_package(path) as package:
        return package.manifest


def cast(path: Path) -> object:
    from fieldtwin.capture.formats.cnv import import_cnv

    return import_cnv(path, path.with_name("cast.out"))


def table(path: Path) -> object:
    return import_csv(path, path.with_name("table.out"), columns={})


YAML_READERS: dict[str, tuple[Reader, str]] = {
    "system": (lambda p: load_system(str(p)), "systems/observatory.yaml"),
    "prototype": (lambda p: load_prototype(SYSTEM, p), "systems/observatory.prototype.yaml"),
    "profile": (load_profile, "devices/ctd-reference.yaml"),
    "network": (load_network, "systems/ocean_network.yaml"),
    "scenario": (load_scenario, "systems/late-replies.scenario.yaml"),
    "faults": (load_faults, ""),
    "plans": (load_plans, ""),
    "rules": (lambda p: load_planner(str(p), SYSTEM), ""),
    "waivers": (lambda p: load_waivers(p, ["MB-001"]), ""),
}
OTHER_READERS: dict[str, Reader] = {
    "network or system": group_file,
    "EDS of the gateway": load_dictionary,
    "EDS of the emulator": load_eds,
    "Structured Text or PLCopen XML": load_source,
    "recording": rows,
    "recording of a CAN bus": lambda p: list(CanLog(p).frames()),
    "candump": lambda p: sum(1 for _ in read_log(p)),
    "pcap": packets,
    "capture": lambda p: sum(1 for _ in read_capture(p)),
    "trace": lambda p: sum(1 for _ in read_events(p, SYSTEM)),
    "CSV": table,
    "CNV": cast,
    "import": kind_of,
    "template": template,
    "state": lambda p: read_state(p, SYSTEM),
}
CAN_READERS: dict[str, Reader] = {
    s: lambda p: sum(1 for _ in read_can_file(p, LeftOut())) for s in ("asc", "blf", "trc")
}

GIVEN: dict[str, Any] = {
    "faults": {
        "faults": [{"name": "delay", "by_ms": 800, "device": "ctd", "from": "5s", "every": 10, "probability": 0.5}]
    },
    "plans": {"what_if": "observatory", "plans": [{"name": "a", "commands": [{"at": "5s", "period_s": 1}]}]},
    "rules": {
        "limits": {"ctd.temperature": [0.0, 30.0]},
        "rules": [{"when": "outside", "of": "ctd.temperature", "period_s": 1}],
    },
    "waivers": {"waivers": [{"case": "MB-001", "reason": "x", "owner": "y", "until": "2027-01-01"}]},
}


def nested(levels: int) -> Any:
    return [] if levels == 0 else [nested(levels - 1)]


SHARED: list[Any] = ["x"] * 9
for _ in range(8):
    SHARED = [SHARED] * 9  # written with anchors and aliases: 9 to the power of 9 values in a few lines
SCALARS: tuple[Any, ...] = (
    10**30, -(10**30), 2**63, float("nan"), float("inf"), -1, datetime(2026, 11, 21, tzinfo=UTC), "<script>", "\x1b[31m",
    nested(40), {"a": 1}, None, True, "",
)  # fmt: skip


def leaves(data: Any, at: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    items = data.items() if isinstance(data, dict) else enumerate(data) if isinstance(data, list) else None
    if items is None:
        yield at
        return
    for key, value in items:
        yield from leaves(value, (*at, key))


def with_values(data: Any, number: int) -> Iterator[Any]:
    """Copies of `data` in which one leaf is a hostile value; `number` values for each leaf, in turn."""
    turn = 0
    for path in list(leaves(data)):
        for _ in range(number):
            made = copy.deepcopy(data)
            parent = made
            for key in path[:-1]:
                parent = parent[key]
            parent[path[-1]] = SCALARS[turn % len(SCALARS)]
            turn += 1
            yield made


def yaml_files(folder: Path, kind: str, shipped: str) -> Iterator[Path]:
    path = folder / (kind + (".scenario.yaml" if kind == "scenario" else ".yaml"))
    data = yaml.safe_load((SHIPPED / shipped).read_text()) if shipped else GIVEN[kind]
    for made in with_values(data, 1):
        path.write_text(yaml.safe_dump(made, allow_unicode=True))
        yield path
    first = next(iter(data))
    for value in ("9" * 5000, "0x" + "F" * 5000, "1.0e999", ".nan", "2026-11-21", "[" * 3000, "[" * 900 + "]" * 900):
        path.write_text(f"{first}: {value}\n")
        yield path
    path.write_text(yaml.safe_dump({first: SHARED}))
    yield path


def odd_files(folder: Path) -> Iterator[Path]:
    """Pipes, devices, links and files without an end, as the test created them."""
    yield from sorted(folder.glob("odd-*"))


def zip_bomb(path: Path) -> Path:
    opened = zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED)
    with opened as archive, archive.open("template.json", "w", force_zip64=True) as file:
        for _ in range(256):
            file.write(bytes(1 << 20))
    return path


def attempts(folder: Path, kinds: list[str]) -> Iterator[tuple[str, Reader, Path]]:
    for kind, (reader, shipped) in YAML_READERS.items():
        if "values" in kinds:
            yield from ((kind, reader, path) for path in yaml_files(folder, kind, shipped))
        if "odd" in kinds:
            yield from ((kind, reader, path) for path in odd_files(folder))
    if "odd" in kinds:
        for kind, reader in OTHER_READERS.items():
            yield from ((kind, reader, path) for path in odd_files(folder))
        for suffix, reader in CAN_READERS.items():
            for path in odd_files(folder):
                if path.is_dir():
                    continue
                link = folder / f"can-{path.name}.{suffix}"
                link.symlink_to(path)
                yield f"CAN log .{suffix}", reader, link
        yield "template", template, zip_bomb(folder / "bomb.zip")


def outcome(reader: Reader, path: Path) -> tuple[str, str]:
    signal.alarm(SECONDS)
    try:
        reader(path)
    except FieldtwinError as e:
        return type(e).__name__, str(e)
    except BaseException as e:
        return f"UNTYPED {type(e).__name__}", str(e)[:200]
    finally:
        signal.alarm(0)
    return "read", ""


def too_long(*_: object) -> None:
    raise TimeoutError(f"not over after {SECONDS} s")


def main() -> None:
    folder, kinds = Path(sys.argv[1]), sys.argv[2:]
    load_source(SHIPPED / "systems" / "relay.st")  # the compiler is loaded before the memory is limited
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + MEMORY_BYTES,) * 2)
    signal.signal(signal.SIGALRM, too_long)
    for kind, reader, path in attempts(folder, kinds):
        result, said = outcome(reader, path)
        name = path.name if kind not in YAML_READERS or path.name.startswith("odd-") else path.read_text()[:100_000]
        print(json.dumps([kind, name, result, said]))


if __name__ == "__main__":
    main()
