"""Which dialect, at which speed? Asked with questions only: nothing is tared, zeroed or restarted."""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from actors.balance.balance_interface import LineSettingsError, UnknownDialectError
from actors.balance.dialects.dialect import Dialect, LineSettings
from actors.balance.readings import LineError, Reading
from actors.balance.serial_port import Wire

LISTENING = 0.3
"""How long unasked lines are waited for at each setting [s]."""

ANSWERING = 0.35
"""How long an answer may take in a quick search, beside the time of its characters [s]."""

_LONGEST_ANSWER = 48
_OTHER_KERN = re.compile(rb"\s*(?:ST|US|OL),")


@dataclass
class Attempt:
    """What came of one line setting.

    Attributes:
        line: the setting.
        heard: what came unasked.
        answers: question → what came.
        possible: whether the port can be set so.
        began, ended: when it was tried [s of `time.monotonic`].
        moments: when anything came [s of `time.monotonic`].
    """

    line: LineSettings
    heard: bytes = b""
    answers: dict[str, bytes] = field(default_factory=dict)
    possible: bool = True
    began: float = 0.0
    ended: float = 0.0
    moments: list[float] = field(default_factory=list)

    def may_be_late(self, attempts: Sequence[Attempt], patience: float) -> bool:
        """Whether something came that may have been an answer to this attempt's questions."""
        return self.possible and any(
            self.began <= moment <= self.ended + patience for other in attempts for moment in other.moments
        )

    def __str__(self) -> str:
        if not self.possible:
            return f"{self.line}: the port can't be set so"
        parts = [f"unasked {_shown(self.heard)}"] if self.heard else []
        parts += [f"{title} → {_shown(came)}" for title, came in self.answers.items()]
        return f"{self.line}: {', '.join(parts)}"


@dataclass(frozen=True)
class Detected:
    """A balance was recognised.

    Attributes:
        dialect: that it speaks.
        line: at which setting.
        identity: what it says of itself, '' where it says nothing.
        unasked: it sends without being asked.
    """

    dialect: Dialect
    line: LineSettings
    identity: str = ""
    unasked: bool = False


def detect(
    port: str,
    candidates: Sequence[LineSettings],
    allowed: Sequence[Dialect],
    open_wire: Callable[[LineSettings], Wire],
    interrupted: Callable[[], bool] = lambda: False,
    *,
    answer_time: float = ANSWERING,
) -> tuple[Detected, Wire]:
    """Find out what is at the other end.

    Settings are tried quickly. A slow balance answers when the next ones are being tried, and looks like one that talks
    at another speed; so where anything came, those that it may have been an answer to are tried once more, with
    patience.

    Args:
        port: for messages.
        candidates: settings to try, the likeliest first.
        allowed: dialects that may be found.
        open_wire: opens the port with a setting.
        interrupted: asked between settings; ends the search.
        answer_time: longest time that an answer takes [s of the clock].

    Returns:
        What was found, and the wire, open.

    Raises:
        UnknownDialectError: nothing was recognised; says what was tried and what came back.
        NoConnectionError: the port can't be opened.
    """
    patience = max(answer_time, ANSWERING)
    quick: list[Attempt] = []
    patient: dict[LineSettings, Attempt] = {}
    for line in candidates:
        quick.append(Attempt(line))
        last = line == candidates[-1]
        found = _attempt(quick[-1], allowed, open_wire, interrupted, ANSWERING, late=patience if last else 0.0)
        if found is not None:
            return found
        if patience == ANSWERING or not quick[-1].moments:
            continue
        for earlier in quick:
            if earlier.line in patient or not earlier.may_be_late(quick, patience):
                continue
            patient[earlier.line] = Attempt(earlier.line)
            found = _attempt(patient[earlier.line], allowed, open_wire, interrupted, patience)
            if found is not None:
                return found
    raise UnknownDialectError(_failure(port, [patient.get(attempt.line, attempt) for attempt in quick], allowed))


def _attempt(
    attempt: Attempt,
    allowed: Sequence[Dialect],
    open_wire: Callable[[LineSettings], Wire],
    interrupted: Callable[[], bool],
    patience: float,
    late: float = 0.0,
) -> tuple[Detected, Wire] | None:
    """Try one setting, and listen for what is late afterwards."""
    if interrupted():
        return None
    attempt.began = time.monotonic()
    try:
        wire = open_wire(attempt.line)
    except LineSettingsError:
        attempt.possible = False
        return None
    try:
        found = _try(wire, attempt, allowed, patience)
        attempt.ended = time.monotonic()
        if found is None and late > patience:
            _lines(wire, late, lambda line: True, attempt)
    except BaseException:
        wire.close()
        raise
    if found is not None:
        return found, wire
    wire.close()
    return None


def _try(wire: Wire, attempt: Attempt, allowed: Sequence[Dialect], patience: float) -> Detected | None:
    lines = _lines(wire, LISTENING, attempt=attempt)
    attempt.heard = b"\n".join(lines)
    for dialect in allowed:
        if sum(_is_weight(dialect, line) for line in lines) >= 2:
            return _recognised(wire, dialect, allowed, patience, unasked=True)
    wait = patience + _LONGEST_ANSWER * attempt.line.character_time
    for probe, speakers in _probes(allowed).items():
        wire.flush()
        # An empty line first ends what an earlier question may have left in the balance's ear.
        wire.send(b"\r\n" + probe if probe.endswith(b"\r\n") and attempt.answers else probe)
        lines = _lines(wire, wait, lambda line, speakers=speakers: _is_weight(speakers[0], line), attempt)  # type: ignore[misc]
        attempt.answers[", ".join(dialect.title for dialect in speakers)] = b"\n".join(lines)
        if any(_is_weight(speakers[0], line) for line in lines):
            return _recognised(wire, speakers[0], allowed, patience, unasked=False)
    return None


def _probes(allowed: Sequence[Dialect]) -> dict[bytes, list[Dialect]]:
    """Questions in the order of their turns, each with the dialects that ask it."""
    probes: dict[bytes, list[Dialect]] = {}
    for dialect in sorted(allowed, key=lambda dialect: dialect.turn):
        probes.setdefault(dialect.query, []).append(dialect)
    return probes


def _recognised(
    wire: Wire, dialect: Dialect, allowed: Sequence[Dialect], patience: float, *, unasked: bool
) -> Detected:
    if not dialect.identity:
        return Detected(dialect, wire.line, unasked=unasked)
    if unasked and dialect.cancel is not None:
        wire.send(dialect.cancel)
        _lines(wire, ANSWERING)
    said = {question: _identity(wire, question, patience) for question in dialect.identity}
    alike = [other for other in allowed if other.query == dialect.query]
    found = max(alike, key=lambda other: other.likeness(said))
    return Detected(found, wire.line, said[dialect.identity[-1]].replace('"', ""), unasked)


def _identity(wire: Wire, question: str, patience: float) -> str:
    """What the balance answers to I1, I2 …, without the question's echo; '' for nothing."""
    wire.flush()
    wire.send(question.encode("ascii") + b"\r\n")
    wait = patience + _LONGEST_ANSWER * wire.line.character_time
    start = f"{question} A "
    for line in _lines(wire, wait, lambda line: line.startswith(question.encode("ascii"))):
        text = line.decode("ascii", "replace")
        if text.startswith(start):
            return text.removeprefix(start).strip()
    return ""


def _is_weight(dialect: Dialect, line: bytes) -> bool:
    try:
        return isinstance(dialect.decode(line), Reading)
    except LineError:
        return False


def _lines(
    wire: Wire,
    wait: float,
    enough: Callable[[bytes], bool] = lambda line: False,
    attempt: Attempt | None = None,
) -> list[bytes]:
    """Lines that come within a time, or until one is enough; once something has come, only what follows soon.

    What has no end counts as a line.
    """
    end = time.monotonic() + wait
    lines: list[bytes] = []
    while (line := wire.line_until(min(end, time.monotonic() + ANSWERING))) is not None or (
        not lines and not wire.waiting and time.monotonic() < end
    ):
        if line is None:
            continue
        lines.append(line)
        if attempt is not None:
            attempt.moments.append(time.monotonic())
        if enough(line) or len(lines) > 50:
            return lines
    rest = wire.take()
    if rest and attempt is not None:
        attempt.moments.append(time.monotonic())
    return [*lines, rest] if rest else lines


def _shown(data: bytes) -> str:
    if not data:
        return "nothing"
    text = repr(data[:40])[1:]
    return text if len(data) <= 40 else f"{text}…"


def _failure(port: str, attempts: Sequence[Attempt], allowed: Sequence[Dialect]) -> str:
    """What was tried, what came back, and what to look at."""
    came = [data for attempt in attempts for data in (attempt.heard, *attempt.answers.values()) if data]
    everything = b"".join(came)
    if not any(attempt.possible for attempt in attempts):
        advice = "The port can't be set to what was asked for; set another 'baud' or 'format'."
    elif not came:
        advice = (
            "Nothing came at all: is the balance switched on, is its interface set to remote control and to one of "
            "these protocols, is it the right port and the right cable (some need a crossed one)?"
        )
    elif sum(not 0x20 <= byte < 0x7F and byte not in b"\r\n" for byte in everything) * 5 > len(everything):
        advice = (
            "What came is not text: speed or parity differ; read them in the balance's menu, and set 'baud' and "
            "'format'."
        )
    elif any(_OTHER_KERN.match(line) for data in came for line in data.splitlines()):
        advice = (
            "Lines like 'ST,GS 1.000 kg' are another protocol of Kern's; choose KCP, or remote control (rE Cr), in "
            "its menu."
        )
    else:
        advice = "It answers, but not in this way; choose another protocol in its menu, or name its dialect."
    titles = ", ".join(dialect.title for dialect in allowed)
    tried = "\n  ".join(map(str, attempts))
    return f"{port}: no balance recognised (looked for {titles}). {advice} Tried:\n  {tried}"
