"""What the lines of a balance are: why a line is not a weight, and which dialect fits the lines of a capture.

`explain_line` returns the sentence for a message about one line. `explain_lines` decodes all lines of a capture in
every installed dialect; the `DialectFit`s are ordered by how well they fit. Line settings can't be known from lines.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

from actors.balance.dialect_registry import dialects
from actors.balance.dialects.dialect import Dialect
from actors.balance.readings import LineError, OtherQuantityError, Reading, ReadingStatus, WeightMark

_LONGEST = 60
_COUNTED = re.compile(r"(?i)(?:%|\b(?:pcs?|stk|lb:oz|pcs/\w+)\b|\blb +[0-9.]+ *oz\b)")
_TEXT = frozenset((*range(0x20, 0x7F), 0x0A, 0x0D))


def shown_bytes(data: bytes) -> str:
    """Return bytes as they came, control characters visible: 'ST,GS,\\x00'."""
    text = repr(data[:_LONGEST])[1:]
    return text if len(data) <= _LONGEST else f"{text}… ({len(data)} bytes)"


def is_text(data: bytes) -> bool:
    """Whether at most a fifth of the bytes are outside printable ASCII; otherwise the line settings are wrong."""
    return sum(byte not in _TEXT for byte in data) * 5 <= len(data)


def explain_line(line: bytes, allowed: Sequence[Dialect]) -> str:
    """Return what a line without a weight is, and the remedy.

    Args:
        line: as it came, without its end.
        allowed: the dialects in which it was decoded.
    """
    reasons = [error for dialect in allowed if isinstance(error := _decoded(dialect, line), LineError)]
    other = next((error for error in reasons if isinstance(error, OtherQuantityError)), None)
    reason = str(other or (reasons[0] if len(allowed) == 1 and reasons else "a weight in none of the dialects"))
    text = f"{shown_bytes(line)}: {reason}"
    remedy = other.remedy if other is not None and other.remedy else _remedy(line, allowed)
    return f"{text}. {remedy}"


def most_telling(lines: Iterable[bytes], allowed: Sequence[Dialect]) -> bytes | None:
    """Return the line that says most about an unknown balance: a weight of another dialect, another quantity, or a
    number; None if there is none.

    Args:
        lines: as they came.
        allowed: the dialects in which they were decoded.
    """
    lines = [line for line in lines if line.strip()]
    for telling in (
        lambda line: any(_is_mass(dialect, line) for dialect in dialects().values()),
        lambda line: any(isinstance(_decoded(dialect, line), OtherQuantityError) for dialect in allowed),
        lambda line: re.search(rb"[0-9]", line) is not None,
    ):
        if (found := next(filter(telling, lines), None)) is not None:
            return found
    return None


def _remedy(line: bytes, allowed: Sequence[Dialect]) -> str:
    elsewhere = [dialect for dialect in dialects().values() if dialect not in allowed and _is_mass(dialect, line)]
    if elsewhere:
        titles = " or ".join(dialect.title for dialect in elsewhere)
        return f"It resembles {titles}: set 'dialect: {elsewhere[0].name}' or 'dialect: auto'"
    if not is_text(line):
        return "It is not text: speed or parity differ ('baud', 'format'), or the cable is damaged"
    if _COUNTED.search(line.decode("ascii", "replace")):
        return "Set its display to weighing in g"
    return (
        "Set its display and its print-out to the weight in g alone, with its unit; 'decant balance record' and "
        "'decant balance explain' show which protocol fits"
    )


@dataclass
class DialectFit:
    """The lines of a capture in one dialect.

    Attributes:
        dialect: the dialect.
        total: number of lines.
        weights: number of lines with a mass, stable or not.
        understood: number of all lines that are valid in this dialect.
        reads: the stable masses, each as long as it stays.
        marks: whether lines are marked as net or gross.
        states: status without a weight ('over range'), or a number that is no mass ('12 pcs') → number of lines.
        others: other quantity → number of lines.
        refused: invalid line → reason and number of lines.
    """

    dialect: Dialect
    total: int = 0
    weights: int = 0
    understood: int = 0
    reads: list[str] = field(default_factory=list)
    marks: set[WeightMark] = field(default_factory=set)
    states: Counter[str] = field(default_factory=Counter)
    others: Counter[str] = field(default_factory=Counter)
    refused: dict[bytes, tuple[str, int]] = field(default_factory=dict)
    _replies: dict[bytes, object] = field(default_factory=dict, repr=False)

    def add(self, line: bytes) -> None:
        """Decode a line."""
        self.total += 1
        if line not in self._replies:  # most lines of a long capture are repeated
            self._replies[line] = _decoded(self.dialect, line)
        reply = self._replies[line]
        if isinstance(reply, LineError) and not isinstance(reply, OtherQuantityError):
            self.refused[line] = (str(reply), self.refused.get(line, ("", 0))[1] + 1)
            return
        self.understood += 1
        if isinstance(reply, OtherQuantityError):
            self.others[reply.what] += 1
        elif isinstance(reply, Reading):
            self._add_reading(reply)

    def _add_reading(self, reading: Reading) -> None:
        moving = reading.status is ReadingStatus.UNSTABLE and not reading.unit  # some leave the unit out meanwhile
        if reading.value is None or (reading.mass() is None and not moving):
            self.states[str(reading)] += 1
            return
        self.weights += 1
        self.marks |= {reading.mark} - {None}  # type: ignore[arg-type]
        shown = f"{reading.value} {reading.unit}"
        if reading.status is ReadingStatus.STABLE and self.reads[-1:] != [shown]:
            self.reads.append(shown)


def explain_lines(lines: Iterable[bytes]) -> list[DialectFit]:
    """Decode lines in every installed dialect; the best fit is the first.

    Args:
        lines: as they came, without their ends.
    """
    fits = [DialectFit(dialect) for dialect in dialects().values()]
    for line in lines:
        for fit in fits:
            fit.add(line)
    return sorted(fits, key=lambda fit: (-fit.weights, -fit.understood, fit.dialect.name))


def best_fits(fits: Sequence[DialectFit]) -> list[DialectFit]:
    """The dialects that read the most weights and understand the most lines; none if no dialect reads a weight.

    Args:
        fits: from `explain_lines`.
    """
    best = (fits[0].weights, fits[0].understood) if fits else (0, 0)
    return [fit for fit in fits if (fit.weights, fit.understood) == best and fit.weights]


def _decoded(dialect: Dialect, line: bytes) -> object:
    """Return the decoded line, or the error that says why it is invalid."""
    try:
        return dialect.decode(line)
    except LineError as error:
        return error


def _is_mass(dialect: Dialect, line: bytes) -> bool:
    reply = _decoded(dialect, line)
    return isinstance(reply, Reading) and reply.mass() is not None
