"""The boot-up procedure of a node, in the order of CiA 302-2, and the assignment of its node ID over LSS.

Each write is noted in the audit log before it is sent.
"""

from __future__ import annotations

from fieldtwin.gateway.core.errors import ConnectionLost, FieldtwinError, ReplyTimeout
from fieldtwin.gateway.core.values import COMMAND
from fieldtwin.gateway.devices.canopen_device import CanopenDriver
from fieldtwin.gateway.protocols.canopen.lss.frames import UNCONFIGURED, LssAddress
from fieldtwin.gateway.protocols.canopen.lss.master import LssMaster
from fieldtwin.gateway.protocols.canopen.nmt.states import NmtCommand
from fieldtwin.gateway.runtime.audit_log import AuditLog


async def assign(driver: CanopenDriver, lss: LssMaster, audit: AuditLog, error: FieldtwinError) -> FieldtwinError:
    """Assign the expected node ID, which no node has, over LSS to the node with the configured LSS address.

    Return the error of a failed assignment, otherwise `error`, which is that of the node that did not answer.
    """
    address = driver.config.canopen.lss
    if address is None:
        return error
    try:
        _note_lss(driver, address, audit)
        had = await lss.assign(address, driver.node)
        if had not in (UNCONFIGURED, driver.node):
            await driver.master.nmt(NmtCommand.RESET_COMMUNICATION, had)  # the node takes its new ID when it boots
    except ReplyTimeout:
        return error  # no node with this LSS address is on the bus
    except ConnectionLost:
        raise
    except FieldtwinError as e:
        return e.at(f"{driver.config.where}, LSS")
    return error


def _note_lss(driver: CanopenDriver, address: LssAddress, audit: AuditLog) -> None:
    what = f"node id {driver.node} for {address}"
    audit.note("lss", driver.config.name, by="start-up", result="asked", what=what)


async def bring_up(driver: CanopenDriver, audit: AuditLog, allow_writes: bool) -> None:
    """Check the node's identity, then configure and start it; without `allow_writes` only read how it is configured."""
    await driver.identify()
    await driver.read_once()
    if not allow_writes:
        await driver.adopt()
        return
    name = driver.config.name
    if await driver.to_be_halted():
        audit.note("nmt", name, by="start-up", result="asked", what="pre-operational")
        driver.consumer.observe(COMMAND(b"", "nmt_preoperational"))
        await driver.send()
    if what := driver.to_configure:
        audit.note("sdo", name, by="start-up", result="asked", what=what)
    await driver.configure()
    if driver.config.start:
        audit.note("nmt", name, by="start-up", result="asked", what="start")
        driver.consumer.observe(COMMAND(b"", "nmt_start"))
        await driver.send()
