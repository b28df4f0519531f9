"""The driver for balances on a serial line or behind a serial server (TCP), for all dialects.

`SerialBalance` is the `BalanceDriver`. It blocks; `actors.runtime.remote_object` runs it in a process. Every call has a
deadline. A weight counts once it has settled (`settling`), and a tare is confirmed by reading it back. `read` and
`stream` only observe: they never fail and never disturb a measurement.

`Conversation` sends queries and commands over a wire: it keeps the minimum interval, discards stale lines and matches
replies to requests. It is not thread-safe.
"""

from __future__ import annotations

import contextlib
import math
import threading
import time
from collections import deque
from collections.abc import Iterator
from dataclasses import asdict, replace
from pathlib import Path

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
from actors.balance.balance_settings import SerialBalanceSettings, Settled, Settling
from actors.balance.dialect_detection import Detected, detect
from actors.balance.dialects.dialect import Dialect, LineForm, LineSettings
from actors.balance.line_explanation import explain_line, shown_bytes
from actors.balance.line_recording import Recorder, Source
from actors.balance.readings import (
    OTHER_UNITS,
    Acknowledgement,
    LineError,
    OtherQuantityError,
    Reading,
    ReadingReply,
    ReadingStatus,
    Reply,
    WeightMark,
)
from actors.balance.serial_port import Counters, PortLostError, Tap, Wire
from actors.runtime.bench_clock import device_clock

_REOPEN_INTERVAL = 0.2

LATEST, _GLANCE = 0.2, 0.02
"""Longest times between two looks at the line during a weighing [s of bench time, s of the clock]; the clock of a
virtual bench waits for the next one. Otherwise a busy host would leave room for a few readings only until a weight must
have settled, and a dose would see its last grams late."""


class Conversation:
    """The connection to one balance.

    Args:
        spec: port and settings; nothing is opened before `open`.
        interrupted: ends waits.
        tap: receives all bytes.
    """

    def __init__(self, spec: SerialBalanceSettings, interrupted: threading.Event, tap: Tap | None = None) -> None:
        self._spec, self._interrupted, self._tap = spec, interrupted, tap
        self.counters, self.time_scale, self.clock = Counters(), spec.time_scale, device_clock(spec.clock)
        self.found: Detected | None = None
        """The detected balance; kept when the port vanishes."""
        self.refused: bytes | None = None
        """The last line without a weight since the last query."""
        self._wire: Wire | None = None
        self._form = LineForm()
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
        """Time between two queries [s of the clock]."""
        gap = self.found.dialect.gap if self.found is not None else 0.0
        return max(self._spec.interval, gap) / self.time_scale

    def open(self) -> None:
        """Open the port; the first time, detect the settings that are not given.

        Raises:
            NoConnectionError: no port, or no balance recognised on it.
        """
        if self._wire is not None:
            return
        allowed, candidates = self._spec.allowed, self._spec.candidates()
        if self.found is not None:  # reconnected: no detection needed
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
                answer_time=self._spec.answer_time * self.clock.patience,
            )

    def reopen(self, deadline: float) -> None:
        """Wait for a vanished port to return.

        Args:
            deadline: of the clock.

        Raises:
            NoConnectionError: it did not return before the deadline, or the wait was interrupted.
        """
        while True:
            try:
                return self.open()
            except NoConnectionError:
                if self.clock.now + _REOPEN_INTERVAL > deadline or self._interrupted.wait(_REOPEN_INTERVAL):
                    raise

    def close(self) -> None:
        """Close the port."""
        wire, self._wire = self._wire, None
        if wire is not None:
            wire.close()

    def ask(self) -> tuple[Reading, float]:
        """Request the display's current weight.

        Returns:
            The reading and its time [s of the clock]. Its status is 'silent' if nothing came, and 'not
            understood' if lines came, but none with the weight that the settings name.

        Raises:
            NoConnectionError: the port vanished, or cannot be opened.
        """
        self.refused = None
        with self._wire_at_rest() as wire:
            wire.send(self.dialect.query)
            end = self.clock.now + self._spec.answer_time
            held: tuple[Reading, float] | None = None
            while (line := self._line(wire, end)) is not None:
                reply = self._decoded(line)
                if isinstance(reply, Reading) and reply.mark in (None, self._spec.weight):
                    return reply, self.clock.now
                if isinstance(reply, Reading):
                    if self._spec.weight == "gross":
                        self.refused = line
                    elif held is None:  # without a tare, gross is net; a balance that sends both sends net soon
                        held = reply, self.clock.now
                        end = min(end, max(self._asked_at + self.interval, held[1]))
                    continue
                if isinstance(reply, Acknowledgement) and not reply.command and reply.answer is ReadingReply.REFUSED:
                    return Reading(ReadingStatus.BUSY, detail=f"{REFUSED}: {reply.text}"), self.clock.now
        if held is not None:
            return held
        self.counters.unanswered += 1
        if self.refused is None:
            return Reading(ReadingStatus.SILENT), self.clock.now
        return Reading(ReadingStatus.UNREADABLE, detail=self._explained(self.refused)), self.clock.now

    def command(self, data: bytes, timeout: float) -> Acknowledgement | None:
        """Send tare or zero, and wait for the reply if the dialect has one.

        Args:
            data: the command.
            timeout: longest time for which the balance may wait for stability before it replies [s of the clock].

        Returns:
            The reply; None if the dialect has none, or if it is optional and none came.

        Raises:
            NoConnectionError: the port vanished.
            CommandError: no reply came.
        """
        with self._wire_at_rest() as wire:
            wire.send(data)
            if self.dialect.acknowledged is False:
                return None
            wanted = data.strip().decode("ascii")
            wait = max(timeout, self._spec.answer_time) if self.dialect.acknowledged else self._spec.answer_time
            end = self.clock.now + wait
            while (line := self._line(wire, end)) is not None:
                reply = self._decoded(line)
                if (
                    isinstance(reply, Acknowledgement)
                    and reply.command in (wanted, "")
                    and reply.answer is not ReadingReply.BEGUN
                ):
                    return reply
            if self.dialect.acknowledged is None:
                return None
        self.counters.unanswered += 1
        raise CommandError(f"it does not answer '{wanted}'")

    def listen(self, seconds: float) -> None:
        """Receive unsolicited lines, for recording.

        Raises:
            NoConnectionError: the port vanished.
        """
        with self._wire_at_rest() as wire:
            end = self.clock.now + seconds
            while (line := self._line(wire, end)) is not None:
                self._decoded(line)

    @contextlib.contextmanager
    def _wire_at_rest(self) -> Iterator[Wire]:
        """The open wire, with the query interval kept and no unread bytes; closed if it is lost in use."""
        self.open()
        assert self._wire is not None
        wait = self._asked_at + self.interval - self.clock.now
        try:
            self._promise(max(wait, 0.0))
            if wait > 0.0:
                self._interrupted.wait(wait)
            self._asked_at = self.clock.now
            self._wire.flush()
            yield self._wire
        except PortLostError:
            self.close()
            raise
        finally:
            self.clock.withdraw("weighing")

    def _line(self, wire: Wire, end: float) -> bytes | None:
        """Return the next line; checks for an interruption while waiting."""
        while not self._interrupted.is_set():
            left = end - self.clock.now
            glance = min(left, self._latest)
            self._promise(glance)
            line = wire.line_until(time.monotonic() + glance)
            if line is not None or left <= 0.0:
                return line
        return None

    def _promise(self, wait: float) -> None:
        """Let the clock of a virtual bench stand if this thread is late after a wait [s of the clock]."""
        self.clock.promise("weighing", wait + self._latest)

    @property
    def _latest(self) -> float:
        return min(_GLANCE, LATEST / self.time_scale)

    def _decoded(self, line: bytes) -> Reply | None:
        try:
            reply = self.dialect.decode(line)
        except LineError as error:
            if isinstance(error, OtherQuantityError):
                self.counters.other += 1
            else:
                self.counters.damaged += 1
            self.refused = line
            return None
        if isinstance(reply, Reading) and reply.value is not None and not self._form.keeps(line):
            self.counters.damaged += 1
            self.refused = line
            return None
        self.counters.lines += 1
        return reply

    def _explained(self, line: bytes) -> str:
        """Return what a line without the weight is, and the remedy."""
        try:
            self.dialect.decode(line)
        except LineError:
            return explain_line(line, [self.dialect])
        return f"{shown_bytes(line)}: the net weight, and 'weight: gross' is set. Set its print-out to gross"

    def _open_wire(self, line: LineSettings) -> Wire:
        spec = self._spec
        return Wire(spec.port, line, spec.handshake, self.counters, self._tap, dtr=spec.dtr, rts=spec.rts)


ZERO_STEPS = 2.0
"""Largest reading after a tare, in display steps; three times the repeatability is added."""

OUT_OF_RANGE_TIME = 3.0
"""Longest time over or under range, or with a fault, before it is an error [s of bench time]."""

COMMAND_ATTEMPTS = 3
"""Number of attempts for tare or zero before it fails; no pour runs meanwhile."""

COMMAND_TIME = 3.0
"""Longest time until the display follows tare or zero [s of bench time]."""

_RETRY_INTERVAL = 0.5

STRANGE_UNITS = 3
"""Number of consecutive readings in a unit that is not a mass, or with another mark than at the tare, before it is an
error."""

LOSSES = 3
"""Number of lost connections allowed during one weighing."""


OFF_TIME = 3.0
"""Silence after which a balance may have been switched off, although its port stayed open [s of the clock]: a serial
server or a USB adapter does not notice that. Longer than a busy balance or a stalled computer needs."""


# More than 25 methods: the whole balance interface, and each check of a reading by name.
class SerialBalance:
    """Driver of a serial balance; see the module docstring.

    Args:
        spec: port and settings; nothing is opened before the first call.
        name: for messages.
        tap: receives all bytes, for recording.
    """

    def __init__(self, spec: SerialBalanceSettings, name: str = "balance", tap: Tap | None = None) -> None:
        self._spec, self._name = spec, name
        self._rule = spec.settling.scaled(spec.time_scale)
        self._interrupted = threading.Event()
        self._lock = threading.RLock()
        if tap is None and spec.raw_lines is not None:
            source: Source = "hardware" if spec.virtual is None else "virtual"
            tap = Recorder.in_folder(Path(spec.raw_lines), name, source, spec.port)
        self._conversation = Conversation(spec, self._interrupted, tap)
        self._clock = self._conversation.clock
        self._display = BalanceDisplay(spec.step)
        self._tared = self._reference_lost = False
        self._mark: WeightMark | None = None
        self._seen_mark: WeightMark | None = None
        self._strange_marks = 0
        self._kept_tare = 0.0
        self._losses = self._strange_units = 0
        self._silent_since: float | None = None

    @property
    def found(self) -> Detected | None:
        """The balance as it was detected; None before it is connected."""
        return self._conversation.found

    # Measurements.

    def connect(self) -> str:
        """See `BalanceDriver.connect`; opens the port and detects the settings that are not given."""
        with self._exclusive():
            self._open()
        return self.describe()

    def tare(self) -> None:
        """See `BalanceDriver.tare`; a tare that is refused or has no effect is an error, too.

        With 'weight: gross' nothing is sent: the driver subtracts the present weight from now on.
        """
        self._open()
        if self._spec.weight == "gross":
            self._kept_tare = self._settle().mass
            self._note_reference()
            return
        self._set_reference("tare", self._conversation.dialect.tare)

    def zero(self) -> None:
        """Set the zero of the empty balance, and verify it.

        Raises:
            BalanceError: as `tare`; or the balance is loaded, or the dialect has no such command.
        """
        self._open()
        dialect = self._conversation.dialect
        if dialect.zero is None:
            raise self._error(CommandError, f"{dialect.title} has no command for zero; use its key, or tare instead")
        self._set_reference("zero", dialect.zero)
        self._kept_tare = 0.0

    def weigh(self) -> Weight:
        """See `BalanceDriver.weigh`; waits until the weight has settled."""
        self._open()  # to find out which balance it is takes seconds, which are not of this weighing
        settled, seen = self._settle(reference_needed=True), self._display
        mass = settled.mass - self._kept_tare
        return Weight(mass, True, settled.time, str(ReadingStatus.STABLE), seen.step, seen.last.shown)

    # Observation.

    def read(self) -> Weight:
        """See `BalanceDriver.read`; returns the last reading while another call waits for a reply."""
        if self._lock.acquire(timeout=self._spec.answer_time / 4.0):
            try:
                if self._clock.now - self._display.last.time >= 0.9 * self._conversation.interval:
                    self._read_once()
            finally:
                self._lock.release()
        last = self._display.last
        return replace(last, mass=last.mass - self._kept_tare) if self._kept_tare else last

    def stream(self, interval: float = 0.15) -> Iterator[Weight]:
        """Yield the display's weight until `interrupt`.

        Args:
            interval: between two readings [s of the clock].
        """
        while not self._interrupted.is_set():
            yield self.read()
            self._interrupted.wait(interval)

    def listen(self, seconds: float) -> None:
        """Send nothing, and receive unsolicited lines (for recording).

        Args:
            seconds: duration.

        Raises:
            NoConnectionError: the port vanished.
        """
        with self._exclusive():
            self._open()
            self._conversation.listen(seconds)

    def statistics(self) -> dict[str, int]:
        """Counts of valid, damaged and stale lines, unanswered queries and lost connections."""
        return asdict(self._conversation.counters)

    def describe(self) -> str:
        """Describe the connection: 'Kern KCP on /dev/…, 9600 baud 8N1', as far as it is known."""
        match = self._conversation.found
        if match is None:
            return f"{self._name} on {self._spec.port}, not yet connected"
        identity = f" ({match.identity})" if match.identity else ""
        unasked = "; it sends without being asked: switch that off in its menu" if match.unasked else ""
        return f"{match.dialect.title}{identity} on {self._spec.port}, {match.line}{unasked}"

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

    def pace(self, time_scale: float) -> None:
        """Set the bench seconds per second of the clock, of a virtual bench."""
        self._spec, self._conversation.time_scale = self._spec.with_values(time_scale=time_scale), time_scale
        self._rule = self._spec.settling.scaled(time_scale)

    def close(self) -> None:
        """Close the port; the next call opens it again."""
        with self._lock:
            self._conversation.close()

    # Implementation.

    def _set_reference(self, name: str, data: bytes) -> None:
        """Wait for a stable weight, send the command, and verify that the display is near zero."""
        match, word = self._conversation.found, data.strip().decode("ascii", "replace")
        if match is not None and match.commands and word not in match.commands:
            text = f"it has no {name}: the commands that it lists (I0) leave '{word}' out. Use its key"
            raise self._error(CommandError, text)
        answer, end = "", self._clock.now + 2.0 * self._rule.deadline
        for _ in range(COMMAND_ATTEMPTS):
            if self._clock.now > end:
                break
            self._settle()
            answer = self._send(name, data)
            if answer:
                self._interrupted.wait(_RETRY_INTERVAL / self._spec.time_scale)
                continue
            settled = self._near_zero()
            if settled is None:
                self._note_reference()
                return
            answer = f"it still shows {self._display.in_grams(settled.mass)}, stable"
            if self._seen_mark is WeightMark.GROSS:
                answer += (
                    ", and that is the gross weight, which a tare does not change: set its print-out to net, or "
                    "'weight: gross' in the laboratory's file"
                )
        raise self._error(CommandError, WITHOUT_EFFECT.format(name=name, times=COMMAND_ATTEMPTS, said=answer))

    def _note_reference(self) -> None:
        """Record that the display's present mark and zero are those of the tare."""
        self._tared, self._reference_lost, self._mark = True, False, self._seen_mark

    def _send(self, name: str, data: bytes) -> str:
        """Send a command; return '' if it was accepted or has no reply, otherwise the reason for a retry."""
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
        """Return None once the display settles near zero; after the time limit, return the settled weight."""
        end = self._clock.now + COMMAND_TIME / self._spec.time_scale
        while True:
            settled = self._settle()
            if abs(settled.mass) <= ZERO_STEPS * self._display.step * (1 + 1e-9) + 3.0 * self._spec.repeatability:
                return None
            if self._clock.now > end:
                return settled

    def _settle(self, *, reference_needed: bool = False) -> Settled:
        """Send queries until the weight has settled."""
        settling = Settling(self._rule)
        deadline = self._clock.now + self._rule.deadline
        outside_since: float | None = None
        seen, masses = Reading(ReadingStatus.SILENT), deque[float](maxlen=9)
        while self._clock.now < deadline:
            self._check_interrupted()
            if reference_needed:
                self._check_reference()
            exchanged = self._exchange()
            if exchanged is None:  # reconnected
                deadline, settling = self._clock.now + self._rule.deadline, Settling(self._rule)
                continue
            reading, moment = exchanged
            seen = reading if reading.status is not ReadingStatus.SILENT else seen
            if (mass := reading.mass()) is not None:
                masses.append(mass)
            self._check_unit(reading)
            of_tare = self._check_mark(reading, needed=reference_needed)
            if reading.status in (ReadingStatus.OVER, ReadingStatus.UNDER, ReadingStatus.ERROR):
                outside_since = outside_since or moment
                if moment - outside_since > OUT_OF_RANGE_TIME / self._spec.time_scale:
                    break
            else:
                outside_since = None
            stable = reading.status is ReadingStatus.STABLE and of_tare
            settled = settling.feed(reading.mass() if stable else None, moment, self._display.step)
            if settled is not None:
                self._losses = 0
                return settled
        self._check_interrupted()
        damaged = self._conversation.counters.damaged
        raise self._error(*unsettled(seen, self._display.last.shown, self._spec.settling.deadline, damaged, masses))

    def _exchange(self) -> tuple[Reading, float] | None:
        """Send one query and return its reply; None after a lost connection was restored."""
        try:
            with self._exclusive():
                self._conversation.open()
                reading, moment = self._conversation.ask()
                self._note(reading, moment)
                return reading, moment
        except NoConnectionError as error:
            self._wait_for_return(error)
            return None

    def _read_once(self) -> None:
        """Take one reading; only if the balance is already identified."""
        if self._conversation.found is None:
            return
        try:
            reading, moment = self._conversation.ask()
        except NoConnectionError:
            self._note_loss()
        else:
            self._note(reading, moment)

    def _note(self, reading: Reading, moment: float) -> None:
        if reading.status is not ReadingStatus.SILENT:
            self._silent_since = None
        elif self._silent_since is None:
            self._silent_since = moment - self._spec.answer_time
        elif moment - self._silent_since >= OFF_TIME:
            self._reference_lost = self._reference_lost or self._tared
        self._display.note(reading, moment)

    def _note_loss(self) -> None:
        self._reference_lost = self._reference_lost or self._tared
        self._display.lose(self._clock.now)

    def _open(self) -> None:
        """Open the port for the first time; a port that is missing then is not waited for."""
        if self._conversation.found is not None:
            return
        try:
            with self._exclusive():
                self._conversation.open()
        except NoConnectionError as error:
            self._check_interrupted()
            raise self._connection_error(error) from error

    def _wait_for_return(self, error: NoConnectionError) -> None:
        if self._conversation.found is None:
            raise self._connection_error(error) from error
        self._note_loss()
        self._losses += 1
        if self._losses > LOSSES:
            self._losses = 0
            raise self._error(NoConnectionError, f"its connection comes and goes ({error}); look at cable and plug")
        try:
            with self._exclusive():
                self._conversation.reopen(self._clock.now + self._spec.reconnect_time)
        except NoConnectionError as gone:
            self._check_interrupted()
            raise self._connection_error(gone) from gone

    def _connection_error(self, error: NoConnectionError) -> BalanceError:
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
        """Reject a unit that is not a mass, or a stable number without one. A unit that lost a letter on the line is no
        mass either, so this needs several readings.
        """
        unit = bool(reading.unit) or reading.status is ReadingStatus.STABLE
        strange = reading.value is not None and unit and reading.mass() is None
        self._strange_units = self._strange_units + 1 if strange else 0
        if self._strange_units >= STRANGE_UNITS:
            self._strange_units = 0
            meaning = OTHER_UNITS.get(reading.unit.lower(), "not a mass that is understood")
            wrong = (
                f"it shows {reading.value} {reading.unit}, and that is {meaning}; switch it to g"
                if reading.unit
                else f"it sends {reading.value} without a unit; switch on the unit in the print settings of its menu"
            )
            raise self._error(UnitError, wrong)

    def _check_mark(self, reading: Reading, *, needed: bool) -> bool:
        """Return whether a reading is the same weight, net or gross, as at the tare; several others are an error.

        A balance whose tare is cleared by its key shows the gross weight from then on, and marks it so. Lines that are
        not stable may lack the mark.
        """
        if reading.status is not ReadingStatus.STABLE:
            return True
        if not needed:
            self._seen_mark = reading.mark
            return True
        same = not self._tared or reading.mark is self._mark
        self._strange_marks = 0 if same else self._strange_marks + 1
        if self._strange_marks >= STRANGE_UNITS:
            self._strange_marks = 0
            shown, was = reading.mark or "unmarked", self._mark or "unmarked"
            text = (
                f"it shows the {shown} weight, {reading.value} {reading.unit}, but showed the {was} weight after the "
                "last tare: the tare was cleared or changed at the balance. Tare it again"
            )
            raise self._error(CommandError, text)
        return same

    @contextlib.contextmanager
    def _exclusive(self) -> Iterator[None]:
        """Hold the line for one query or command."""
        if not self._lock.acquire(timeout=(self._rule.deadline + self._spec.reconnect_time) * self._clock.patience):
            raise self._error(BalanceError, "another call has not ended in time")
        try:
            yield
        finally:
            self._lock.release()
