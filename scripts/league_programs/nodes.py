"""Third-party CANopen nodes of the league: ``nodes.py NAME EDS``, node 5 on the bus of `can_line.py`.

The program writes the node's data sheet to EDS, and prints ``0 0`` when it serves.
"""

from __future__ import annotations

import asyncio
import signal
import sys
from pathlib import Path
from typing import Any

from can_line import LineBus

NODE = 5
U8, U16, U32, I16, TEXT = 5, 6, 7, 3, 9
OBJECTS = (  # index, subindex, name, type, access, value, limits
    (0x1000, 0, "Device type", U32, "ro", 0, None),
    (0x1001, 0, "Error register", U8, "ro", 0, None),
    (0x1017, 0, "Producer heartbeat time", U16, "rw", 0, None),
    (0x2000, 0, "Value", I16, "rw", 7, (-100, 100)),
    (0x2003, 0, "Command", U32, "wo", 0, None),
    (0x2004, 0, "Text", TEXT, "rw", "a text of more than one segment", None),
)
IDENTITY = ("Vendor-ID", "Product code", "Revision number", "Serial number")


def dictionary(library: Any) -> Any:
    """Return the object dictionary in the classes of canopen or canopen-asyncio."""
    parts = library.objectdictionary
    od = library.ObjectDictionary()
    for index, subindex, name, kind, access, value, limits in OBJECTS:
        variable = parts.ODVariable(name, index, subindex)
        variable.data_type, variable.access_type, variable.default, variable.value = kind, access, value, value
        if limits:
            variable.min, variable.max = limits
        od.add_object(variable)
    identity = parts.ODRecord("Identity object", 0x1018)
    for subindex, name in enumerate(("Highest subindex", *IDENTITY)):
        variable = parts.ODVariable(name, 0x1018, subindex)
        variable.data_type, variable.access_type = (U32 if subindex else U8), "ro"
        variable.default = variable.value = 0x100 + subindex if subindex else len(IDENTITY)
        identity.add_member(variable)
    od.add_object(identity)
    return od


def serve_canopen(sheet: Path) -> None:
    import canopen

    network = canopen.Network()
    network.bus = LineBus()
    network.connect()
    od = dictionary(canopen)
    canopen.export_od(od, str(sheet))
    node = canopen.LocalNode(NODE, od)
    network.add_node(node)
    node.nmt.state = "PRE-OPERATIONAL"
    print("0 0", flush=True)
    signal.pause()


def serve_canopen_asyncio(sheet: Path) -> None:
    import canopen_asyncio as canopen
    from canopen_asyncio.objectdictionary.eds import export_eds

    async def main() -> None:
        network = canopen.Network()
        network.bus = LineBus()
        network.connect(loop=asyncio.get_running_loop())
        od = dictionary(canopen)
        with sheet.open("w") as file:  # its export_od imports the package canopen, which is not installed
            export_eds(od, file)
        node = canopen.LocalNode(NODE, od)
        network.add_node(node)
        node.nmt.state = "PRE-OPERATIONAL"
        print("0 0", flush=True)
        await asyncio.Event().wait()

    asyncio.run(main())


def serve_durand(sheet: Path) -> None:
    from durand import CANBusNetwork, DatatypeEnum, Node, Variable

    kinds = {U8: DatatypeEnum.UNSIGNED8, U16: DatatypeEnum.UNSIGNED16, U32: DatatypeEnum.UNSIGNED32}
    kinds |= {I16: DatatypeEnum.INTEGER16, TEXT: DatatypeEnum.VISIBLE_STRING}
    node = Node(CANBusNetwork(LineBus()), node_id=NODE)
    for index, _, name, kind, access, value, limits in OBJECTS:
        if index >= 0x2000:
            least, most = limits or (None, None)
            held = value.encode() if isinstance(value, str) else value
            node.object_dictionary[index] = Variable(kinds[kind], access, held, minimum=least, maximum=most, name=name)
    sheet.write_text(node.eds.content)
    print("0 0", flush=True)
    signal.pause()


NODES = {"canopen": serve_canopen, "canopen_asyncio": serve_canopen_asyncio, "durand": serve_durand}

if __name__ == "__main__":
    NODES[sys.argv[1]](Path(sys.argv[2]))
