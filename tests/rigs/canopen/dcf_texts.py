"""Sections of DCF files as text, and a dictionary made of them."""

from __future__ import annotations

from fieldtwin.gateway.protocols.canopen.eds.dictionary import ObjectDictionary, parse_dictionary


def var(section: str, kind: int, access: str, default: str = "", value: str = "") -> str:
    lines = [f"[{section}]", f"ParameterName=P{section}", "ObjectType=0x7", f"DataType=0x{kind:04X}"]
    return "\n".join(
        [*lines, f"AccessType={access}", f"DefaultValue={default}", "PDOMapping=0"]
        + ([f"ParameterValue={value}"] if value else [])
        + ["", ""]
    )


def record(index: str, subs: list[tuple[int, str, str, str]]) -> str:
    head = f"[{index}]\nParameterName=R{index}\nObjectType=0x9\nSubNumber={len(subs)}\n\n"
    return head + "".join(var(f"{index}sub{i:X}", *sub) for i, sub in enumerate(subs))


def dcf(*parts: str) -> ObjectDictionary:
    return parse_dictionary("[DeviceInfo]\nVendorName=x\n\n" + "".join(parts), 5, path="node5.dcf")


TPDO1 = (
    record("1800", [
        (5, "const", "5", ""), (7, "rw", "$NODEID+0x180", "$NODEID+0x40000180"), (5, "rw", "254", "1"),
        (6, "rw", "0", ""), (5, "rw", "0", ""), (6, "rw", "0", "100"),
    ])
    + record("1A00", [(5, "rw", "1", "2"), (7, "rw", "0x20000008", "0x20010010"), (7, "rw", "0", "0x20020010")])
)  # fmt: skip
