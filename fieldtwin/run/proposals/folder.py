"""The folder of proposals, which only its owner may enter: one file for each proposal, whose name states how far it is.

A proposal is in ``N.waiting.json`` until one process takes it by renaming the file, which succeeds only once. So a proposal that
two users confirm at the same time is written once, and one whose writer was killed is never written again.
"""

from __future__ import annotations

import os
import stat
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import TypeVar

import msgspec

from fieldtwin.gateway.core.clock import Clock
from fieldtwin.gateway.core.errors import FileInvalid, NotAllowed, Unreachable, UsageError, os_reason
from fieldtwin.gateway.runtime.audit_log import AuditLog
from fieldtwin.run.proposals.proposal import MOST_WAITING, Ended, EndState, Proposal
from fieldtwin.twin.plant.instance import runtime_root

NAME = ".proposals"
WAITING, TAKEN, ENDED = "waiting", "taken", "ended"
MOST_KEPT = 50
"""Number of ended proposals that are kept; the oldest are removed first."""
MOST_BYTES = 1 << 16
"""Largest size of a file of the folder."""
S = TypeVar("S", bound=msgspec.Struct)


class ProposalFolder:
    """The proposals of this user on this computer."""

    def __init__(self, clock: Clock, root: Path | None = None) -> None:
        self._clock = clock
        self._folder = (root or runtime_root()) / NAME

    def add(self, proposal: Proposal) -> Proposal:
        """Store a proposal, and return it with its number. Raises `UsageError` if too many wait, and `Unreachable`."""
        self.expire()
        try:
            self._folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        except OSError as e:
            raise Unreachable(f"cannot make the folder of proposals: {os_reason(e)}", where=str(self._folder)) from e
        self._refuse_foreign_folder()
        if len(self._numbers(WAITING)) >= MOST_WAITING:
            raise UsageError(
                "too many proposals wait for a user", expected=f"at most {MOST_WAITING}", hint="wait for a decision"
            )
        numbered = proposal
        created = False
        while not created:  # it is false if another agent has just taken the number
            numbered = msgspec.structs.replace(proposal, number=1 + max(map(_number, self._files()), default=0))
            created = self._create(self._path(numbered.number, WAITING), numbered)
        self._forget_old()
        return numbered

    def _refuse_foreign_folder(self) -> None:
        found = self._folder.lstat()
        if not stat.S_ISDIR(found.st_mode) or found.st_uid != os.getuid() or found.st_mode & 0o077:
            raise Unreachable("other users have access to the folder of proposals", where=str(self._folder))

    def waiting(self) -> list[Proposal]:
        """Return the proposals that wait for a decision, the oldest first."""
        if not self._folder.exists():
            return []
        self._refuse_foreign_folder()
        self.expire()
        found = (self._read(self._path(number, WAITING), Proposal) for number in sorted(self._numbers(WAITING)))
        return [proposal for proposal in found if proposal is not None]

    def open(self, number: int) -> Proposal:
        """Return a proposal that waits. Raises `UsageError` for one that is unknown or decided."""
        self.expire()
        proposal = self._read(self._path(number, WAITING), Proposal)
        if proposal is None:
            waiting = ", ".join(map(str, sorted(self._numbers(WAITING))))
            expected = f"a proposal that waits: {waiting}" if waiting else "a proposal that waits, but there is none"
            raise UsageError(f"proposal {number} does not wait: {self.state(number)}", expected=expected)
        return proposal

    def state(self, number: int) -> str:
        """Return the state of a proposal as text, such as ``refused by user anna on /dev/pts/2``."""
        ended = self.ended(number)
        if ended is not None:
            decided = f" by {ended.by}" if ended.by else ""
            return f"{ended.state}{decided}{f': {ended.text}' if ended.text else ''}"
        if self._path(number, TAKEN).exists():
            return "confirmed, without a result yet"
        return "waiting for a user" if self._path(number, WAITING).exists() else "unknown"

    def ended(self, number: int) -> Ended | None:
        """Return the end of a proposal, None if it has not ended or is no longer kept."""
        return self._read(self._path(number, ENDED), Ended)

    def take(self, proposal: Proposal, by: str) -> None:
        """Take a waiting proposal to carry it out. The audit log records it first.

        Raises `NotAllowed` if it is decided or has expired, and `Unreachable` if it cannot be recorded.
        """
        self._claim(proposal)
        self._note(proposal, by, "confirmed")

    def end(self, proposal: Proposal, state: EndState, by: str, text: str = "") -> Ended:
        """End a proposal that this process has taken, and record the end in the audit log."""
        ended = Ended(proposal=proposal, state=state, by=by, text=text, utc_ns=self._clock.utc_ns())
        self._create(self._path(proposal.number, ENDED), ended)
        self._path(proposal.number, TAKEN).unlink(missing_ok=True)
        self._note(proposal, by, f"{state}: {text}" if text else state)
        return ended

    def refuse(self, proposal: Proposal, state: EndState, by: str, text: str = "") -> Ended:
        """End a waiting proposal without a write. Raises `NotAllowed` if it is decided already."""
        self._claim(proposal)
        return self.end(proposal, state, by, text)

    def expire(self) -> None:
        """End the waiting proposals whose time is over."""
        for number in self._numbers(WAITING):
            proposal = self._read(self._path(number, WAITING), Proposal)
            if proposal is not None and proposal.has_expired(self._clock.monotonic_ns()) and self._rename(number):
                self.end(proposal, "expired", "")

    def _claim(self, proposal: Proposal) -> None:
        self.expire()
        if not self._rename(proposal.number):
            raise NotAllowed(f"proposal {proposal.number} does not wait any more: {self.state(proposal.number)}")

    def _rename(self, number: int) -> bool:
        """Take a waiting proposal, and return false if another process was faster."""
        try:
            os.rename(self._path(number, WAITING), self._path(number, TAKEN))
        except FileNotFoundError:
            return False
        except OSError as e:
            raise Unreachable(f"cannot decide the proposal: {os_reason(e)}", where=str(self._folder)) from e
        return True

    def _note(self, proposal: Proposal, by: str, result: str) -> None:
        log = AuditLog(Path(proposal.audit), self._clock)
        try:
            log.note(
                "proposal",
                proposal.tag.rpartition(".")[0],
                by=by or "time",
                result=result,
                number=proposal.number,
                instance=proposal.instance,
                tag=proposal.tag,
                value=proposal.value,
                asked_by=proposal.by,
            )
        finally:
            log.close()

    def _path(self, number: int, state: str) -> Path:
        return self._folder / f"{number}.{state}.json"

    def _files(self) -> Iterator[Path]:
        return (path for path in self._folder.glob("*.*.json") if path.name.split(".")[0].isdecimal())

    def _numbers(self, state: str) -> list[int]:
        return [_number(path) for path in self._files() if path.name.split(".")[1] == state]

    def _forget_old(self) -> None:
        for number in sorted(self._numbers(ENDED))[:-MOST_KEPT]:
            self._path(number, ENDED).unlink(missing_ok=True)

    def _create(self, path: Path, content: msgspec.Struct) -> bool:
        """Write a new file as a whole, so that no reader finds a part of it, and return false if it exists already.

        Raises `Unreachable`.
        """
        temporary = path.with_suffix(f".{os.getpid()}-{threading.get_ident()}.new")
        try:
            descriptor = os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600)
            with os.fdopen(descriptor, "wb") as file:
                file.write(msgspec.json.encode(content))
            os.link(temporary, path)
        except FileExistsError:
            return False
        except OSError as e:
            raise Unreachable(f"cannot store the proposal: {os_reason(e)}", where=str(path)) from e
        finally:
            temporary.unlink(missing_ok=True)
        return True

    def _read(self, path: Path, kind: type[S]) -> S | None:
        try:
            with path.open("rb") as file:
                return msgspec.json.decode(file.read(MOST_BYTES), type=kind)
        except FileNotFoundError:
            return None
        except OSError as e:
            raise FileInvalid(f"cannot read the proposal: {os_reason(e)}", path=str(path)) from e
        except msgspec.MsgspecError as e:
            raise FileInvalid(f"not a proposal: {e}", path=str(path), expected="a file of this version") from e


def _number(path: Path) -> int:
    return int(path.name.split(".")[0])
