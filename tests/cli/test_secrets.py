"""Secrets come from files and the environment: on a command line and in a URL they are refused, and no output repeats them."""

from __future__ import annotations

import asyncio
from pathlib import Path

import click
import pytest
from click.testing import CliRunner
from hypothesis import given, settings
from hypothesis import strategies as st

from fieldtwin.cli.main import COMMANDS, cli
from fieldtwin.cli.options import Secret
from fieldtwin.gateway.core.errors import FieldtwinError, UsageError
from fieldtwin.gateway.core.url_secrets import has_password, without_password
from fieldtwin.gateway.store.knowledge import open_knowledge
from fieldtwin.gateway.wallclock import WallClock
from fieldtwin.run.live.options import RunOptions
from fieldtwin.twin.site.system import load_system
from fieldtwin.twin.thread.place import plant_carrier, twin_carrier

CHECKOUT = Path(__file__).parents[2]
WORD = "s3cret"
WITH_SECRETS = ("run", "emulate", "topside", "test")
TEXT = st.text("abcdefghijklmnopqrstuvwxyz0123456789!$-_.", min_size=1, max_size=12)


def test_a_token_comes_from_a_file_or_the_environment(tmp_path: Path) -> None:
    secret = tmp_path / "token"
    secret.write_text("s3cret\nnot this\n")
    for said in (f"@{secret}", WORD):  # the environment's value is used unchanged
        assert Secret().convert(said, None, None) == WORD
    secret.write_text("")
    for missing in (f"@{secret}", f"@{tmp_path}/none"):
        with pytest.raises(click.BadParameter):
            Secret().convert(missing, None, None)


@pytest.mark.parametrize("name", WITH_SECRETS)
@pytest.mark.parametrize("form", [["--token", WORD], [f"--token={WORD}"]])
def test_a_secret_on_the_command_line_is_refused_and_not_repeated(name: str, form: list[str]) -> None:
    said = CliRunner().invoke(cli, [name, "observatory", *form])
    assert said.exit_code == 2
    assert "@FILE, or the environment" in said.output
    assert WORD not in said.output


@pytest.mark.parametrize("name", WITH_SECRETS)
def test_the_environment_is_taken(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(f"FIELDTWIN_{name.upper()}_TOKEN", WORD)
    said = CliRunner().invoke(cli, [name, "no-such-system", *(["--prototype"] if name == "run" else [])])
    assert "--token" not in said.output
    assert isinstance(said.exception, FieldtwinError | SystemExit)
    assert WORD not in f"{said.output}{said.exception}"


def test_every_secret_option_is_one_of_these() -> None:
    """A password option that accepts its value directly would be a further exposure."""
    secret, plain = set(), set()
    for name in COMMANDS:
        found = cli.get_command(click.Context(cli), name)
        assert found is not None
        for option in _options(found):
            if any(word in (option.name or "") for word in ("token", "password", "secret", "key")):
                (secret if isinstance(option.type, Secret) else plain).add((name, option.name))
    of_studio = {("studio", "operate_token"), ("studio", "view_token")}
    assert secret == {(name, "token") for name in (*WITH_SECRETS, "mcp")} | of_studio
    assert plain == {("studio", "key"), ("mcp", "key"), ("studio", "no_token")}  # a file, and a switch


def _options(command: click.Command) -> list[click.Parameter]:
    inner = [o for c in command.commands.values() for o in _options(c)] if isinstance(command, click.Group) else []
    return [*(p for p in command.params if isinstance(p, click.Option)), *inner]


@pytest.mark.parametrize(
    "url",
    [
        "mqtt://plant:s3cret@broker/sea/observatory",
        "postgresql://plant:s3cret@db/knowledge",
        "postgresql://db/knowledge?user=plant&password=s3cret",
        "postgresql://db/knowledge?sslmode=require&sslpassword=s3cret",
    ],
)
def test_a_password_in_a_url_is_refused_and_not_repeated(url: str) -> None:
    with pytest.raises(UsageError) as refused:
        RunOptions("observatory", True, **({"thread": url} if url.startswith("mqtt") else {"thread_store": url}))  # type: ignore[arg-type]
    assert WORD not in str(refused.value)
    assert "***" in str(refused.value)
    system = load_system(str(CHECKOUT / "profiles/systems/observatory.yaml"))
    with pytest.raises(UsageError) as refused:
        _ = twin_carrier(url, system, WallClock()) if url.startswith("mqtt") else asyncio.run(open_knowledge(url))
    assert WORD not in str(refused.value)


def test_the_brokers_password_may_be_in_a_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    system = load_system(str(CHECKOUT / "profiles/systems/observatory.yaml"))
    monkeypatch.setenv("FIELDTWIN_MQTT_PASSWORD_FILE", str(tmp_path / "password"))
    with pytest.raises(UsageError, match="No such file"):
        twin_carrier("mqtt://plant@broker/sea/observatory", system, WallClock())
    (tmp_path / "password").write_text(f"{WORD}\n")
    carrier, place = asyncio.run(plant_carrier("mqtt://plant@broker/sea/observatory", system, WallClock()))
    assert carrier._broker.password == WORD  # type: ignore[attr-defined]
    assert WORD not in f"{place}{carrier._broker!r}"  # type: ignore[attr-defined]


def test_displayed_options_contain_no_token() -> None:
    assert WORD not in repr(RunOptions("observatory", True, token=WORD))


@settings(max_examples=40)
@given(user=TEXT, password=TEXT, host=st.sampled_from(["db", "127.0.0.1:5432", "[::1]:1883"]))
def test_no_password_remains_in_messages(user: str, password: str, host: str) -> None:
    for url in (f"postgresql://{user}:{password}@{host}/x", f"mqtt://{host}/a/b?password={password}&host=c"):
        assert has_password(url)
        told = without_password(url)
        assert told.replace("***", password, 1) == url
    assert not has_password(f"mqtt://{user}@{host}/a/b")
    assert without_password(f"mqtt://{user}@{host}/a/b") == f"mqtt://{user}@{host}/a/b"
