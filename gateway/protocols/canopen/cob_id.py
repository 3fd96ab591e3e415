"""CAN identifiers of CANopen: the pre-defined connection set, and the restricted CAN-IDs (CiA 301, 7.3.3 and 7.3.5).

This module only computes numbers; it uses no frames and no bus.
"""

from __future__ import annotations

from fieldtwin.gateway.core.errors import UsageError

NMT = 0x000
SYNC = 0x080
EMCY_BASE = 0x080
TIME = 0x100
TPDO_BASES = (0x180, 0x280, 0x380, 0x480)
RPDO1_BASE = 0x200
SDO_RESPONSE_BASE = 0x580
SDO_REQUEST_BASE = 0x600
HEARTBEAT_BASE = 0x700
LSS_REPLY = 0x7E4
LSS_REQUEST = 0x7E5

ALL_NODES = 0
NODE_MAX = 127

_NOT_FOR_PDOS = ((0x000, 0x180), (0x581, 0x5FF), (0x601, 0x67F), (0x6E0, 0x7FF))
"""The restricted CAN-IDs of 7.3.5, and 080h to 100h, where this master listens for SYNC, EMCY and TIME."""


def check_node(node: int) -> int:
    """Return `node` if it is a node ID, 1 to 127; otherwise raise `UsageError`."""
    if not 1 <= node <= NODE_MAX:
        raise UsageError("not a CANopen node id", expected="1 to 127", got=str(node))
    return node


def check_pdo_cob_id(cob_id: int) -> int:
    """Return `cob_id` if a PDO may use it (11 bits, not restricted); otherwise raise `UsageError`."""
    if not 0 <= cob_id <= 0x7FF or any(low <= cob_id <= high for low, high in _NOT_FOR_PDOS):
        raise UsageError(
            "not a CAN-ID for a PDO", expected="11 bits, 181h to 6DFh and not reserved", got=f"{cob_id:X}h"
        )
    return cob_id
