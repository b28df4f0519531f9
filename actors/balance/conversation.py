"""Questions and commands over a wire: pace, stale lines, what answers what. Not for several threads."""

from __future__ import annotations

import contextlib
import math
import threading
import time
from collections.abc import Iterator

from actors.balance.complaints import REFUSED
from actors.balance.detect import Detected, detect
from actors.balance.dialects.dialect import Dialect, LineSettings
from actors.balance.errors import CommandError, NoConnectionError
from actors.balance.reading import Acknowledgement, LineError, Reading, Reply, Status
from actors.balance.spec import SerialBalanceSpec
from actors.balance.wire import Counters, PortLostError, Tap, Wire

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
                    return Reading(Status.BUSY, detail=f"{REFUSED}: {reply.text}"), time.monotonic()
        self.counters.unanswered += 1
        return Reading(Status.SILENT), time.monotonic()

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
