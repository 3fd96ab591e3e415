"""`fieldtwin opcua`: create the certificate of an OPC UA server, and manage its users."""

from __future__ import annotations

import re
import sys
from pathlib import Path

import click

from fieldtwin.cli.options import profiles_option
from fieldtwin.console import stderr
from fieldtwin.gateway.core.errors import FileInvalid, UsageError
from fieldtwin.northbound.opcua.access.passwords import LONGEST, hash_of
from fieldtwin.northbound.opcua.access.users import NAME_PATTERN, ROLES, VIEW, Role, UserForm, Users, thumbprint
from fieldtwin.northbound.process_config import require_packages
from fieldtwin.twin.site.servers.serving_opcua import OpcuaSecurity, OpcuaServeConfig, application_uri
from fieldtwin.twin.site.system import System, load_system

SHORTEST = 8
_server_option = click.option("--server", "name", metavar="NAME", help="The server in `serve`; default: the only one.")


@click.group("opcua")
def command() -> None:
    """Create the certificate of a system's OPC UA server, and manage its users.

    \b
    fieldtwin opcua certificate site.yaml --host gateway.example
    fieldtwin opcua user site.yaml anna --role operate
    """


@command.command("certificate")
@click.argument("system_file", metavar="SYSTEM", type=click.Path(path_type=Path))
@_server_option
@click.option("--host", "hosts", multiple=True, metavar="HOST", help="A name or address of this computer for clients.")
@click.option(
    "--days", type=click.IntRange(1, 3650), default=1825, show_default=True, help="Days until the certificate expires."
)
@profiles_option
def certificate_command(
    system_file: Path, name: str | None, hosts: tuple[str, ...], days: int, profiles: tuple[Path, ...]
) -> int:
    """Create a key and a self-signed certificate for an OPC UA server of SYSTEM, in the files that its `security` names.

    The certificate has the application URI urn:fieldtwin:SYSTEM:SERVER. The folder of trusted certificates is created too.
    """
    from fieldtwin.northbound.opcua.access.files import create_certificate

    system = load_system(str(system_file), profiles)
    server, security = _secured(system, name)
    require_packages(server)
    uri = application_uri(system.name, server.name)
    create_certificate(security, uri, [*hosts, *_named(server.host)], days)
    _say(f"{security.certificate}: certificate of {uri}, for {days} days; copy it to the clients that trust it")
    _say(f"{security.key}: its private key")
    _say(f"{security.trusted}: folder for the certificates of clients")
    return 0


@command.command("user")
@click.argument("system_file", metavar="SYSTEM", type=click.Path(path_type=Path))
@click.argument("user")
@_server_option
@click.option(
    "--role", type=click.Choice(ROLES), default=VIEW, show_default=True, help="view: read; operate: also write."
)
@click.option(
    "--certificate",
    type=click.Path(dir_okay=False, path_type=Path),
    help="The user's certificate, instead of a password.",
)
@click.option("--remove", is_flag=True, help="Remove the user.")
@profiles_option
def user_command(
    system_file: Path,
    user: str,
    name: str | None,
    role: Role,
    certificate: Path | None,
    remove: bool,
    profiles: tuple[Path, ...],
) -> int:
    """Add USER to the users of an OPC UA server of SYSTEM, or change or remove the user.

    The command prompts for the password, or reads it from the first line of stdin. The file holds a hash of it. A running
    server reads the file at each log-in; a session that is open keeps its role.
    """
    system = load_system(str(system_file), profiles)
    server, security = _secured(system, name)
    users = Users.load(security.users) if security.users.exists() else Users()
    if remove:
        if user not in users.forms:
            known = ", ".join(users.forms) or "no users"
            raise UsageError(f"no user {user!r}", expected=known, got=user)
        del users.forms[user]
    else:
        users.forms[user] = _form(user, role, server, certificate)
    try:
        security.users.parent.mkdir(parents=True, exist_ok=True)
    except OSError as e:
        raise FileInvalid(f"cannot create the folder: {e.strerror or e}", path=str(security.users.parent)) from e
    users.save(security.users)
    _say(f"{security.users}: {user} {'removed' if remove else f'may {role}'}")
    return 0


def _form(user: str, role: Role, server: OpcuaServeConfig, certificate: Path | None) -> UserForm:
    if not re.match(NAME_PATTERN, user):
        raise UsageError("not the name of a user", expected="1 to 48 letters, digits and _ . @ -", got=repr(user[:60]))
    if certificate is None:
        return UserForm(role=role, password=hash_of(_password()))
    require_packages(server)
    from cryptography.hazmat.primitives.serialization import Encoding

    from fieldtwin.northbound.opcua.access.trust import load_certificate

    return UserForm(role=role, certificate=thumbprint(load_certificate(certificate).public_bytes(Encoding.DER)))


def _password() -> str:
    if sys.stdin.isatty():
        password: str = click.prompt("Password", hide_input=True, confirmation_prompt=True, err=True)
    else:
        password = sys.stdin.readline(LONGEST + 2).rstrip("\r\n")
    if not SHORTEST <= len(password) <= LONGEST:
        raise UsageError("the length of the password", expected=f"{SHORTEST} to {LONGEST} characters")
    return password


def _secured(system: System, name: str | None) -> tuple[OpcuaServeConfig, OpcuaSecurity]:
    """Return the server of the system that has this name, or its only one, with its `security`."""
    servers = {server.name: server for server in system.serving.opcua}
    if name is None and len(servers) == 1:
        [name] = servers
    if name is None or name not in servers:
        raise UsageError(
            "no OPC UA server is selected" if name is None else f"no OPC UA server {name!r}",
            expected="--server " + " or ".join(servers) if servers else "a server of kind opcua in `serve`",
        )
    server = servers[name]
    if server.security is None:
        raise system.file.error(
            ("serve", name),
            "this server has no `security`",
            expected="security: {certificate: FILE, key: FILE, trusted: FOLDER, users: FILE}",
        )
    return server, server.security


def _named(host: str) -> list[str]:
    """Return the host of the server's URL, unless it stands for all addresses of this computer."""
    return [] if host in ("0.0.0.0", "::") else [host]


def _say(text: str) -> None:
    stderr.print(text, soft_wrap=True, markup=False, highlight=False)
