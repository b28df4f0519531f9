"""What the lines of a balance are: why a line is not a weight, and which dialect fits the lines of a capture.

`explain_line` returns the sentence for a message about one line. `explain_capture` decodes all lines of a capture in
every installed dialect and explains them in the best. Line settings can't be known from lines.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

from actors.balance.balance_interface import unsettled
from actors.balance.dialect_registry import dialects
from actors.balance.dialects.dialect import Dialect, LineForm
from actors.balance.line_recording import Capture
from actors.balance.readings import (
    IN_TURN,
    Acknowledgement,
    LineError,
    OtherQuantityError,
    Reading,
    ReadingReply,
    ReadingStatus,
    WeightMark,
    in_turn,
)

_LONGEST = 60
_MOST = 4
"""Weights and other lines that are printed of a capture."""

MOSTLY = 0.8
"""Least share of the best dialect's weights that a dialect reads which refuses damaged lines only."""

_COUNTED = re.compile(r"(?i)(?:%|\b(?:pcs?|stk|lb:oz|pcs/\w+)\b|\blb +[0-9.]+ *oz\b)")
_LABEL = re.compile(rb"\s*(?:(G|GS|GROSS|B)|(N|NT|NET)|(T|TR|PT|TARE))\b[\s:.,#]*[-+]?\s*[0-9.]+", re.IGNORECASE)
_UNMARKED = re.compile(rb"[ -] [ 0-9.]{6}[0-9] (?:[A-Za-z] ?|[A-Za-z]{2})")  # sign in 2, value in 7, unit in 3
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
        if (telling_line := next(filter(telling, lines), None)) is not None:
            return telling_line
    return None


def _remedy(line: bytes, allowed: Sequence[Dialect]) -> str:
    elsewhere = [dialect for dialect in dialects().values() if dialect not in allowed and _is_mass(dialect, line)]
    if elsewhere:
        titles = " or ".join(dialect.title for dialect in elsewhere)
        return f"It resembles {titles}: set 'dialect: {elsewhere[0].name}' or 'dialect: auto'"
    if (framed := _framed(line)) is not None:
        return framed
    if not is_text(line):
        return (
            "It is not text: speed or parity differ ('baud', 'format'; over TCP, those of the serial server), or the "
            "cable is damaged"
        )
    if _COUNTED.search(line.decode("ascii", "replace")):
        return "Set its display to weighing in g"
    return (
        "Set its display and its print-out to the weight in g alone, with its unit; 'decant balance record' shows "
        "which protocol fits"
    )


def _framed(line: bytes) -> str | None:
    """Return the remedy for a line with STX or ETX; None for other lines."""
    if not is_text(line.translate(None, b"\x02\x03")) or not {0x02, 0x03} & {*line}:
        return None
    return (
        "Its lines stand between STX and ETX (\\x02, \\x03), as in no protocol here: switch these off in the balance's "
        "menu, or choose a plain text print-out"
    )


def _status_alone(lines: Sequence[bytes]) -> str:
    """What lines that state no weight but a status, all of them, mean, and the remedy; '' for other lines."""
    for dialect in dialects().values():
        match replies := [_decoded(dialect, line) for line in lines]:
            case [Acknowledgement(answer=ReadingReply.REFUSED), *_] if len({*map(type, replies)}) == 1:
                return (
                    "They are error replies: the balance does not know, or can't carry out, the commands that it was "
                    "sent. Select the protocol of these commands in its menu, or send those of its own protocol"
                )
            case [Reading(status=ReadingStatus.BUSY), *_] if _without_value(replies):
                return "It was busy or not at rest each time: record again when its display stands still"
            case [Reading(status=ReadingStatus.OVER | ReadingStatus.UNDER | ReadingStatus.ERROR) as first, *_] if (
                _without_value(replies)
            ):
                text = unsettled(first, "", 0.0, 0)[1]
                return f"{text[0].upper()}{text[1:]}"
    return ""


def _without_value(replies: Iterable[object]) -> bool:
    return all(isinstance(reply, Reading) and reply.value is None for reply in replies)


def _parity(lines: Sequence[bytes]) -> str | None:
    """Return the format of 7 data bits in which lines that were received with 8 are weights; None if there is none."""
    if not best_fits([bytes(byte & 0x7F for byte in line).rstrip(b"\r") for line in lines]):
        return None
    odd = {byte.bit_count() % 2 for line in lines for byte in line}
    return "7E1" if odd == {0} else "7O1" if odd == {1} else None


@dataclass
class DialectFit:
    """The lines of a capture in one dialect.

    Attributes:
        dialect: the dialect.
        weights: number of lines with a mass, stable or not.
        understood: number of all lines that are valid in this dialect.
        reads: the stable masses, each as long as it stays.
        masses: all masses [kg].
        marks: whether lines are marked as net or gross.
        others: what other lines hold ('over range', a tare, '12 pcs', an invalid line and the reason) → their number.
    """

    dialect: Dialect
    weights: int = 0
    understood: int = 0
    reads: list[str] = field(default_factory=list)
    masses: list[float] = field(default_factory=list)
    marks: set[WeightMark] = field(default_factory=set)
    others: Counter[str] = field(default_factory=Counter)
    _form: LineForm = field(default_factory=LineForm)
    _valid: set[int] = field(default_factory=set)
    _invalid: set[int] = field(default_factory=set)

    def add(self, line: bytes, reply: object) -> None:
        """Count a line and its decoded reply."""
        if _may_be_mass(reply) and not self._form.keeps(line):
            reply = LineError("its number is elsewhere than in the lines before it; it has lost characters")
        if isinstance(reply, LineError) and not isinstance(reply, OtherQuantityError):
            self.others[f"invalid: {shown_bytes(line)}: {reply}"] += 1
            self._invalid.add(len(line))
            return
        self._valid.add(len(line))
        self.understood += 1
        if isinstance(reply, OtherQuantityError):
            self.others[f"{reply.what}, not a weight"] += 1
        elif isinstance(reply, Reading):
            self._add_reading(reply)

    def lacks_only_damaged_lines(self, best: DialectFit) -> bool:
        """Whether the lines that the best dialect reads in addition are few, and not as long as whole lines."""
        return self.weights >= MOSTLY * best.weights and self._valid.isdisjoint(self._invalid)

    def _add_reading(self, reading: Reading) -> None:
        moving = reading.status is ReadingStatus.UNSTABLE and not reading.unit  # some leave the unit out meanwhile
        if reading.value is None or (reading.mass() is None and not moving):
            self.others[str(reading)] += 1
            return
        self.weights += 1
        self.masses += [] if (mass := reading.mass()) is None else [mass]
        self.marks |= {reading.mark} - {None}  # type: ignore[arg-type]
        shown = f"{reading.value} {reading.unit}"
        if reading.status is ReadingStatus.STABLE and self.reads[-1:] != [shown]:
            self.reads.append(shown)


def best_fits(lines: Sequence[bytes]) -> list[DialectFit]:
    """Decode lines in every installed dialect; return those that read the most weights and understand the most lines.

    A strict dialect fits as well if it refuses only damaged lines; what others read in these is no weight.

    Args:
        lines: as they came, without their ends.

    Returns:
        Fits of equal quality, that which refuses the most damaged lines first; none if no dialect reads a weight.
    """
    fits = []
    for dialect in dialects().values():
        fit = DialectFit(dialect)
        replies = {line: _decoded(dialect, line) for line in dict.fromkeys(lines)}  # most are repeated
        for line in lines:
            fit.add(line, replies[line])
        fits.append(fit)
    fits.sort(key=lambda fit: (-fit.weights, -fit.understood))
    best = fits[0]
    equal = (best.weights, best.understood)
    alike = [fit for fit in fits if (fit.weights, fit.understood) == equal or fit.lacks_only_damaged_lines(best)]
    return sorted(alike, key=lambda fit: fit.weights) if best.weights else []


def explain_capture(capture: Capture) -> tuple[list[str], str | None]:
    """Explain the lines of a capture.

    Args:
        capture: the lines, from a recording or a file of another program.

    Returns:
        Lines of text for the user (the best dialect, what it reads, what else came), and the problem if no dialect
        reads a weight.
    """
    lines = capture.lines
    text = [f"number of lines {len(lines)}, of different lines {len(set(lines))}"]
    text += [f"note: {note}" for note in capture.notes]
    if not lines:
        return text, "the balance sent nothing: is it switched on, and is it the right port and cable?"
    fits = best_fits(lines)
    if not fits:
        line = most_telling(lines, list(dialects().values())) or lines[0]
        problem = f"no dialect reads a weight in these lines, such as {shown_bytes(line)}. "
        return text, problem + _advice(capture)
    return text + _described(fits, capture), None


def _advice(capture: Capture) -> str:
    """What to do about lines in which no dialect reads a weight."""
    lines = capture.lines
    if (framed := next(filter(None, map(_framed, lines)), None)) is not None:
        return framed
    if status := _status_alone(lines):
        return status
    if not is_text(b"".join(lines)):
        remedy = (
            "They are not text: speed or parity differ; set 'baud' and 'format' as in the balance's menu, over TCP in "
            "the serial server"
        )
        if (form := _parity(lines)) is not None:
            remedy += f". As '{form}' they are weights: set 'format: {form}', also in a terminal program"
        return remedy
    if all(map(_UNMARKED.fullmatch, lines)):
        return (
            "They look like lines of a G&G balance, which do not say whether the weight is stable: use a balance with "
            "one of the protocols in the page on balances"
        )
    if len({match.lastindex for match in map(_LABEL.match, lines) if match}) > 1:
        return f"As their letters show, {IN_TURN}, with its unit"
    stated = any(re.search(rb"[0-9] *(?:mg|g|kg)\b", line) for line in lines)
    how = "as one of the protocols in the page on balances" if stated else "in g with its unit"
    damaged = "" if capture.about else ". A program that cuts blanks at the ends of lines off damages them"
    return f"Set the balance to print the weight {how}, or choose another protocol in its menu{damaged}"


def _described(fits: Sequence[DialectFit], capture: Capture) -> list[str]:
    """The dialects that fit equally well, and what the first one reads and leaves in the lines of a capture."""
    fit = fits[0]
    reads = ", ".join(fit.reads[:_MOST]) + (f", … ({len(fit.reads)})" if len(fit.reads) > _MOST else "")
    alike = "; 'dialect: auto' tells them apart by their replies" if len(fits) > 1 else ""
    names = " or ".join(fit.dialect.name for fit in fits)
    text = [f"best fit: {names} ({fit.weights} weights in {len(capture.lines)} lines){alike}"]
    text.append(f"  stable weights: {reads or 'none'}")
    text += [f"  {count} × {other}" for other, count in fit.others.most_common(_MOST)]
    if (hidden := len(fit.others) - _MOST) > 0:
        text.append(f"  and {hidden} other lines without a weight")
    line_settings = capture.about.get("line")
    origin = f"recorded with {line_settings}" if line_settings else "baud and format: see its menu"
    text.append(f"  dialect: {fit.dialect.name}   # {origin}")
    if not fit.marks and in_turn(fit.masses):
        text.append(f"  {IN_TURN}")
    if len(fit.marks) > 1:
        text.append("  weight: net   # or gross; it sends both")
    return text


def _decoded(dialect: Dialect, line: bytes) -> object:
    """Return the decoded line, or the error that says why it is invalid."""
    try:
        return dialect.decode(line)
    except LineError as error:
        return error


def _may_be_mass(reply: object) -> bool:
    """Whether a reply is a weight in a unit of mass, or without a unit."""
    return isinstance(reply, Reading) and reply.value is not None and (not reply.unit or reply.mass() is not None)


def _is_mass(dialect: Dialect, line: bytes) -> bool:
    reply = _decoded(dialect, line)
    return isinstance(reply, Reading) and reply.mass() is not None
