"""The second record of a run's pours: a text file next to the journal, one JSON line per entry, flushed to the disk.

A journal that has lost entries can't report that itself. The ledger repeats every entry about a pour, with the
journal's digest at that entry, so that a lost or changed journal is found before a pour is repeated. Each line ends
with a digest of itself and of the line before it. The journal's entry is always written first: a journal may be ahead
of its ledger by the entries of one write, the ledger is never ahead of its journal.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

from orchestrator.journal.codec import canonical
from orchestrator.journal.journal_file import JournalError

LEDGER_NAME = "pours.jsonl"

BEGUN = "begun"
"""The kind of the first line; its body has the campaign's name, when the journal was created, and how many entries the
journal had when the ledger was begun."""

_LINE_DIGEST = "line"


class LedgerError(JournalError):
    """The ledger can't be read, or one of its lines was changed."""


@dataclass(frozen=True)
class LedgerLine:
    """One line of a ledger.

    Attributes:
        seq: sequence number of the journal's entry that it repeats; of the last entry, for the first line.
        digest: the journal's digest at that entry, in hexadecimal.
        t: seconds since 1970.
        kind, stage, body: as in the journal's entry.
    """

    seq: int
    digest: str
    t: float
    kind: str
    stage: str
    body: dict[str, Any]


class PourLedger:
    """The only writer of a ledger. Its caller holds the journal's lock."""

    def __init__(self, path: Path, descriptor: int, size: int, last: str) -> None:
        self._path, self._descriptor, self._size, self._last = path, descriptor, size, last

    @classmethod
    def begin(cls, path: Path, lines: Sequence[LedgerLine]) -> Self:
        """Write a new ledger with its first lines: the whole file, or nothing.

        Raises:
            OSError: it can't be written.
        """
        text, last = _text(lines, "")
        draft = path.with_suffix(".part")
        with draft.open("wb") as file:
            file.write(text)
            file.flush()
            os.fsync(file.fileno())
        draft.replace(path)
        _flush_folder(path.parent)
        return cls(path, os.open(path, os.O_WRONLY | os.O_CLOEXEC), len(text), last)

    @classmethod
    def resume(cls, path: Path) -> Self:
        """Continue a ledger; an incomplete last line is removed.

        Raises:
            LedgerError: it is damaged.
            OSError: it can't be opened.
        """
        last, size = "", 0
        for text in _whole_lines(path):
            _, last = _parsed(path, text, last)
            size += len(text)
        os.truncate(path, size)
        return cls(path, os.open(path, os.O_WRONLY | os.O_CLOEXEC), size, last)

    def append(self, lines: Sequence[LedgerLine]) -> None:
        """Write lines; they are on the disk when this returns. A failed write leaves no partial line.

        Raises:
            OSError: they can't be written.
        """
        text, last = _text(lines, self._last)
        try:
            written = 0
            while written < len(text):
                written += os.pwrite(self._descriptor, text[written:], self._size + written)
            os.fdatasync(self._descriptor)
        except OSError:
            with contextlib.suppress(OSError):
                os.ftruncate(self._descriptor, self._size)
            raise
        self._size, self._last = self._size + len(text), last

    def close(self) -> None:
        """Close the file. May be called twice."""
        descriptor, self._descriptor = self._descriptor, -1
        if descriptor >= 0:
            os.close(descriptor)


def read_ledger(path: Path) -> list[LedgerLine]:
    """The lines of a ledger, also while a run is writing it; an incomplete last line is left out.

    Raises:
        LedgerError: a line was changed, removed or inserted; the text gives its number.
        OSError: the file can't be read.
    """
    lines: list[LedgerLine] = []
    last = ""
    for text in _whole_lines(path):
        line, last = _parsed(path, text, last, len(lines) + 1)
        lines.append(line)
    return lines


def readable_lines(path: Path) -> list[LedgerLine]:
    """The lines of a ledger up to the first damaged one; none if there is no ledger."""
    lines: list[LedgerLine] = []
    last = ""
    with contextlib.suppress(LedgerError, OSError):
        for text in _whole_lines(path):
            line, last = _parsed(path, text, last)
            lines.append(line)
    return lines


def pours_in_ledger(lines: Sequence[LedgerLine]) -> list[str]:
    """One text per pour that has begun: 'pour 2 of stage calibration (began 2030-03-01 14:30:05, no outcome)'."""
    found: dict[tuple[str, Any], str] = {}
    numbers: dict[tuple[str, Any], Any] = {}
    for line in lines:
        if line.kind == BEGUN:
            continue
        key = (line.stage, line.body.get("id"))
        numbers[key] = line.body.get("number", numbers.get(key))
        match line.kind:
            case "pour.started":
                found[key] = f"began {_when(line.t)}, no outcome"
            case "pour.withdrawn":
                found.pop(key, None)
            case "pour.finished":
                found[key] = _outcome(line.body.get("outcome") or {})
    return [f"{_named(*key, numbers[key])} ({text})" for key, text in found.items()]


def _named(stage: str, key: Any, number: Any) -> str:
    return f"pour {number} of stage {stage}" if number is not None else f"request {key} of stage {stage}"


def _outcome(outcome: dict[str, Any]) -> str:
    measured = outcome.get("measurement")
    if isinstance(measured, dict) and all(isinstance(measured.get(k), int | float) for k in ("spilled", "retained")):
        return f"weighed: {1e3 * measured['spilled']:.1f} g spilled, {1e3 * measured['retained']:.1f} g retained"
    return f"failed: {outcome.get('reason', 'without a reason')}"


def _when(t: float) -> str:
    from datetime import datetime

    return datetime.fromtimestamp(t).strftime("%Y-%m-%d %H:%M:%S")


def _text(lines: Sequence[LedgerLine], last: str) -> tuple[bytes, str]:
    """Encode lines that follow a line with the digest `last`; also returns the digest of the last line."""
    parts = []
    for line in lines:
        content = dict(line.__dict__)
        last = _digest(last, content)
        parts.append(canonical({**content, _LINE_DIGEST: last}) + "\n")
    return "".join(parts).encode(), last


def _digest(last: str, content: dict[str, Any]) -> str:
    return hashlib.sha256(f"{last}\0{canonical(content)}".encode()).hexdigest()


def _whole_lines(path: Path) -> Iterator[bytes]:
    for text in path.read_bytes().splitlines(keepends=True):
        if text.endswith(b"\n"):
            yield text


def _parsed(path: Path, text: bytes, last: str, number: int | None = None) -> tuple[LedgerLine, str]:
    where = path.name if number is None else f"{path.name}, line {number}"
    try:
        content = json.loads(text)
        digest = content.pop(_LINE_DIGEST)
        if digest != _digest(last, content):
            raise LedgerError(f"{where}: was changed after it was written, or a line before it is missing")
        return LedgerLine(**content), digest
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise LedgerError(f"{where}: is damaged ({type(error).__name__}: {error})") from None


def _flush_folder(folder: Path) -> None:
    with contextlib.suppress(OSError):  # some network file systems do not support it
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
