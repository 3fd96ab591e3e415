"""Checks the references of a compose file: systems, buses, ports, mounted paths, options, variables and health checks."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Protocol

from fieldtwin.gateway.core.errors import FileInvalid, UsageError
from fieldtwin.gateway.core.files.nearest import did_you_mean
from fieldtwin.gateway.core.files.yaml_file import YamlFile
from fieldtwin.site.compose.service import Service, WrongWord, resolved, services_of
from fieldtwin.twin.prototype.file import load_prototype
from fieldtwin.twin.site.system import System, load_system

_RUNS_A_SYSTEM = ("run", "emulate", "topside", "shadow", "twin")
_INSTANCE_SUFFIX = {"emulate": "-field", "shadow": "-shadow", "twin": "-twin"}
_PORT = re.compile(r":(\d+)(?![\d:])")
_SOCKET = re.compile(r".*/([^/]+)/(\w+)\.sock")
_INSIDE = ("127.0.0.1", "::1", "localhost")
_VARIABLE = re.compile(r"FIELDTWIN_([A-Z]+(?:_[A-Z]+)?)_\w+")


class CommandLines(Protocol):
    """The interface to the commands of fieldtwin and their options."""

    def wrong_words(self, words: Sequence[str], /) -> Iterable[WrongWord]:
        """Return the words of a command line that are wrong."""

    def variables_of(self, command: str, /) -> Sequence[str]:
        """Return the environment variables that set a command's options; an unknown command has none."""


class ComposeCheck:
    """The check of one compose file. `systems` are the systems of the site that were read already, also those with errors."""

    def __init__(
        self,
        file: YamlFile,
        profiles: tuple[Path, ...],
        systems: Mapping[Path, System],
        broken: Iterable[Path],
        command_lines: CommandLines,
    ) -> None:
        self._file = file
        self._profiles = profiles
        self._systems = {path.resolve(): system for path, system in systems.items()}
        self._broken = {path.resolve() for path in broken}
        self._command_lines = command_lines
        self._hosts = _hosts(file)

    def errors(self) -> Iterator[FileInvalid]:
        """Yield each dangling reference of the services that run fieldtwin."""
        for service in services_of(self._file):
            yield from self._service_errors(service)

    def _service_errors(self, service: Service) -> Iterator[FileInvalid]:
        local, missing = {}, set()
        for index, word in enumerate(service.words):
            path = word.partition("=")[2] if word.startswith("-") else word
            on_host = service.local(path) if path.startswith("/") else None
            if on_host is not None:
                local[index] = word.replace(path, str(on_host))
                if not on_host.exists():
                    missing.add(index)
                    yield self._missing(service, index, path, on_host)
        words = [local.get(index, word) for index, word in enumerate(service.words)]
        for wrong in self._command_lines.wrong_words(words):
            if wrong.index not in missing and not (wrong.index == 0 and missing and "exist" in wrong.message):
                yield self._file.error(
                    service.word(wrong.index), wrong.message, expected=wrong.expected, hint=wrong.hint
                )
        yield from self._variable_errors(service)
        yield from self._field_errors(service)
        if service.words[0] in _RUNS_A_SYSTEM and not missing & {1}:
            yield from self._system_errors(service, words)

    def _missing(self, service: Service, index: int, path: str, on_host: Path) -> FileInvalid:
        beside = [entry.name for entry in on_host.parent.iterdir()] if on_host.parent.is_dir() else []
        return self._file.error(
            service.word(index),
            f"no file {path!r}",
            expected=f"a path in the mounted folder {on_host.parent}",
            hint=did_you_mean(on_host.name, beside),
        )

    def _variable_errors(self, service: Service) -> Iterator[FileInvalid]:
        for name in service.environment:
            match = _VARIABLE.fullmatch(name)
            for command in _commands_of(match[1]) if match else ():
                known = self._command_lines.variables_of(command)
                if known and name not in known:
                    message = f"{command} has no option for the variable {name!r}"
                    at = (*service.at, "environment", name)
                    yield self._file.error(at, message, hint=did_you_mean(name, known))
                if known:
                    break

    def _system_errors(self, service: Service, words: Sequence[str]) -> Iterator[FileInvalid]:
        if len(words) < 2 or words[1].startswith("-"):
            return
        named = service.words[1]
        if not named.startswith("/") and ("/" in named or named.endswith(".yaml")):
            yield self._file.error(
                service.word(1), "a relative path of a file", expected="a path below a mounted folder"
            )
            return
        if named.startswith("/") and service.local(named) is None:
            folders = ", ".join(service.folders)
            message = f"{named!r} is below no mounted folder"
            yield self._file.error(service.word(1), message, expected=f"a file below {folders}")
            return
        system = self._system(words[1])
        if isinstance(system, FileInvalid):
            yield self._file.error(service.word(1), system.message, expected=system.expected, hint=system.hint)
        elif system is not None:
            yield from self._bus_errors(service, system)
            yield from self._health_errors(service, system)
            yield from self._port_errors(service, system, words)

    def _system(self, name: str) -> System | FileInvalid | None:
        """Return the system, an error for a name that does not exist, or None for a file whose errors are reported already."""
        path = Path(name).resolve()
        if path in self._systems or path in self._broken:
            return self._systems.get(path)
        try:
            return load_system(name, self._profiles)
        except UsageError as e:
            return FileInvalid(e.message, path=self._file.path, expected=e.expected, hint=e.hint)
        except FileInvalid:
            return None  # a network, a fleet or a device: it defines no buses

    def _bus_errors(self, service: Service, system: System) -> Iterator[FileInvalid]:
        if service.words[0] != "emulate":
            return
        for index, value in service.options("listen"):
            bus = value.partition("=")[0]
            if bus not in system.file.section("buses"):
                yield self._file.error(
                    service.word(index),
                    f"no bus {bus!r} in {system.path.name}",
                    expected="one of " + ", ".join(system.buses),
                    hint=did_you_mean(bus, system.buses),
                )

    def _health_errors(self, service: Service, system: System) -> Iterator[FileInvalid]:
        """Yield an error for each socket in the health check that the service never creates, so that the service would never
        be healthy.
        """
        command = service.words[0]
        given = service.option("instance")
        instance = given[1] if given else system.name + _INSTANCE_SUFFIX.get(command, "")
        made = {"emulate": ["field"], "run": ["gateway", "plc"]}.get(command, [command])
        if command == "run" and not system.file.section("plc").get("programs"):
            made = ["gateway"]
        for index, word in enumerate(service.health):
            match = _SOCKET.fullmatch(word)
            if match and "${" not in instance and (match[1] != instance or match[2] not in made):
                expected = " or ".join(f"{instance}/{name}.sock" for name in made)
                message = f"the health check waits for a socket that this service does not have: {word}"
                yield self._file.error((*service.at, "healthcheck", "test", index), message, expected=expected)

    def _port_errors(self, service: Service, system: System, words: Sequence[str]) -> Iterator[FileInvalid]:
        """Yield an error for each published port at which no process in the container listens."""
        if service.words[0] not in ("run", "emulate") or any("${" in word for word in words):
            return
        listening = {int(port) for word in [*words, *service.environment.values()] for port in _PORT.findall(word)}
        if service.words[0] == "run" and "--plant" in words:
            endpoints = [one.listen for one in system.serving.serve] + [one.listen for one in system.serving.bridges]
            listening |= {one.port for one in endpoints if not one.is_serial and one.host not in _INSIDE}
            listening |= {one.port for one in system.serving.listening if one.host not in _INSIDE}
        elif service.words[0] == "emulate":
            listening |= self._ports_of_prototype(service, system, words)
        for port, text in service.ports.items():
            if port not in listening:
                hint = "127.0.0.1 is reached only from inside the container: listen at 0.0.0.0"
                if "--prototype" in words:
                    hint = "`serve` sections take a free port in a prototype"
                yield self._file.error(
                    (*service.at, "ports"),
                    f"nothing in this service listens at port {port} of {text!r}",
                    expected="one of " + ", ".join(map(str, sorted(listening))) if listening else "",
                    hint=hint,
                )

    def _ports_of_prototype(self, service: Service, system: System, words: Sequence[str]) -> set[int]:
        given = service.option("prototype-file")
        try:
            prototype = load_prototype(
                system, Path(words[given[0]].partition("=")[2] or words[given[0]]) if given else None
            )
        except (FileInvalid, UsageError):
            return set()
        ends = [bus.listen for bus in prototype.buses.values() if bus.listen is not None and bus.listen.scheme != "pty"]
        far = [device.form.far for device in prototype.devices.values() if device.form.far]
        found = {int(port) for url in (*map(str, ends), *far) for port in _PORT.findall(str(url))}
        return found - {0}

    def _field_errors(self, service: Service) -> Iterator[FileInvalid]:
        given = service.option("field")
        host = given[1].rpartition(":")[0] or given[1] if given else ""
        known = {*self._hosts, "localhost"}
        if given and "include" not in self._file.data and re.fullmatch(r"[a-z][\w-]*", host) and host not in known:
            yield self._file.error(
                service.word(given[0]),
                f"no service {host!r} in this file",
                expected="one of " + ", ".join(sorted(self._hosts)),
                hint=did_you_mean(host, self._hosts),
            )


def _commands_of(name: str) -> list[str]:
    """Return the possible commands of a variable ``FIELDTWIN_NAME_OPTION``, given `name`; the longest command name first."""
    first, _, rest = name.lower().partition("_")
    return [f"{first}-{rest}", first] if rest else [first]


def _hosts(file: YamlFile) -> set[str]:
    """Return the names by which containers reach each other: services, container names and aliases."""
    found: set[str] = set()
    for name, form in file.section("services").items():
        found.add(str(name))
        networks = form.get("networks") if isinstance(form, dict) else None
        for network in networks.values() if isinstance(networks, dict) else ():
            found |= set(network.get("aliases", ())) if isinstance(network, dict) else set()
        if isinstance(form, dict) and "container_name" in form:
            found.add(resolved(form["container_name"]))
    return found
