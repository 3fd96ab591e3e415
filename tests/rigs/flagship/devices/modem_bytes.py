"""An independent modem: a socket that answers bytes with bytes from a table. It knows no Modbus beyond the MBAP header.

Run as ``python modem_bytes.py TABLE [--plant byte]``. TABLE is YAML:

  replies   request PDU -> reply PDU, in hex
  once      used in order and then removed: if a request PDU begins with `request`, answer `reply`, and `then` changes replies
  events    by name: the changes to make when that name arrives as a line on stdin
"""

import argparse
import asyncio
import sys

import yaml


def pdu(text):
    return bytes.fromhex(text)


class Modem:
    def __init__(self, table, plant):
        self.replies = self.table(table["replies"])
        self.once = list(table["once"])
        self.events = table["events"]
        self.longer = pdu(table["planted_byte"]) if plant == "byte" else None

    @staticmethod
    def table(entries):
        return {pdu(request): pdu(reply) for request, reply in entries.items()}

    def answer(self, request):
        for i, entry in enumerate(self.once):
            if request.startswith(pdu(entry["request"])):
                del self.once[i]
                self.replies |= self.table(entry.get("then", {}))
                return pdu(entry["reply"])
        reply = self.replies.get(request)
        if reply is None:
            print("no answer to", request.hex(" "), file=sys.stderr, flush=True)
        elif request == self.longer:
            reply += b"\0"
        return reply

    async def serve(self, reader, writer):
        try:
            while True:
                header = await reader.readexactly(7)
                request = await reader.readexactly(int.from_bytes(header[4:6], "big") - 1)
                reply = self.answer(request)
                if reply is not None:
                    writer.write(header[:4] + (len(reply) + 1).to_bytes(2, "big") + header[6:] + reply)
                    await writer.drain()
        except (asyncio.IncompleteReadError, ConnectionError):
            pass
        finally:
            writer.close()


async def run(modem):
    server = await asyncio.start_server(modem.serve, "127.0.0.1", 0)
    print("ready", server.sockets[0].getsockname()[1], flush=True)
    lines = asyncio.StreamReader()
    await asyncio.get_running_loop().connect_read_pipe(lambda: asyncio.StreamReaderProtocol(lines), sys.stdin)
    while line := await lines.readline():
        modem.replies |= modem.table(modem.events[line.decode().strip()])
    server.close()


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("table")
    parser.add_argument("--plant", choices=["byte"])
    args = parser.parse_args()
    with open(args.table, encoding="utf-8") as file:
        table = yaml.safe_load(file)
    asyncio.run(run(Modem(table, args.plant)))


if __name__ == "__main__":
    main()
