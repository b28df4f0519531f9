"""Which dialect, at which speed? Asked with questions only: nothing is tared, zeroed or restarted."""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from actors.balance.dialects import DIALECTS, KCP, KERN_SWT, MT_SICS, SBI, Dialect, LineSettings
from actors.balance.errors import LineSettingsError, UnknownDialectError
from actors.balance.reading import FrameError, Reading
from actors.balance.wire import Wire

LISTENING = 0.3
"""How long unasked lines are waited for at each setting [s]."""

ANSWERING = 0.35
"""How long an answer may take beside the time of its characters [s]."""

_LONGEST_ANSWER = 48
_PROBES: tuple[Dialect, ...] = (SBI, KERN_SWT, KCP)
"""In this order: a balance that knows only Sartorius' commands may take a letter without ESC for a command, and `S` is
'restart' there; ESC P and `w` mean nothing to the others. `SI` asks KCP and MT-SICS alike."""

_OTHER_KERN = re.compile(rb"\s*(?:ST|US|OL),")


@dataclass
class Attempt:
    """What came of one line setting.

    Attributes:
        line: the setting.
        heard: what came unasked.
        answers: question → what came.
        possible: whether the port can be set so.
    """

    line: LineSettings
    heard: bytes = b""
    answers: dict[str, bytes] = field(default_factory=dict)
    possible: bool = True

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
) -> tuple[Detected, Wire]:
    """Find out what is at the other end.

    Args:
        port: for messages.
        candidates: settings to try, the likeliest first.
        allowed: dialects that may be found.
        open_wire: opens the port with a setting.
        interrupted: asked between settings; ends the search.

    Returns:
        What was found, and the wire, open.

    Raises:
        UnknownDialectError: nothing was recognised; says what was tried and what came back.
        NoConnectionError: the port can't be opened.
    """
    attempts: list[Attempt] = []
    for line in candidates:
        if interrupted():
            break
        attempt = Attempt(line)
        attempts.append(attempt)
        try:
            wire = open_wire(line)
        except LineSettingsError:
            attempt.possible = False
            continue
        try:
            found = _try(wire, attempt, allowed)
        except BaseException:
            wire.close()
            raise
        if found is not None:
            return found, wire
        wire.close()
    raise UnknownDialectError(_failure(port, attempts, allowed))


def _try(wire: Wire, attempt: Attempt, allowed: Sequence[Dialect]) -> Detected | None:
    lines = _lines(wire, LISTENING)
    attempt.heard = b"\n".join(lines)
    for dialect in allowed:
        if sum(_is_weight(dialect, line) for line in lines) >= 2:
            return _recognised(wire, dialect, allowed, unasked=True)
    wait = ANSWERING + _LONGEST_ANSWER * attempt.line.character_time
    for probe in _PROBES:
        speakers = [probe] if probe is not KCP else [KCP, MT_SICS]
        if not any(dialect in allowed for dialect in speakers):
            continue
        wire.flush()
        # An empty line first ends what an earlier question may have left in the balance's ear.
        wire.send(b"\r\n" + probe.query if probe is KCP and attempt.answers else probe.query)
        lines = _lines(wire, wait, lambda line, probe=probe: _is_weight(probe, line))  # type: ignore[misc]
        attempt.answers[probe.title if probe is not KCP else "Kern KCP, MT-SICS"] = b"\n".join(lines)
        if any(_is_weight(probe, line) for line in lines):
            return _recognised(wire, probe, allowed, unasked=False)
    return None


def _recognised(wire: Wire, dialect: Dialect, allowed: Sequence[Dialect], *, unasked: bool) -> Detected:
    if dialect not in (KCP, MT_SICS):
        return Detected(dialect, wire.line, unasked=unasked)
    if unasked and dialect.cancel is not None:
        wire.send(dialect.cancel)
        _lines(wire, ANSWERING)
    level, model = (_identity(wire, question) for question in ("I1", "I2"))
    found = _kcp_or_sics(level, model)
    return Detected(found if found in allowed else dialect, wire.line, model.replace('"', ""), unasked)


def _identity(wire: Wire, question: str) -> str:
    """What the balance answers to I1, I2 …, without the question's echo; '' for nothing."""
    wire.flush()
    wire.send(question.encode("ascii") + b"\r\n")
    wait = ANSWERING + _LONGEST_ANSWER * wire.line.character_time
    start = f"{question} A "
    for line in _lines(wire, wait, lambda line: line.startswith(question.encode("ascii"))):
        text = line.decode("ascii", "replace")
        if text.startswith(start):
            return text.removeprefix(start).strip()
    return ""


def _kcp_or_sics(level: str, model: str) -> Dialect:
    """KCP borrowed its questions and answers from MT-SICS; all that the driver does is the same but for the pace.

    MT-SICS says its levels and one version of two numbers for each ("0123" "2.30" "2.22" …). KCP's versions have three
    numbers (1.1.2); how it prints them could not be found out, so all that does not look like MT-SICS counts as KCP,
    whose pace suits both.
    """
    if "KERN" in f"{level} {model}".upper():
        return KCP
    return MT_SICS if re.fullmatch(r'"[0-9]{1,4}"( "[0-9]+\.[0-9]+[A-Z]?")+', level) else KCP


def _is_weight(dialect: Dialect, line: bytes) -> bool:
    try:
        return isinstance(dialect.decode(line), Reading)
    except FrameError:
        return False


def _lines(wire: Wire, wait: float, enough: Callable[[bytes], bool] = lambda line: False) -> list[bytes]:
    """Lines that come within a time, or until one is enough; what has no end counts as a line."""
    end = time.monotonic() + wait
    lines: list[bytes] = []
    while (line := wire.line_until(end)) is not None:
        lines.append(line)
        if enough(line) or len(lines) > 50:
            return lines
    rest = wire.take()
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
            "What came is no text: speed or parity differ; read them in the balance's menu and set 'baud' and 'format'."
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


def dialects(name: str) -> list[Dialect]:
    """The dialects that a setting allows.

    Args:
        name: of one, or 'auto'.
    """
    return list(DIALECTS.values()) if name == "auto" else [DIALECTS[name]]
