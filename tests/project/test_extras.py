"""The package of an extra is imported only when used, and an error names the extra; without `perf` everything works."""

from __future__ import annotations

import asyncio
import re
import sys
import tomllib
from collections.abc import Callable
from importlib import import_module
from pathlib import Path

import pytest

from fieldtwin.capture.formats.mcap_file import McapFile
from fieldtwin.capture.recordings.exporting import TableColumn, _write_parquet
from fieldtwin.cli.main import cli
from fieldtwin.commissioning.access.plotting import check_plot
from fieldtwin.descriptions.aas.aid import require_library as require_aas
from fieldtwin.descriptions.canopen.dbc import export_description
from fieldtwin.emulators.simulation.fmu.description import describe
from fieldtwin.gateway.core.errors import UsageError
from fieldtwin.gateway.core.files.profile_file import load_profile
from fieldtwin.gateway.store.knowledge import open_knowledge
from fieldtwin.gateway.wallclock import WallClock
from fieldtwin.installation import install_hint
from fieldtwin.northbound.process_config import require_packages
from fieldtwin.plc.st.model_checking.solver import require_solver
from fieldtwin.run.fmu_export.packing import ExportOptions, export_fmu
from fieldtwin.run.places.clusters import place_named
from fieldtwin.run.processes import event_loop as loops
from fieldtwin.twin.prototype.file import load_prototype
from fieldtwin.twin.site.servers.serving_opcua import OpcuaServeConfig
from fieldtwin.twin.site.system import load_system
from fieldtwin.twin.thread.place import twin_carrier

CHECKOUT = Path(__file__).parents[2]
PROJECT = tomllib.loads((CHECKOUT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
EXTRAS: dict[str, list[str]] = PROJECT["optional-dependencies"]


def use_mqtt(folder: Path) -> None:
    system = load_system(str(CHECKOUT / "profiles/systems/observatory.yaml"))
    twin_carrier("mqtt://broker/sea/observatory", system, WallClock())


def use_postgres(folder: Path) -> None:
    asyncio.run(open_knowledge("postgresql://nobody@127.0.0.1:1/none"))


def use_opcua(folder: Path) -> None:
    require_packages(OpcuaServeConfig("scada", "127.0.0.1", 4840))


def use_mcp(folder: Path) -> None:
    cli.main(["mcp", str(folder)], standalone_mode=False)


def use_plot(folder: Path) -> None:
    check_plot(folder / "x.png")


def use_parquet(folder: Path) -> None:
    _write_parquet(folder / "x.parquet", [TableColumn("t", float)], iter([(1.0,)]))


def use_mcap(folder: Path) -> None:
    McapFile(folder / "x.mcap", {})


def use_fmi(folder: Path) -> None:
    (folder / "tank.fmu").write_bytes(b"")
    describe(folder / "tank.fmu")


def use_fmi_export(folder: Path) -> None:
    system = load_system(str(CHECKOUT / "examples/tank-fmu/tank.yaml"))
    prototype = load_prototype(system, CHECKOUT / "examples/tank-fmu/drive.prototype.yaml")
    export_fmu(system, prototype, folder / "x.fmu", ExportOptions())


def use_dbc(folder: Path) -> None:
    export_description(load_profile(CHECKOUT / "profiles/devices/io-cia401.yaml"), {})


def use_aas(folder: Path) -> None:
    require_aas()


def use_cluster(folder: Path) -> None:
    place_named("dask://127.0.0.1:8786", None)


def use_prove(folder: Path) -> None:
    require_solver()


USES: dict[str, tuple[str, Callable[[Path], None], str]] = {
    "aiomqtt": ("mqtt", use_mqtt, "fieldtwin.twin.thread.mqtt.session"),
    "asyncua": ("opcua", use_opcua, ""),
    "asyncpg": ("postgres", use_postgres, "fieldtwin.gateway.store.postgres_knowledge"),
    "mcp": ("mcp", use_mcp, "fieldtwin.agents.mcp_server"),
    "distributed": ("cluster", use_cluster, "fieldtwin.run.places.dask_place"),
    "matplotlib": ("plot", use_plot, ""),
    "fmpy": ("fmi", use_fmi, ""),
    "pythonfmu": ("fmi", use_fmi_export, ""),
    "pyarrow": ("parquet", use_parquet, ""),
    "mcap": ("mcap", use_mcap, ""),
    "z3": ("prove", use_prove, ""),
    "cantools": ("dbc", use_dbc, ""),
    "basyx": ("aas", use_aas, ""),
}

DISTRIBUTIONS = {"basyx": "basyx-python-sdk", "z3": "z3-solver"}
"""The distribution of each package whose name differs."""


@pytest.mark.parametrize("package", list(USES))
def test_a_missing_extra_is_reported_with_its_package(
    package: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    extra, use, ours = USES[package]
    wanted = [re.split("[ ><=]", one)[0] for one in EXTRAS[extra]]
    assert wanted == [DISTRIBUTIONS.get(one, one) for one, (of, _, _) in USES.items() if of == extra]
    if ours:
        monkeypatch.delitem(sys.modules, ours, raising=False)
        parent, _, name = ours.rpartition(".")
        monkeypatch.delattr(import_module(parent), name, raising=False)
    for loaded in [m for m in sys.modules if m == package or m.startswith(f"{package}.")]:
        monkeypatch.delitem(sys.modules, loaded)
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(UsageError, match=re.escape(install_hint(extra))):
        use(tmp_path)


@pytest.mark.parametrize("there", [False, True])
def test_perf_only_makes_it_faster(there: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    if there:
        pytest.importorskip("uvloop")
    else:
        monkeypatch.setitem(sys.modules, "uvloop", None)

    async def which() -> str:
        return type(asyncio.get_running_loop()).__module__.partition(".")[0]

    assert (loops.run(which()) == "uvloop") == there
    assert loops.run(which(), serial=True) != "uvloop"  # it waits in whole milliseconds


def test_every_extra_is_on_the_page_and_the_rest_is_there_without() -> None:
    page = (CHECKOUT / "docs" / "reference" / "packages.md").read_text(encoding="utf-8")
    table = page[page.index("| extra |") :]
    assert re.findall(r"^\| `([a-z]+)` \|", table.split("\n\n")[0], re.M) == sorted(EXTRAS, key=table.index)
    named = {re.split("[ ><=;]", wanted)[0] for wanted in PROJECT["dependencies"]}
    assert named.isdisjoint(USES)
