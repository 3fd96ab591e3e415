"""What the master under test publishes: how a case learns whether a bad frame became a value.

A probe is taught what the two honest words look like (`learn`), whatever the master makes of them: scaled, as a float, in two
registers. What it shows later that is neither was made of something that no honest answer held.
"""

from __future__ import annotations

import asyncio
import re
from collections.abc import Callable
from typing import Protocol

from fieldtwin.conformance.observation import Word
from gateway.core.clock import Clock
from gateway.core.connection import Connector
from gateway.core.endpoint import Endpoint
from gateway.core.errors import ConnectionLost, FieldtwinError, ModbusExceptionReply, UsageError, WireError
from gateway.protocols.modbus.client import ModbusClient
from gateway.protocols.modbus.requests import RegisterTable

OnShown = Callable[[Word, str], None]
_REGISTER = re.compile(
    r"^(?P<endpoint>.+?)/(?P<table>holding|input):(?P<address>\d{1,5})(?:\+(?P<count>[1-8]))?(?:@(?P<unit>\d{1,3}))?$"
)
_NUMBER = re.compile(r"(?<![\w.])-?\d+(?![\w.]*\w)")
PERIOD_S = 0.05
TIMEOUT_S = 2.0


class Probe(Protocol):
    """Shows values to whoever listens."""

    on_shown: OnShown

    def learn(self, word: Word) -> bool:
        """What is shown now stands for `word`; False while nothing is shown."""
        ...


class Classifier:
    """Readings into words. A reading is any text; the honest words are taught, the rest is known by its number."""

    def __init__(self, poison: int, stands_for_none: frozenset[str] = frozenset()) -> None:
        self._poison = str(poison)
        self._none = stands_for_none
        self._known: dict[str, Word] = {}
        self.latest = ""

    def learn(self, word: Word) -> bool:
        """Raises `UsageError` where both words look the same."""
        if not self.latest or self.latest in self._none:
            return False
        known = self._known.get(self.latest)
        if known is not None and known is not word:
            return False  # not arrived yet
        self._known[self.latest] = word
        return True

    def word(self, reading: str) -> Word:
        """What a reading stands for; it is the latest from now on."""
        self.latest = reading
        if not reading or reading in self._none:
            return Word.NONE
        if reading in self._known:
            return self._known[reading]
        return Word.POISON if reading == self._poison else Word.OTHER


class RegisterProbe:
    """Registers of a Modbus TCP server, polled: the master's own, or an HMI's behind it. A refusal is no value."""

    def __init__(self, text: str, connector: Connector, clock: Clock, classifier: Classifier) -> None:
        match = _REGISTER.match(text)
        if not match:
            raise UsageError(
                "a probe", expected="output, or tcp://HOST:PORT/holding:ADDRESS[+COUNT][@UNIT]", got=repr(text)
            )
        self.endpoint = Endpoint.parse(match["endpoint"])
        self._table: RegisterTable = "holding" if match["table"] == "holding" else "input"
        self._address = int(match["address"])
        self._count, self._unit = int(match["count"] or 1), int(match["unit"] or 1)
        self._connector, self._clock, self._classifier = connector, clock, classifier
        self.on_shown: OnShown = lambda word, text: None

    def learn(self, word: Word) -> bool:
        return self._classifier.learn(word)

    async def run(self) -> None:
        """Poll until cancelled. Whoever is not there shows nothing."""
        while True:
            try:
                client = ModbusClient.at(
                    self.endpoint, await self._connector.open_bytes(self.endpoint), self._clock, timeout_s=TIMEOUT_S
                )
            except FieldtwinError:
                await asyncio.sleep(PERIOD_S)
                continue
            try:
                await self._poll(client)
            except (ConnectionLost, WireError):
                await asyncio.sleep(PERIOD_S)
            finally:
                await client.aclose()

    async def _poll(self, client: ModbusClient) -> None:
        while True:
            try:
                reply = await client.read_registers(self._unit, self._table, self._address, self._count)
                reading = " ".join(str(r) for r in reply.registers)
            except ModbusExceptionReply:
                reading = ""
            self.on_shown(self._classifier.word(reading), reading)
            await asyncio.sleep(PERIOD_S)


class OutputProbe:
    """Whole numbers in what the master's program prints. Only the three words count: a program prints much else."""

    def __init__(self, words: dict[int, Word]) -> None:
        self._words = words
        self._seen: set[Word] = set()
        self._pending = ""
        self.on_shown: OnShown = lambda word, text: None

    def learn(self, word: Word) -> bool:
        """The words are printed as they are, or never."""
        return word in self._seen

    def feed(self, text: str) -> None:
        """Something was printed."""
        *lines, self._pending = (self._pending + text).split("\n")
        self._pending = self._pending[-10_000:]
        for line in lines:
            for number in dict.fromkeys(int(n) for n in _NUMBER.findall(line[:10_000]) if len(n) < 10):
                word = self._words.get(number)
                if word is not None:
                    self._seen.add(word)
                    self.on_shown(word, str(number))
