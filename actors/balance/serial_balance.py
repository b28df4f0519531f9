"""A balance on a serial line: one driver for all dialects. Plain and blocking; `actors.runtime.remote_object` puts
it in a process.

Every call has a deadline. What counts has settled (`settling`), and a tare is believed once it is read back. What only
watches (`read`, `stream`) never fails and never disturbs.

Questions and commands over a wire: pace, stale lines, what answers what. Not for several threads.
"""

from __future__ import annotations

import contextlib
import math
import threading
import time
from collections.abc import Iterator
from dataclasses import asdict

from actors.balance.balance_interface import (
    LOST_REFERENCE,
    REFUSED,
    WITHOUT_EFFECT,
    BalanceDisplay,
    BalanceError,
    CommandError,
    NoConnectionError,
    OutOfRangeError,
    ReferenceLostError,
    UnitError,
    Weight,
    unsettled,
)
from actors.balance.balance_settings import SerialBalanceSpec, Settled, Settling
from actors.balance.dialect_detection import Detected, detect
from actors.balance.dialects.dialect import Dialect, LineSettings
from actors.balance.readings import Acknowledgement, LineError, Reading, ReadingReply, ReadingStatus, Reply
from actors.balance.serial_port import Counters, PortLostError, Tap, Wire

_REOPEN_INTERVAL = 0.2
_GLANCE = 0.1


class Conversation:
    """The way to one balance.

    Args:
        spec: port and settings; nothing is opened before `open`.
        interrupted: ends waits.
        tap: sees all bytes.
    """

    def __init__(self, spec: SerialBalanceSpec, interrupted: threading.Event, tap: Tap | None = None) -> None:
        self._spec, self._interrupted, self._tap = spec, interrupted, tap
        self.counters = Counters()
        self.found: Detected | None = None
        """What is at the other end, once it was found out; kept when the port vanishes."""
        self._wire: Wire | None = None
        self._asked_at = -math.inf

    @property
    def dialect(self) -> Dialect:
        """The dialect.

        Raises:
            NoConnectionError: not yet connected.
        """
        if self.found is None:
            raise NoConnectionError("not connected")
        return self.found.dialect

    @property
    def interval(self) -> float:
        """Time from question to question [s of the clock]."""
        gap = self.found.dialect.gap if self.found is not None else 0.0
        return max(self._spec.interval, gap) / self._spec.time_scale

    def open(self) -> None:
        """Open the port; the first time, find out what the settings leave open.

        Raises:
            NoConnectionError: no port, or nobody understandable there.
        """
        if self._wire is not None:
            return
        allowed, candidates = self._spec.allowed, self._spec.candidates()
        if self.found is not None:  # plugged in again: nothing has to be found out
            self._wire = self._open_wire(self.found.line)
        elif len(allowed) == 1 and len(candidates) == 1:
            self._wire = self._open_wire(candidates[0])
            self.found = Detected(allowed[0], candidates[0])
        else:
            self.found, self._wire = detect(
                self._spec.port,
                candidates,
                allowed,
                self._open_wire,
                self._interrupted.is_set,
                answer_time=self._spec.answer_time,
            )

    def reopen(self, deadline: float) -> None:
        """Wait for a vanished port to return.

        Args:
            deadline: of `time.monotonic`.

        Raises:
            NoConnectionError: it has not by then, or a wait was interrupted.
        """
        while True:
            try:
                return self.open()
            except NoConnectionError:
                if time.monotonic() + _REOPEN_INTERVAL > deadline or self._interrupted.wait(_REOPEN_INTERVAL):
                    raise

    def close(self) -> None:
        """Close the port."""
        wire, self._wire = self._wire, None
        if wire is not None:
            wire.close()

    def ask(self) -> tuple[Reading, float]:
        """What the balance shows now.

        Returns:
            The reading, status 'silent' if no answer came, and when it came [s of `time.monotonic`].

        Raises:
            NoConnectionError: the port vanished, or can't be opened.
        """
        with self._wire_at_rest() as wire:
            wire.send(self.dialect.query)
            end = time.monotonic() + self._spec.answer_time
            while (line := self._line(wire, end)) is not None:
                reply = self._understood(line)
                if isinstance(reply, Reading):
                    return reply, time.monotonic()
                if isinstance(reply, Acknowledgement) and not reply.command:
                    return Reading(ReadingStatus.BUSY, detail=f"{REFUSED}: {reply.text}"), time.monotonic()
        self.counters.unanswered += 1
        return Reading(ReadingStatus.SILENT), time.monotonic()

    def command(self, data: bytes, patience: float) -> Acknowledgement | None:
        """Send tare or zero, and wait for the answer if the dialect has one.

        Args:
            data: the command.
            patience: how long the balance may wait for rest before it answers [s of the clock].

        Returns:
            The answer; None where the dialect has none.

        Raises:
            NoConnectionError: the port vanished.
            CommandError: no answer came.
        """
        with self._wire_at_rest() as wire:
            wire.send(data)
            if not self.dialect.acknowledged:
                return None
            wanted = data.strip().decode("ascii")
            end = time.monotonic() + max(patience, self._spec.answer_time)
            while (line := self._line(wire, end)) is not None:
                reply = self._understood(line)
                if isinstance(reply, Acknowledgement) and reply.command in (wanted, ""):
                    return reply
        self.counters.unanswered += 1
        raise CommandError(f"it does not answer '{wanted}'")

    def listen(self, seconds: float) -> None:
        """Take in what comes by itself, for recording.

        Raises:
            NoConnectionError: the port vanished.
        """
        with self._wire_at_rest() as wire:
            end = time.monotonic() + seconds
            while (line := self._line(wire, end)) is not None:
                self._understood(line)

    @contextlib.contextmanager
    def _wire_at_rest(self) -> Iterator[Wire]:
        """The open wire, the pace kept and nothing unread in it; closed if it is lost in use."""
        self.open()
        assert self._wire is not None
        wait = self._asked_at + self.interval - time.monotonic()
        if wait > 0.0:
            self._interrupted.wait(wait)
        self._asked_at = time.monotonic()
        try:
            self._wire.flush()
            yield self._wire
        except PortLostError:
            self.close()
            raise

    def _line(self, wire: Wire, end: float) -> bytes | None:
        """The next line, looking up for an interruption."""
        while not self._interrupted.is_set():
            now = time.monotonic()
            line = wire.line_until(min(end, now + _GLANCE))
            if line is not None or now >= end:
                return line
        return None

    def _understood(self, line: bytes) -> Reply | None:
        try:
            reply = self.dialect.decode(line)
        except LineError:
            self.counters.damaged += 1
            return None
        self.counters.lines += 1
        return reply

    def _open_wire(self, line: LineSettings) -> Wire:
        return Wire(self._spec.port, line, self._spec.handshake, self.counters, self._tap)


ZERO_STEPS = 2.0
"""How far from zero a balance may read after taring, in steps of its display (and three times its repeatability)."""

OUT_OF_RANGE_TIME = 3.0
"""How long over or under range, or a fault, is waited out before it is an error [s of bench time]."""

COMMAND_ATTEMPTS = 3
"""How often tare or zero is sent before it has failed; nothing is poured meanwhile."""

COMMAND_TIME = 3.0
"""How long the display may take to follow tare or zero [s of bench time]."""

_RETRY_INTERVAL = 0.5

STRANGE_UNITS = 3
"""Readings in a row in a unit that is not a mass, before that is an error."""

LOSSES = 3
"""How often the connection may be lost during one weighing."""


class SerialBalance:
    """See the module's text.

    Args:
        spec: port and settings; nothing is opened before the first call.
        name: for messages.
        tap: sees all bytes, for recording.
    """

    def __init__(self, spec: SerialBalanceSpec, name: str = "balance", tap: Tap | None = None) -> None:
        self._spec, self._name = spec, name
        self._rule = spec.settling.scaled(spec.time_scale)
        self._interrupted = threading.Event()
        self._lock = threading.RLock()
        self._conversation = Conversation(spec, self._interrupted, tap)
        self._display = BalanceDisplay(spec.step)
        self._tared = self._reference_lost = False
        self._losses = self._strange_units = 0

    # What counts.

    def connect(self) -> str:
        """See `BalanceDriver.connect`: open the port and find out what is not set."""
        with self._exclusive():
            self._open()
        return self.describe()

    def tare(self) -> None:
        """See `BalanceDriver.tare`; refused, or without effect, is an error, too."""
        self._open()
        self._set_reference("tare", self._conversation.dialect.tare)

    def zero(self) -> None:
        """Set the zero of the empty balance, and see it do so.

        Raises:
            BalanceError: as `tare`; or something is on the balance, or the dialect has no such command.
        """
        self._open()
        dialect = self._conversation.dialect
        if dialect.zero is None:
            raise self._error(CommandError, f"{dialect.title} has no command for zero; use its key, or tare instead")
        self._set_reference("zero", dialect.zero)

    def weigh(self) -> Weight:
        """See `BalanceDriver.weigh`: wait until the weight has settled."""
        settled, seen = self._settle(reference_needed=True), self._display
        return Weight(settled.mass, True, settled.time, str(ReadingStatus.STABLE), seen.step, seen.last.shown)

    # What only watches.

    def read(self) -> Weight:
        """See `BalanceDriver.read`. While another call waits for an answer, the last reading."""
        if not self._lock.acquire(timeout=self._spec.answer_time / 4.0):
            return self._display.last
        try:
            if time.monotonic() - self._display.last.time >= 0.9 * self._conversation.interval:
                self._glance()
            return self._display.last
        finally:
            self._lock.release()

    def stream(self, interval: float = 0.15) -> Iterator[Weight]:
        """What the display shows, until `interrupt`.

        Args:
            interval: from one reading to the next [s of the clock].
        """
        while not self._interrupted.is_set():
            yield self.read()
            self._interrupted.wait(interval)

    def listen(self, seconds: float) -> None:
        """Ask nothing, and take in what comes by itself (for recording).

        Args:
            seconds: for how long.

        Raises:
            NoConnectionError: the port vanished.
        """
        with self._exclusive():
            self._open()
            self._conversation.listen(seconds)

    def statistics(self) -> dict[str, int]:
        """Lines understood, damaged and stale, unanswered questions, lost connections."""
        return asdict(self._conversation.counters)

    def describe(self) -> str:
        """'Kern KCP on /dev/…, 9600 baud 8N1', as far as it is known."""
        found = self._conversation.found
        if found is None:
            return f"{self._name} on {self._spec.port}, not yet connected"
        said = f" ({found.identity})" if found.identity else ""
        unasked = "; it sends without being asked: switch that off in its menu" if found.unasked else ""
        return f"{found.dialect.title}{said} on {self._spec.port}, {found.line}{unasked}"

    # Control.

    def keep_reference(self) -> None:
        """See `BalanceDriver.keep_reference`."""
        self._reference_lost = False

    def interrupt(self) -> None:
        """See `BalanceDriver.interrupt`."""
        self._interrupted.set()

    def resume(self) -> None:
        """See `BalanceDriver.resume`."""
        self._interrupted.clear()

    def close(self) -> None:
        """Close the port; the next call opens it again."""
        with self._lock:
            self._conversation.close()

    # How.

    def _set_reference(self, name: str, data: bytes) -> None:
        """Rest, command, and a display near zero afterwards."""
        said, end = "", time.monotonic() + 2.0 * self._rule.deadline
        for _ in range(COMMAND_ATTEMPTS):
            if time.monotonic() > end:
                break
            self._settle()
            said = self._send(name, data)
            if said:
                self._interrupted.wait(_RETRY_INTERVAL / self._spec.time_scale)
                continue
            settled = self._near_zero()
            if settled is None:
                self._tared, self._reference_lost = True, False
                return
            said = f"it still shows {self._display.in_grams(settled.mass)}, stable"
        raise self._error(CommandError, WITHOUT_EFFECT.format(name=name, times=COMMAND_ATTEMPTS, said=said))

    def _send(self, name: str, data: bytes) -> str:
        """Send a command; '' if it was taken (or nobody says), else why it may be sent again."""
        try:
            with self._exclusive():
                answer = self._conversation.command(data, 2.0 * COMMAND_TIME / self._spec.time_scale)
        except NoConnectionError as error:
            self._wait_for_return(error)
            return "the connection was lost"
        except CommandError as error:
            self._check_interrupted()
            return str(error)
        match answer:
            case None | Acknowledgement(answer=ReadingReply.DONE):
                return ""
            case Acknowledgement(answer=ReadingReply.BUSY):
                return "it says that it is not at rest"
            case Acknowledgement(answer=ReadingReply.OVER | ReadingReply.UNDER):
                hint = "take everything off it first" if name == "zero" else "more is on it than it can tare"
                raise self._error(OutOfRangeError, f"{name} refused, {answer.answer}: {hint}")
            case Acknowledgement(text=text):
                raise self._error(CommandError, f"{name} refused: {text or 'it does not say why'}")

    def _near_zero(self) -> Settled | None:
        """None once the display rests near zero, else where it rests when the time for following is over."""
        end = time.monotonic() + COMMAND_TIME / self._spec.time_scale
        while True:
            settled = self._settle()
            if abs(settled.mass) <= ZERO_STEPS * self._display.step * (1 + 1e-9) + 3.0 * self._spec.repeatability:
                return None
            if time.monotonic() > end:
                return settled

    def _settle(self, *, reference_needed: bool = False) -> Settled:
        """Ask until the weight has settled."""
        settling = Settling(self._rule)
        deadline = time.monotonic() + self._rule.deadline
        outside_since: float | None = None
        seen = Reading(ReadingStatus.SILENT)
        while time.monotonic() < deadline:
            self._check_interrupted()
            if reference_needed:
                self._check_reference()
            exchanged = self._exchange()
            if exchanged is None:  # connected anew
                deadline, settling = time.monotonic() + self._rule.deadline, Settling(self._rule)
                continue
            reading, moment = exchanged
            seen = reading if reading.status is not ReadingStatus.SILENT else seen
            self._check_unit(reading)
            if reading.status in (ReadingStatus.OVER, ReadingStatus.UNDER, ReadingStatus.ERROR):
                outside_since = outside_since or moment
                if moment - outside_since > OUT_OF_RANGE_TIME / self._spec.time_scale:
                    break
            else:
                outside_since = None
            stable = reading.status is ReadingStatus.STABLE
            settled = settling.feed(reading.mass() if stable else None, moment, self._display.step)
            if settled is not None:
                self._losses = 0
                return settled
        self._check_interrupted()
        damaged = self._conversation.counters.damaged
        raise self._error(*unsettled(seen, self._display.last.shown, self._spec.settling.deadline, damaged))

    def _exchange(self) -> tuple[Reading, float] | None:
        """One question and its answer; None after the connection was lost and made again."""
        try:
            with self._exclusive():
                self._conversation.open()
                reading, moment = self._conversation.ask()
                self._display.note(reading, moment)
                return reading, moment
        except NoConnectionError as error:
            self._wait_for_return(error)
            return None

    def _glance(self) -> None:
        """Take one reading if that is quickly done."""
        if self._conversation.found is None:
            return
        try:
            reading, moment = self._conversation.ask()
        except NoConnectionError:
            self._note_loss()
        else:
            self._display.note(reading, moment)

    def _note_loss(self) -> None:
        self._reference_lost = self._reference_lost or self._tared
        self._display.lose()

    def _open(self) -> None:
        """Open for the first time; a port that isn't there then won't come by waiting."""
        if self._conversation.found is not None:
            return
        try:
            with self._exclusive():
                self._conversation.open()
        except NoConnectionError as error:
            self._check_interrupted()
            raise self._said(error) from error

    def _wait_for_return(self, error: NoConnectionError) -> None:
        if self._conversation.found is None:
            raise self._said(error) from error
        self._note_loss()
        self._losses += 1
        if self._losses > LOSSES:
            self._losses = 0
            raise self._error(NoConnectionError, f"its connection comes and goes ({error}); look at cable and plug")
        try:
            with self._exclusive():
                self._conversation.reopen(time.monotonic() + self._spec.reconnect_time)
        except NoConnectionError as gone:
            self._check_interrupted()
            raise self._said(gone) from gone

    def _said(self, error: NoConnectionError) -> BalanceError:
        return self._error(type(error), str(error).removeprefix(f"{self._spec.port}: "))

    def _error(self, kind: type[BalanceError], text: str) -> BalanceError:
        return kind(f"balance {self._name} ({self._spec.port}): {text}")

    def _check_interrupted(self) -> None:
        if self._interrupted.is_set():
            raise self._error(BalanceError, "interrupted")

    def _check_reference(self) -> None:
        if self._reference_lost:
            raise self._error(ReferenceLostError, LOST_REFERENCE.format(shown=self._display.last.shown or "nothing"))

    def _check_unit(self, reading: Reading) -> None:
        """Refuse what is not a mass; but a unit that lost a letter on the line is none either, so not at once."""
        strange = reading.value is not None and bool(reading.unit) and reading.mass() is None
        self._strange_units = self._strange_units + 1 if strange else 0
        if self._strange_units >= STRANGE_UNITS:
            self._strange_units = 0
            raise self._error(
                UnitError,
                f"it shows {reading.value} {reading.unit}, and that is not a mass that is understood; switch it to g",
            )

    @contextlib.contextmanager
    def _exclusive(self) -> Iterator[None]:
        """The line for one question or command."""
        if not self._lock.acquire(timeout=self._rule.deadline + self._spec.reconnect_time):
            raise self._error(BalanceError, "another call has not ended in time")
        try:
            yield
        finally:
            self._lock.release()
