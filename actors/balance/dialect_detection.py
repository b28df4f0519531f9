"""Detection of a balance's dialect and line settings.

`detect` tries line settings and sends queries only: it never tares, zeroes or restarts a balance. It returns a
`Detected` and the open wire; an `Attempt` records the bytes received with one setting.
"""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from actors.balance.balance_interface import LineSettingsError, NoConnectionError
from actors.balance.dialects.dialect import Dialect, LineSettings
from actors.balance.line_explanation import explain_line, is_text, most_telling, shown_bytes
from actors.balance.readings import LineError, Reading
from actors.balance.serial_port import Wire, tcp_address

LISTENING = 0.3
"""Wait for unsolicited lines at each setting [s]."""

ANSWERING = 0.35
"""Wait for a reply in the quick search, in addition to the transmission time of its characters [s]."""

LISTING = 5.0
"""Longest time of an answer of many lines [s], such as the list of all commands."""

_LONGEST_ANSWER = 48


@dataclass
class Attempt:
    """Result of one line setting.

    Attributes:
        line: the setting.
        heard: unsolicited bytes.
        answers: sent bytes → received bytes.
        possible: whether the port accepts the setting.
        began, ended: time of the attempt [s of `time.monotonic`].
        moments: times at which bytes arrived [s of `time.monotonic`].
    """

    line: LineSettings
    heard: bytes = b""
    answers: dict[bytes, bytes] = field(default_factory=dict)
    possible: bool = True
    began: float = 0.0
    ended: float = 0.0
    moments: list[float] = field(default_factory=list)

    def may_be_late(self, attempts: Sequence[Attempt], timeout: float) -> bool:
        """Whether some received bytes may have been a late reply to this attempt's queries."""
        return self.possible and any(
            self.began <= moment <= self.ended + timeout for other in attempts for moment in other.moments
        )

    def __str__(self) -> str:
        if not self.possible:
            return f"{self.line}: the port can't be set so"
        parts = [f"unasked came {shown_bytes(self.heard)}"] if self.heard else []
        parts += [
            f"{shown_bytes(sent)} → {shown_bytes(came) if came else 'nothing'}" for sent, came in self.answers.items()
        ]
        return f"{self.line}: {', '.join(parts)}"


@dataclass(frozen=True)
class Detected:
    """A recognised balance.

    Attributes:
        dialect: its dialect.
        line: its line settings.
        identity: its identification, '' if it sends none.
        unasked: whether it sends without a query.
        commands: as it lists them, without line ends; empty if it lists none.
    """

    dialect: Dialect
    line: LineSettings
    identity: str = ""
    unasked: bool = False
    commands: frozenset[str] = frozenset()


def detect(
    port: str,
    candidates: Sequence[LineSettings],
    allowed: Sequence[Dialect],
    open_wire: Callable[[LineSettings], Wire],
    interrupted: Callable[[], bool] = lambda: False,
    *,
    answer_time: float = ANSWERING,
) -> tuple[Detected, Wire]:
    """Detect the dialect and the line settings of a balance.

    Settings are tried quickly at first. The reply of a slow balance arrives while the next settings are being tried,
    and looks like a reply at another speed. If bytes arrived, the settings that may have caused them are therefore
    tried again with a longer wait.

    Args:
        port: for messages.
        candidates: settings to try, the most likely first.
        allowed: dialects to consider.
        open_wire: opens the port with a setting.
        interrupted: checked between settings; True ends the search.
        answer_time: longest time until a reply [s of the clock].

    Returns:
        The detected balance, and the open wire.

    Raises:
        NoConnectionError: no dialect was recognised; the text lists the attempts and the received bytes.
        NoConnectionError: the port cannot be opened.
    """
    timeout = max(answer_time, ANSWERING)
    quick: list[Attempt] = []
    patient: dict[LineSettings, Attempt] = {}
    for line in candidates:
        quick.append(Attempt(line))
        last = line == candidates[-1]
        match = _attempt(quick[-1], allowed, open_wire, interrupted, ANSWERING, late=timeout if last else 0.0)
        if match is not None:
            return match
        if timeout == ANSWERING or not quick[-1].moments:
            continue
        for earlier in quick:
            if earlier.line in patient or not earlier.may_be_late(quick, timeout):
                continue
            patient[earlier.line] = Attempt(earlier.line)
            match = _attempt(patient[earlier.line], allowed, open_wire, interrupted, timeout)
            if match is not None:
                return match
    raise NoConnectionError(_failure(port, [patient.get(attempt.line, attempt) for attempt in quick], allowed))


def _attempt(
    attempt: Attempt,
    allowed: Sequence[Dialect],
    open_wire: Callable[[LineSettings], Wire],
    interrupted: Callable[[], bool],
    timeout: float,
    late: float = 0.0,
) -> tuple[Detected, Wire] | None:
    """Try one setting, and collect late bytes afterwards."""
    if interrupted():
        return None
    attempt.began = time.monotonic()
    try:
        wire = open_wire(attempt.line)
    except LineSettingsError:
        attempt.possible = False
        return None
    try:
        match = _try(wire, attempt, allowed, timeout)
        attempt.ended = time.monotonic()
        if match is None and late > timeout:
            _lines(wire, late, lambda line: True, attempt)
    except BaseException:
        wire.close()
        raise
    if match is not None:
        return match, wire
    wire.close()
    return None


def _try(wire: Wire, attempt: Attempt, allowed: Sequence[Dialect], timeout: float) -> Detected | None:
    lines = _lines(wire, LISTENING, attempt=attempt)
    attempt.heard = bytes(wire.received)
    weights = {dialect: sum(_is_weight(dialect, line) for line in lines) for dialect in allowed}
    if (most := max(weights.values())) >= 2:
        alike = sorted((dialect for dialect in allowed if weights[dialect] == most), key=lambda one: one.turn)
        shared = [dialect for dialect in alike if dialect.query == alike[0].query]
        return _recognised(wire, shared, timeout, unasked=True)
    wait = timeout + _LONGEST_ANSWER * attempt.line.character_time
    for probe, speakers in _probes(allowed).items():
        wire.flush()
        # A leading line end terminates an incomplete earlier query in the balance's input buffer.
        wire.send(b"\r\n" + probe if probe.endswith(b"\r\n") and attempt.answers else probe)
        lines = _lines(wire, wait, lambda line, speakers=speakers: bool(_alike(speakers, [line])), attempt)  # type: ignore[misc]
        attempt.answers[probe] = bytes(wire.received)
        if alike := _alike(speakers, lines):
            return _recognised(wire, alike, timeout, unasked=False)
    return None


def _alike(dialects: Sequence[Dialect], lines: Sequence[bytes]) -> list[Dialect]:
    """Dialects that read a weight in one of the lines."""
    return [dialect for dialect in dialects if any(_is_weight(dialect, line) for line in lines)]


def _probes(allowed: Sequence[Dialect]) -> dict[bytes, list[Dialect]]:
    """Return the queries in order of `turn`, each with the dialects that use it."""
    probes: dict[bytes, list[Dialect]] = {}
    for dialect in sorted(allowed, key=lambda dialect: dialect.turn):
        probes.setdefault(dialect.query, []).append(dialect)
    return probes


def _recognised(wire: Wire, alike: Sequence[Dialect], timeout: float, *, unasked: bool) -> Detected:
    """Identify the balance, to tell dialects with the same query and lines apart."""
    dialect = alike[0]
    if not dialect.identity:
        return Detected(dialect, wire.line, unasked=unasked)
    if unasked and dialect.cancel is not None:
        wire.send(dialect.cancel)
        _lines(wire, ANSWERING)
    answers = {question: _identity(wire, question, timeout) for question in dialect.identity}
    likeliest = max(alike, key=lambda other: other.likeness(answers))
    identity = answers[dialect.identity[-1]].replace('"', "")
    return Detected(likeliest, wire.line, identity, unasked, likeliest.commands_in(answers))


def _identity(wire: Wire, question: str, timeout: float) -> str:
    """Return the reply to I0, I2 …, without the echo of the query; '' for no reply.

    'B' marks a line that others follow, and 'A' the last one.
    """
    wire.flush()
    wire.send(question.encode("ascii") + b"\r\n")
    end = time.monotonic() + LISTING
    wait = timeout + _LONGEST_ANSWER * wire.line.character_time
    last = re.compile(rf"(?:{question} (?P<state>\S)|E[STL]\s*$)(?P<text>.*)")
    texts: list[str] = []
    while time.monotonic() < end and (line := wire.line_until(min(time.monotonic() + wait, end))) is not None:
        match = last.match(line.decode("ascii", "replace"))
        if match is None:
            continue
        if match["state"] in ("A", "B"):
            texts.append(match["text"].strip())
        if match["state"] != "B":
            break
    return " ".join(texts)


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
    """Return the lines that arrive within a time, or until `enough` accepts one; after the first line, only lines that
    follow soon.

    A rest without a line end counts as a line.
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
    tail = wire.take()
    if tail and attempt is not None:
        attempt.moments.append(time.monotonic())
    return [*lines, tail] if tail else lines


def _failure(port: str, attempts: Sequence[Attempt], allowed: Sequence[Dialect]) -> str:
    """Error text: the attempts, the received bytes, and advice."""
    came = [data for attempt in attempts for data in (attempt.heard, *attempt.answers.values()) if data]
    everything = b"".join(came)
    if not any(attempt.possible for attempt in attempts):
        advice = "The port can't be set to what was asked for; set another 'baud' or 'format'."
    elif not came:
        advice = (
            "Nothing came at all: is the balance switched on, is its interface set to remote control and to one of "
            "these protocols, is it the right port and the right cable (some need a crossed one)? Some stay silent "
            "without a handshake ('handshake: hardware'), others with DTR or RTS on ('dtr: false', 'rts: false')."
        )
    elif not is_text(everything):
        advice = "What came is not text: speed or parity differ; read them in the balance's menu, and set " + (
            "'baud' and 'format'." if tcp_address(port) is None else "them in the serial server's settings."
        )
    elif b"\r" in everything and b"\n" not in everything:
        advice = "Its lines end with CR alone; choose CR LF as their end in its menu."
    else:
        advice = "It answers, but not in this way; choose another protocol in its menu, or name its dialect."
        if (line := most_telling(everything.splitlines(), allowed)) is not None:
            advice += f" It sent {explain_line(line, allowed)}."
    titles = ", ".join(dialect.title for dialect in allowed)
    tried = "\n  ".join(map(str, attempts))
    return f"{port}: no balance recognised (looked for {titles}). {advice} Sent, and received:\n  {tried}"
