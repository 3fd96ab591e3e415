"""An independent inclinometer: a bare python-can program that answers SDO requests from a table and sends heartbeats
and TPDO1.

Run as ``python inclinometer_can.py INTERFACE CHANNEL TABLE ROWS [--plant abort]``. TABLE is YAML (inclinometer.yaml in
this folder), ROWS is JSON: a list of [slope long, slope lateral] in hundredths of a degree, one row per TPDO. It works
with any interface that python-can knows.
"""

import argparse
import json
import struct
import time

import can
import yaml

NODE = 5
PRE_OPERATIONAL, OPERATIONAL, STOPPED = 0x7F, 0x05, 0x04
STATES = {0x01: OPERATIONAL, 0x02: STOPPED, 0x80: PRE_OPERATIONAL}


class Node:
    def __init__(self, bus, table, rows, plant):
        self.bus, self.table, self.rows = bus, table, rows
        self.sdo = {bytes.fromhex(request): bytes.fromhex(reply) for request, reply in table["sdo"].items()}
        for request, reply in table["planted"].get(plant, {}).items():
            self.sdo[bytes.fromhex(request)] = bytes.fromhex(reply)
        self.state = PRE_OPERATIONAL
        self.next_beat = self.next_tpdo = None
        self.row = 0

    def send(self, cob_id, data):
        self.bus.send(can.Message(arbitration_id=cob_id, data=data, is_extended_id=False))

    def take(self, frame, now):
        if frame.arbitration_id == 0x000 and frame.dlc == 2 and frame.data[1] in (0, NODE):
            self.state = STATES.get(frame.data[0], self.state)
            self.next_tpdo = now if self.state == OPERATIONAL else None
        elif frame.arbitration_id == 0x600 + NODE:
            request = bytes(frame.data)
            refusal = b"\x80" + request[1:4] + struct.pack("<I", 0x08000020)
            self.send(0x580 + NODE, self.sdo.get(request, refusal))
            if request.startswith(bytes.fromhex(self.table["heartbeat"])):
                self.next_beat = now

    def tick(self, now):
        if self.next_beat is not None and self.next_beat <= now:
            self.send(0x700 + NODE, [self.state])
            self.next_beat += self.table["heartbeat_ms"] / 1000
        if self.next_tpdo is not None and self.next_tpdo <= now:
            self.send(0x180 + NODE, struct.pack("<hh", *self.rows[self.row % len(self.rows)]))
            self.row += 1
            self.next_tpdo += self.table["tpdo_ms"] / 1000

    def run(self):
        self.send(0x700 + NODE, [0])
        print("ready", flush=True)
        while True:
            due = [t for t in (self.next_beat, self.next_tpdo) if t is not None]
            wait = max(0.0, min(due) - time.monotonic()) if due else 1.0
            frame = self.bus.recv(wait)
            if frame is not None and not frame.is_error_frame:
                self.take(frame, time.monotonic())
            self.tick(time.monotonic())


def main():
    parser = argparse.ArgumentParser()
    for name in ("interface", "channel", "table", "rows"):
        parser.add_argument(name)
    parser.add_argument("--plant", choices=["abort"])
    args = parser.parse_args()
    with open(args.table, encoding="utf-8") as file:
        table = yaml.safe_load(file)
    with open(args.rows, encoding="utf-8") as file:
        rows = json.load(file)
    with can.Bus(interface=args.interface, channel=args.channel) as bus:
        Node(bus, table, rows, args.plant).run()


if __name__ == "__main__":
    main()
