"""The container files and scripts are consistent, as far as this can be checked without a Docker engine.

scripts/test-compose tests the containers themselves. Here: the compose file requests no privilege, its command lines and
variables are known to `fieldtwin`, its paths exist in the image; and the same three processes, started by hand from the same
prototype file, work together.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import Any

import click
import pytest
import yaml
from procs import CHECKOUT, fieldtwin, free_port, no_tracebacks, run_to_end, wait_for

from fieldtwin.cli.main import cli
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import UsageError
from fieldtwin.run.processes.field_contact import reachable
from fieldtwin.run.shadow.shadow import Shadowing
from fieldtwin.run.shadow.twin import Twinning
from fieldtwin.twin.prototype.file import load_prototype
from fieldtwin.twin.site.system import load_system

IMAGE_SHARE = "/opt/fieldtwin/share/"
SYSTEMS = CHECKOUT / "profiles" / "systems"
PROTOTYPE_FILE = SYSTEMS / "observatory.compose.yaml"
DOCKERFILE = (CHECKOUT / "Dockerfile").read_text(encoding="utf-8")
COMPOSE: dict[str, Any] = yaml.safe_load((CHECKOUT / "docker-compose.yml").read_text(encoding="utf-8"))
SERVICES: dict[str, Any] = COMPOSE["services"]
OURS = {name: service for name, service in SERVICES.items() if service["image"].startswith("fieldtwin")}
VARIABLE = r"\$\{[A-Z_]+:-([^}]*)\}"
"""The variables of the file with their default values."""
SCRIPTS = [*sorted(p for p in (CHECKOUT / "scripts").iterdir() if p.is_file() and not p.suffix), CHECKOUT / ".ci/run"]


# -- the compose file -----------------------------------------------------------------------------------------------


def profile(name: str) -> set[str]:
    return {service for service, form in SERVICES.items() if name in form["profiles"]}


def test_profiles_have_the_services_that_they_are_for() -> None:
    assert profile("prototype") == {"field", "controller", "topside"}
    assert profile("physical") == {"controller-physical"}
    assert profile("twin") == {"field", "controller-twin", "topside-twin", "broker", "shadow", "twin"}
    assert profile("vcan") == {"vcan", "field-vcan", "controller-vcan"}
    assert profile("own-plc") == {"field-own-plc"}
    assert profile("monitoring") == {"field", "controller-monitored", "prometheus", "grafana"}
    assert (CHECKOUT / ".env").read_text(encoding="utf-8").splitlines()[-1] == "COMPOSE_PROFILES=prototype"


def test_a_dependency_starts_in_the_same_profile() -> None:
    """Compose 1.29 and 2 both refuse a service that depends on one omitted by its profile."""
    for name, service in SERVICES.items():
        for other in service.get("depends_on", {}):
            assert set(service["profiles"]) <= set(SERVICES[other]["profiles"]), (name, other)


def test_no_privileges_but_one_and_ports_are_published_on_loopback_only() -> None:
    for name, service in SERVICES.items():
        assert service["read_only"] is True, name
        assert service["cap_drop"] == ["ALL"], name
        assert "no-new-privileges:true" in service["security_opt"], name
        assert not {"privileged", "pid", "ipc", "userns_mode", "container_name", "external"} & set(service), name
    assert {n: s["cap_add"] for n, s in SERVICES.items() if "cap_add" in s} == {"vcan": ["NET_ADMIN"]}
    assert {n for n, s in SERVICES.items() if s.get("user") == "0:0"} == {"vcan"}, "and it ends at once"
    assert {n for n, s in SERVICES.items() if "devices" in s} == {"controller-physical"}
    assert {n for n, s in SERVICES.items() if s.get("network_mode") == "host"} == {
        "controller-physical", *profile("vcan"),
    }  # fmt: skip
    ports = {n: s["ports"] for n, s in SERVICES.items() if "ports" in s}
    assert ports == {
        "field-own-plc": ["${FIELDTWIN_BIND:-127.0.0.1}:${FIELDTWIN_PORT:-1502}:1502"],
        "prometheus": ["127.0.0.1:${FIELDTWIN_PROMETHEUS_PORT:-9090}:9090"],
        "grafana": ["127.0.0.1:${FIELDTWIN_GRAFANA_PORT:-3000}:3000"],
    }
    assert COMPOSE["networks"]["field"] == {"internal": True}
    assert re.search(r"^USER fieldtwin$", DOCKERFILE, re.MULTILINE)


def test_one_image_of_ours_and_three_public_ones() -> None:
    images = {re.sub(VARIABLE, r"\1", service["image"]) for service in SERVICES.values()}
    assert images == {
        "fieldtwin:compose", "eclipse-mosquitto:2", "prom/prometheus:v3.5.0", "grafana/grafana:12.0.2",
    }  # fmt: skip
    assert {s["build"] for s in OURS.values()} == {"."}


def test_services_wait_for_health_and_never_sleep() -> None:
    assert SERVICES["controller"]["depends_on"] == {"field": {"condition": "service_healthy"}}
    assert SERVICES["topside"]["depends_on"] == {"controller": {"condition": "service_healthy"}}
    ended = {"topside", "topside-twin", "vcan"}
    for name, service in OURS.items():
        assert (name in ended) or service["healthcheck"]["test"][:2] == ["CMD", "container-health"]
    assert "sleep" not in str(COMPOSE)
    assert "version" not in COMPOSE  # compose 2 warns about it; 1.29 reads the file by the specification without it


def test_a_mounted_folder_exists_and_is_read_only() -> None:
    for name, service in SERVICES.items():
        for volume in service.get("volumes", []):
            source, _, rest = re.sub(VARIABLE, r"\1", volume).partition(":")
            if source.startswith("."):
                assert (CHECKOUT / source).exists(), name
                assert rest.endswith(":ro")
            else:
                assert source in COMPOSE["volumes"], "a named one: of this project, so that a second one has its own"


@pytest.mark.parametrize("service", [name for name in OURS if name != "vcan"])
def test_a_service_s_command_line_and_variables_are_known_to_the_program(service: str) -> None:
    mounts = {m.split(":")[1]: m.split(":")[0] for m in mounted(service) if m.startswith(".")}
    texts = [re.sub(VARIABLE, r"\1", a).replace(IMAGE_SHARE, f"{CHECKOUT}/") for a in SERVICES[service]["command"]]
    for inside, outside in mounts.items():
        texts = [text.replace(f"{inside}/", f"{CHECKOUT / outside}/") for text in texts]
    name, *args = texts
    command = cli.get_command(click.Context(cli), name)
    assert command is not None
    context = command.make_context(name, list(args))  # raises for an unknown option or a missing file
    variables = {f"FIELDTWIN_{name.upper()}_{(p.name or '').upper()}" for p in context.command.params}
    judging = cli.get_command(click.Context(cli), "test")  # runs in addition in the container of a service
    assert judging is not None
    variables |= {f"FIELDTWIN_TEST_{(p.name or '').upper()}" for p in judging.params}
    environment = SERVICES[service].get("environment", {})
    assert set(environment) <= variables
    if "token" in {p.name for p in context.command.params} and service != "controller-physical":
        token = environment[f"FIELDTWIN_{name.upper()}_TOKEN"]
        assert token == "${FIELDTWIN_TOKEN:-for-demonstration-only}"


def mounted(service: str) -> list[str]:
    return [re.sub(VARIABLE, r"\1", volume) for volume in SERVICES[service].get("volumes", [])]


def test_the_memory_disk_is_the_run_directory_and_belongs_to_the_image_s_user() -> None:
    match = re.search(r"FIELDTWIN_RUN=(\S+)", DOCKERFILE)
    uid = re.search(r"useradd --uid (\d+)", DOCKERFILE)
    assert match
    assert uid
    for service in OURS.values():
        where, _, options = service["tmpfs"][0].partition(":")
        assert where == match[1]
        assert {f"uid={uid[1]}", "mode=700"} <= set(options.split(","))
    checked = {name: s["healthcheck"]["test"][2:] for name, s in OURS.items() if "healthcheck" in s}
    plain = [f"{match[1]}/observatory/{p}.sock" for p in ("gateway", "plc")]
    assert checked["field"] == checked["field-vcan"] == [f"{match[1]}/observatory-field/field.sock"]
    assert checked["controller"] == checked["controller-twin"] == checked["controller-vcan"] == plain
    assert checked["controller-monitored"] == plain
    assert checked["controller-physical"] == [f"{match[1]}/plant/{p}.sock" for p in ("gateway", "plc")]
    assert checked["field-own-plc"] == [f"{match[1]}/field/field.sock"]
    assert checked["shadow"] == [f"{match[1]}/observatory-shadow/{Shadowing.kind}.sock"]
    assert checked["twin"] == [f"{match[1]}/observatory-twin/{Twinning.kind}.sock"]


def test_prometheus_and_grafana_find_what_the_profile_mounts() -> None:
    monitoring = CHECKOUT / "packaging" / "monitoring"
    config = yaml.safe_load((monitoring / "prometheus.yml").read_text(encoding="utf-8"))
    (job,) = config["scrape_configs"]
    metrics = SERVICES["controller-monitored"]["environment"]["FIELDTWIN_RUN_METRICS"]
    assert job["static_configs"] == [{"targets": [f"controller-monitored:{metrics.partition(':')[2]}"]}]
    assert all((monitoring / name).is_file() for name in config["rule_files"])
    (source,) = yaml.safe_load((monitoring / "grafana/datasources/prometheus.yml").read_text())["datasources"]
    assert source["url"] == "http://prometheus:9090"
    assert source["jsonData"]["timeInterval"] == config["global"]["scrape_interval"]
    (provider,) = yaml.safe_load((monitoring / "grafana/dashboards/fieldtwin.yml").read_text())["providers"]
    inside = [volume.split(":")[1] for volume in SERVICES["grafana"]["volumes"]]
    assert inside == ["/etc/grafana/provisioning", f"{provider['options']['path']}/fieldtwin.dashboard.json"]
    home = SERVICES["grafana"]["environment"]["GF_DASHBOARDS_DEFAULT_HOME_DASHBOARD_PATH"]
    assert home == inside[1]


def test_stores_are_in_folders_that_the_images_user_may_write() -> None:
    kept = re.search(r"install -d -o fieldtwin -g fieldtwin -m 700 (.*)$", DOCKERFILE, re.MULTILINE)
    assert kept
    for service in ("controller-twin", "shadow", "twin"):
        assert [m.split(":")[1] for m in mounted(service)] == [kept[1].split()[1]]


# -- what goes into the image -----------------------------------------------------------------------------------------


def test_the_build_sees_everything_that_the_wheel_is_made_of() -> None:
    lines = (CHECKOUT / ".dockerignore").read_text(encoding="utf-8").splitlines()
    let_in = {line[1:] for line in lines if line.startswith("!")}
    assert all((CHECKOUT / name).exists() for name in let_in)
    project = tomllib.loads((CHECKOUT / "pyproject.toml").read_text(encoding="utf-8"))
    wheel = project["tool"]["hatch"]["build"]["targets"]["wheel"]
    needed = {*wheel["packages"], *wheel["force-include"], project["project"]["readme"], "pyproject.toml"}
    assert {*needed, *project["project"]["license-files"]} <= let_in
    assert re.search(r"COPY --from=build /src/(scripts/container-health) /usr/local/bin/container-health", DOCKERFILE)
    assert "scripts/container-health" in let_in


@pytest.mark.parametrize("name", ["observatory.compose.yaml", "observatory.vcan.yaml"])
def test_the_prototype_file_differs_from_the_shipped_one_only_in_its_endpoints(name: str) -> None:
    system = load_system(str(SYSTEMS / "observatory.yaml"))
    here, there = load_prototype(system), load_prototype(system, SYSTEMS / name)
    for bus in there.buses.values():
        assert bus.listen is not None
        assert bus.pace == here.buses[bus.name].pace
        if name == PROTOTYPE_FILE.name:
            assert bus.listen.address[0] == "0.0.0.0"
            assert bus.listen.address[1] != 0, "other containers and firewalls want to know the port beforehand"
        elif bus.name == "can0":
            assert str(bus.listen) == "can:socketcan/vcan0"
        else:
            assert bus.listen.address == ("127.0.0.1", 0), "a host's network: nobody else's business, and no clash"
    assert there.seed == here.seed
    for name, device in there.devices.items():
        ours = here.devices[name].form.model_dump(exclude={"far"})
        assert device.form.model_dump(exclude={"far"}) == ours, name


# -- the same processes, started by hand -------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("listening", "host", "seen"),
    [
        ("tcp://0.0.0.0:1502", "field", "tcp://field:1502"),
        ("can:fieldtwin/0.0.0.0:29536", "field", "can:fieldtwin/field:29536"),
        ("tcp://[::]:1502", "fd00::7", "tcp://[fd00::7]:1502"),
        ("tcp://10.0.0.9:1502", "field", "tcp://10.0.0.9:1502"),
        ("tcp://127.0.0.1:1502", "localhost", "tcp://127.0.0.1:1502"),
        ("can:socketcan/vcan0", "field", "can:socketcan/vcan0"),
    ],
)
def test_a_wildcard_address_is_reached_by_the_name_of_its_host(listening: str, host: str, seen: str) -> None:
    """By name, not by its current address: a restarted container may have a different one."""
    assert str(reachable(Endpoint.parse(listening), host)) == seen


@pytest.mark.parametrize("listening", ["pty:line1", "tcp://127.0.0.1:1502", "can:fieldtwin/127.0.0.1:29536"])
def test_options_for_the_field_host_are_refused_elsewhere(listening: str) -> None:
    with pytest.raises(UsageError, match="prototype file"):
        reachable(Endpoint.parse(listening), "field")


def container_health(*sockets: Path) -> tuple[int, str]:
    """Return the output of a container's health check."""
    done = subprocess.run(
        [sys.executable, str(CHECKOUT / "scripts" / "container-health"), *map(str, sockets)],
        capture_output=True, text=True, timeout=20, check=False,
    )  # fmt: skip
    return done.returncode, done.stdout.strip()


@pytest.mark.timeout(150)  # a topside controller that runs 8 s, and four starts: half a minute on a busy computer
@pytest.mark.long
def test_field_controller_and_shore_as_three_separate_processes(tmp_path: Path) -> None:
    """Run the compose file's three commands on free ports, and check the health checks, exit codes and the summary that it
    relies on."""
    text = PROTOTYPE_FILE.read_text(encoding="utf-8")
    prototype = tmp_path / "any-port.yaml"
    prototype.write_text(re.sub(r"0\.0\.0\.0:\d+", "0.0.0.0:0", text), encoding="utf-8")
    port = free_port()
    emulate = ("emulate", "observatory", f"--prototype-file={prototype}", f"--control=0.0.0.0:{port}")
    run = ("run", "observatory", "--prototype", f"--field=localhost:{port}", "--commands=none")
    topside = (
        "topside",
        "observatory",
        f"--field=localhost:{port}",
        "--commands=1,2,0,-1",
        "--for=8s",
        f"--token=@{tmp_path}/right",
    )
    (tmp_path / "right").write_text("s3cret\n", encoding="utf-8")
    run_env = {"FIELDTWIN_RUN_TOKEN": "s3cret", "FIELDTWIN_RUN_AS_JSON": "1"}
    field_socket = tmp_path / "observatory-field" / "field.sock"
    sockets = [tmp_path / "observatory" / f"{p}.sock" for p in ("gateway", "plc")]

    assert container_health(field_socket)[0] == 1
    with fieldtwin(tmp_path, *emulate, name="field", env={"FIELDTWIN_EMULATE_TOKEN": "s3cret"}) as field:
        wait_for(lambda: container_health(field_socket) == (0, "ok"), 20, "the field simulator is healthy")
        (tmp_path / "wrong").write_text("wrong\n", encoding="utf-8")
        stranger = run_to_end(tmp_path, *run, f"--token=@{tmp_path}/wrong", name="stranger")
        assert stranger.process.returncode != 0
        assert "token" in stranger.err
        with fieldtwin(tmp_path, *run, name="run", env=run_env) as controller:
            wait_for(lambda: container_health(*sockets) == (0, "ok"), 20, "the controller is healthy")
            ashore = run_to_end(tmp_path, *topside, name="topside")
            assert ashore.process.returncode == 0, ashore.err
            relay = ["STANDBY", "ACTIVE", "STANDBY", "OFF"]
            controller.signal(15)
            assert controller.wait(10) == 0, controller.out + controller.err
            summary = controller.summary
            assert summary["ok"]
            assert summary["states"]["relay"] == relay
            assert (
                summary["topside"] is None
            )  # it belongs to the topside controller; a second client would take its responses
        with fieldtwin(tmp_path, *run, name="again", env=run_env):
            wait_for(lambda: container_health(*sockets)[0] == 0, 20, "healthy again")
            field.process.kill()
            field.process.wait()
            wait_for(lambda: all(d in container_health(*sockets)[1] for d in ("ctd", "inclinometer", "modem")), 20)
            assert container_health(*sockets)[0] == 1
    no_tracebacks(tmp_path)


# -- scripts ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda p: p.name)
def test_a_script_may_be_run_and_reads_well(script: Path) -> None:
    assert os.access(script, os.X_OK)
    text = script.read_text(encoding="utf-8")
    if text.startswith("#!/usr/bin/env bash"):
        assert "set -euo pipefail" in text
        subprocess.run(["bash", "-n", str(script)], check=True)
    else:
        assert text.startswith("#!/usr/bin/env python3")
        compile(text, str(script), "exec")
