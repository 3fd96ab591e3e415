"""Probes for the values that the client under test publishes, which show whether a bad frame became a value.

A probe learns the representation of the two correct words (`learn`), however the client converts them: scaled, as a
float, in two registers. A later value that equals neither came from data that no correct answer contained.
"""

from __future__ import annotations

import asyncio
import re
from collections.abc import Callable
from typing import Protocol

from fieldtwin.conformance.core.observation import Word
from fieldtwin.gateway.core.clock import Clock
from fieldtwin.gateway.core.connection import Connector
from fieldtwin.gateway.core.endpoint import Endpoint
from fieldtwin.gateway.core.errors import ConnectionLost, FieldtwinError, ModbusExceptionReply, UsageError, WireError
from fieldtwin.gateway.protocols.modbus.client import ModbusClient
from fieldtwin.gateway.protocols.modbus.requests.data import RegisterTable

OnShown = Callable[[Word, str], None]
_REGISTER = re.compile(
    r"^(?P<endpoint>.+?)/(?P<table>holding|input):(?P<address>\d{1,5})(?:\+(?P<count>[1-8]))?(?:@(?P<unit>\d{1,3}))?$"
)
_NUMBER = re.compile(r"(?<![\w.])-?\d+(?![\w.]*\w)")
_ANY_NUMBER = re.compile(r"(?<![\w.])-?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?(?![\w.]*\w)")
MAX_LINE = 10_000
"""Maximum number of characters of a line that are examined."""
MAX_FORMS = 1_000
"""Largest number of forms of lines that a probe remembers."""
SHOWN_CHARACTERS = 80
PERIOD_S = 0.05
"""Period in seconds of a `tcp://` probe. docs/how-to/check-a-client.md states it, because a shorter-lived value may be missed."""
TIMEOUT_S = 2.0


class Probe(Protocol):
    """A source of the values that the program under test publishes."""

    on_shown: OnShown

    def learn(self, word: Word) -> bool:
        """Learn that the current value represents `word`; return False while there is no value."""
        ...

    def latest_text(self) -> str:
        """Return the latest registers or the latest line, for a message; empty if there were none."""
        ...


class Classifier:
    """A classifier of readings. A reading is any text; it learns how the correct words look, and recognises the poison value
    by its number.
    """

    def __init__(self, poison: int, stands_for_none: frozenset[str] = frozenset()) -> None:
        self._poison = str(poison)
        self._none = stands_for_none
        self._known: dict[str, Word] = {}
        self.latest = ""

    def learn(self, word: Word) -> bool:
        """Take the latest reading as the representation of `word`.

        Return False if there is no reading yet, or if it is already known to represent a different word.
        """
        if not self.latest or self.latest in self._none:
            return False
        known = self._known.get(self.latest)
        if known is not None and known is not word:
            return False  # the word has not arrived yet
        self._known[self.latest] = word
        return True

    def word(self, reading: str) -> Word:
        """Return the word that a reading represents, and keep the reading as the latest."""
        self.latest = reading
        if not reading or reading in self._none:
            return Word.NONE
        if reading in self._known:
            return self._known[reading]
        return Word.POISON if reading == self._poison else Word.OTHER


class RegisterProbe:
    """A probe that polls registers of a Modbus TCP server: the client's own server, or that of an HMI that shows its
    values.

    An exception response is not a value.
    """

    def __init__(self, text: str, connector: Connector, clock: Clock, classifier: Classifier) -> None:
        match = _REGISTER.match(text)
        if not match:
            raise UsageError(
                "a probe",
                expected="output, output:TEXT, or tcp://HOST:PORT/holding:ADDRESS[+COUNT][@UNIT]",
                got=repr(text),
            )
        self.endpoint = Endpoint.parse(match["endpoint"])
        self._table: RegisterTable = "holding" if match["table"] == "holding" else "input"
        self._address = int(match["address"])
        self._count, self._unit = int(match["count"] or 1), int(match["unit"] or 1)
        self._connector, self._clock, self._classifier = connector, clock, classifier
        self.on_shown: OnShown = lambda word, text: None

    def learn(self, word: Word) -> bool:
        return self._classifier.learn(word)

    def latest_text(self) -> str:
        return self._classifier.latest

    async def run(self) -> None:
        """Poll until cancelled. A server that cannot be reached yields no value."""
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


class _Lines:
    """A splitter of output and log into whole lines. It keeps the last `MAX_LINE` characters of an incomplete line."""

    def __init__(self) -> None:
        self._pending = {False: "", True: ""}

    def feed(self, text: str, log: bool) -> list[str]:
        *lines, rest = (self._pending[log] + text).split("\n")
        self._pending[log] = rest[-MAX_LINE:]
        return [line[:MAX_LINE] for line in lines]


class OutputProbe:
    """Whole numbers in the output of the client's program.

    The program also prints other text, so a line is identified by its form: its text without the numbers. While the
    probe learns, it notes the forms and the positions in them of the correct words. Later, a number at such a position
    is a published value, whatever it is, and the other numbers of a known form are not. Numbers in an unknown form are
    unclear, unless they are one of the three words. In the log (standard error) such a line is not a value.
    """

    def __init__(self, words: dict[int, Word]) -> None:
        self._words = words
        self._seen: set[Word] = set()
        self._forms: dict[str, set[int]] = {}
        self._lines = _Lines()
        self._learns = True
        self._latest_line = ""
        self.on_shown: OnShown = lambda word, text: None

    def learn(self, word: Word) -> bool:
        """Return whether `word` was seen; learning ends with both words. The program has to print the words unchanged;
        otherwise they are never found.
        """
        if {Word.FIRST, Word.SECOND} <= self._seen:
            self._learns = False
        return word in self._seen

    def latest_text(self) -> str:
        return self._latest_line

    def feed(self, text: str, log: bool = False) -> None:
        """Add text of the program's output, or of its log (standard error) if `log` is True."""
        for line in self._lines.feed(text, log):
            self._line(line, log)

    def _line(self, line: str, log: bool) -> None:
        if not log and line.strip():
            self._latest_line = line.strip()[:SHOWN_CHARACTERS]
        numbers = _ANY_NUMBER.findall(line)
        form = _ANY_NUMBER.sub("\0", line.strip())
        words = [self._word(number) for number in numbers]
        places = self._forms.get(form)
        if self._learns and len(self._forms) < MAX_FORMS:
            places = self._forms.setdefault(form, set())
            places |= {at for at, word in enumerate(words) if word in (Word.FIRST, Word.SECOND)}
        if places is not None:
            shown = [
                (word, number) for at, (word, number) in enumerate(zip(words, numbers, strict=True)) if at in places
            ]
        elif log:
            return
        else:
            shown = [(w, n) for w, n in zip(words, numbers, strict=True) if w is not Word.OTHER]
            if numbers and not shown:
                shown = [(Word.UNCLEAR, line.strip()[:SHOWN_CHARACTERS])]
        for word, said in dict.fromkeys(shown):
            self._seen.add(word)
            self.on_shown(word, said)

    def _word(self, number: str) -> Word:
        return (
            self._words.get(int(number), Word.OTHER) if _NUMBER.fullmatch(number) and len(number) < 10 else Word.OTHER
        )


class MarkedOutputProbe:
    """The values that the client's program prints after `mark` in a line. Any other text after it means "no value"."""

    def __init__(self, mark: str, classifier: Classifier) -> None:
        self._value = re.compile(re.escape(mark) + r"\s*([^\s,;:\"'(){}\[\]]+)")
        self._classifier = classifier
        self._lines = _Lines()
        self._latest_line = ""
        self.on_shown: OnShown = lambda word, text: None

    def learn(self, word: Word) -> bool:
        return self._classifier.learn(word)

    def latest_text(self) -> str:
        return self._latest_line

    def feed(self, text: str, log: bool = False) -> None:
        """Add text of the program's output, or of its log (standard error) if `log` is True."""
        for line in self._lines.feed(text, log):
            if not log and line.strip():
                self._latest_line = line.strip()[:SHOWN_CHARACTERS]
            for reading in self._value.findall(line):
                known = reading if _ANY_NUMBER.fullmatch(reading) else ""
                self.on_shown(self._classifier.word(known), reading)
