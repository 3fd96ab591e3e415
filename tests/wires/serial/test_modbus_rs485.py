"""RS485 by the kernel: the requests to the driver, and ports without such a mode (a pty is one)."""

from __future__ import annotations

import os
import pty
import shutil
import struct
import subprocess
import tty
from pathlib import Path

import pytest
from support import run

from fieldtwin.gateway.connections.os_connector import OsConnector
from fieldtwin.gateway.connections.serial.rs485 import (
    ENABLED,
    RTS_AFTER_SEND,
    RTS_ON_SEND,
    TIOCGRS485,
    TIOCSRS485,
    let_driver_switch,
    settings_sent,
)
from fieldtwin.gateway.core.endpoint import Endpoint, SerialSettings
from fieldtwin.gateway.core.errors import UsageError


def test_the_setting_keeps_the_boards_requirements() -> None:
    driver = struct.pack("=8I", RTS_AFTER_SEND | 1 << 5, 3, 4, 5, 0, 0, 0, 9)
    assert struct.unpack("=8I", settings_sent(driver)) == (ENABLED | RTS_ON_SEND | 1 << 5, 3, 4, 5, 0, 0, 0, 9)


@pytest.mark.skipif(not Path("/usr/include/linux/serial.h").exists(), reason="no kernel headers")
@pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler")
def test_numbers_and_layout_are_those_of_the_kernels_header(tmp_path: Path) -> None:
    names = ("SER_RS485_ENABLED", "SER_RS485_RTS_ON_SEND", "SER_RS485_RTS_AFTER_SEND", "TIOCGRS485", "TIOCSRS485")
    fields = ("flags", "delay_rts_before_send", "delay_rts_after_send")
    parts = [*names, *(f"offsetof(struct serial_rs485, {f})" for f in fields), "sizeof(struct serial_rs485)"]
    lines = "\n".join(f'printf("%lu\\n", (unsigned long)({part}));' for part in parts)
    source = "#include <stdio.h>\n#include <stddef.h>\n#include <sys/ioctl.h>\n#include <linux/serial.h>\n"
    (tmp_path / "facts.c").write_text(f"{source}int main(void) {{\n{lines}\nreturn 0; }}\n")
    subprocess.run(["cc", "facts.c", "-o", "facts"], cwd=tmp_path, check=True, capture_output=True, timeout=60)
    told = subprocess.run([tmp_path / "facts"], check=True, capture_output=True, timeout=10).stdout.split()
    ours = [ENABLED, RTS_ON_SEND, RTS_AFTER_SEND, TIOCGRS485, TIOCSRS485, 0, 4, 8, len(settings_sent(bytes(32)))]
    assert [int(n) for n in told] == ours


def test_a_port_without_the_mode_is_refused_and_free_again() -> None:
    async def main(path: str) -> None:
        with pytest.raises(UsageError, match="no RS485 mode") as caught:
            await OsConnector().open_bytes(Endpoint.parse(f"rtu:{path}?frame=8N1&rs485=1"))
        assert path in caught.value.where
        connection = await OsConnector().open_bytes(
            Endpoint.parse(f"rtu:{path}?frame=8N1&rs485=0")
        )  # not locked any more
        await connection.aclose()

    master, slave = pty.openpty()
    tty.setraw(slave)
    try:
        with pytest.raises(OSError, match="Inappropriate ioctl"):
            let_driver_switch(slave)
        run(main(os.ttyname(slave)))
    finally:
        os.close(master)
        os.close(slave)


def test_the_endpoint_enables_it_or_not() -> None:
    assert Endpoint.parse("rtu:/dev/ttyS0?rs485=1").rs485
    assert not Endpoint.parse("rtu:/dev/ttyS0").rs485
    with pytest.raises(UsageError, match="0 or 1"):
        Endpoint.parse("rtu:/dev/ttyS0?rs485=yes")
    assert Endpoint.parse("ascii:/dev/ttyS0").serial == SerialSettings(19200, "7E1")
