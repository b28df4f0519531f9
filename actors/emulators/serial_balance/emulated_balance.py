"""An emulated balance with injectable faults, as bytes in and bytes out.

`EmulatedBalance` is the interface that the pty server serves. `Emulation` implements it with a dialect and a scale;
`FaultyDisplay` and `spoil` apply the `BalanceFaults` to display and line. The module opens no port.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from decimal import Decimal
from typing import Any, Protocol

import numpy as np

from actors.balance.dialect_registry import encoders
from actors.balance.dialects.protocol_encoder import Cancel, Follow, PendingReply, Repeat, weight_line
from actors.balance.readings import Reading, ReadingStatus
from actors.balance.scale_model import EmulatedScale, Load, ScaleSettings


@dataclass(frozen=True)
class BalanceFaults:
    """Active faults; all are off at first.

    Attributes:
        silent: sends nothing and ignores all input.
        frozen: the display keeps its reading from the start of the fault, independent of load and tare.
        restless: never stable.
        powerless: acknowledges tare and zero, but does nothing.
        fault: reports this error instead of weights.
        stranger: recognises no query, and sends an error if its dialect has one.
        unit: shown instead of its own, e.g. 'pcs'.
        garbage: fraction of lines with random bytes inserted.
        halved: fraction of lines that lose their first half.
        unasked: interval of unsolicited lines [s of the clock]; 0: none.
        interleaved: unsolicited lines may split replies.
        delay: additional delay of replies [s of the clock].
    """

    silent: bool = False
    frozen: bool = False
    restless: bool = False
    powerless: bool = False
    stranger: bool = False
    fault: str = ""
    unit: str = ""
    garbage: float = 0.0
    halved: float = 0.0
    unasked: float = 0.0
    interleaved: bool = False
    delay: float = 0.0


class FaultyDisplay:
    """A scale's display with faults. See `protocol_encoder.EncoderDisplay`."""

    def __init__(self, scale: EmulatedScale) -> None:
        self.scale = scale
        self.faults = BalanceFaults()
        self._frozen: Reading | None = None
        self.count = 0
        """Number of readings so far."""

    def set(self, changes: dict[str, Any]) -> None:
        """Change faults by name; others stay."""
        self.faults = replace(self.faults, **changes)
        self._frozen = (self._frozen or self.reading()) if self.faults.frozen else None

    def reading(self) -> Reading:
        """Return the display's reading."""
        self.count += 1
        if self._frozen is not None:
            return self._frozen
        if self.faults.fault:
            return Reading(ReadingStatus.ERROR, detail=f"error {self.faults.fault}")
        reading = self.scale.reading()
        if self.faults.restless and reading.status is ReadingStatus.STABLE:
            reading = replace(reading, status=ReadingStatus.UNSTABLE)
        return replace(reading, unit=self.faults.unit) if self.faults.unit and reading.unit else reading

    def tare(self) -> ReadingStatus:
        """See `EmulatedScale.tare`."""
        return ReadingStatus.STABLE if self.faults.powerless else self.scale.tare()

    def zero(self) -> ReadingStatus:
        """See `EmulatedScale.zero`."""
        return ReadingStatus.STABLE if self.faults.powerless else self.scale.zero()


def spoil(line: bytes, faults: BalanceFaults, rng: np.random.Generator) -> bytes:
    """Apply the line faults to a line.

    Args:
        line: as sent.
        faults: the active faults.
        rng: random number generator.
    """
    if rng.random() < faults.halved:
        line = line[len(line) // 2 :]
    if rng.random() < faults.garbage:
        at = int(rng.integers(0, len(line) + 1))
        line = line[:at] + rng.bytes(int(rng.integers(1, 12))) + line[at:]
    return line


COMMAND_PATIENCE = 5.0
"""Longest time that a command waits for a stable display [s of bench time]."""


class EmulatedBalance(Protocol):
    """Receives and returns bytes; does not depend on a port."""

    def hear(self, data: bytes, now: float) -> None:
        """Process bytes from a client."""
        ...

    def speak(self, now: float) -> bytes:
        """Return the bytes that are due now."""
        ...

    def due(self, now: float) -> float | None:
        """Return the next time at which `speak` must be called without new input; None: not before new input."""
        ...

    def control(self, order: dict[str, Any], now: float) -> dict[str, Any]:
        """Execute a control command; return the result, JSON-ready.

        Raises:
            KeyError, TypeError, ValueError: unknown command.
        """
        ...


class Emulation:
    """A balance with a dialect.

    Args:
        dialect: one of `actors.balance.dialect_registry.encoders`.
        settings: of its scale.
        time_scale: bench seconds per second of the clock; 0: bench time passes by command only.
        latency: time between query and reply [s of the clock].
        seed: of its random numbers.
    """

    def __init__(
        self, dialect: str, settings: ScaleSettings, time_scale: float, latency: float, seed: tuple[int, ...]
    ) -> None:
        self._encoder = encoders()[dialect]()
        self._scale = EmulatedScale(settings, seed)
        self._display = FaultyDisplay(self._scale)
        self._time_scale, self._latency = time_scale, latency
        self._rng = np.random.default_rng((*seed, 7))
        self._received = bytearray()
        self._questions = 0
        self._waiting: tuple[PendingReply, float] | None = None
        self._repeat = Repeat()
        self._repeat_at: float | None = None
        self._following: Follow | None = None
        self._stable_value: Decimal | None = None
        self._unasked_at: float | None = None
        self._answers: list[tuple[float, bytes]] = []
        self._now: float | None = None

    def hear(self, data: bytes, now: float) -> None:
        """See `EmulatedBalance.hear`."""
        self._advance(now)
        if self._display.faults.silent:
            return
        self._received += data
        for command in self._encoder.commands(self._received):
            self._questions += 1
            self._repeat_at = self._following = None
            self._carry_out(command, now)

    def speak(self, now: float) -> bytes:
        """See `EmulatedBalance.speak`."""
        self._advance(now)
        faults = self._display.faults
        if self._waiting is not None:
            self._wait_on(now)
        if self._repeat_at is not None and now >= self._repeat_at:
            self._repeat_at = now + self._repeat.interval / (self._time_scale or 1.0)
            reading = self._display.reading()
            self._send(self._repeat.line(reading) if self._repeat.line is not None else self._weight(), now)
        if self._following is not None:
            self._follow(self._following, now)
        ready = b"".join(line for at, line in self._answers if at <= now)
        self._answers = [(at, line) for at, line in self._answers if at > now]
        if faults.unasked > 0.0 and now >= (self._unasked_at or 0.0):
            self._unasked_at = now + faults.unasked
            at = len(ready) // 2 if faults.interleaved else len(ready)
            ready = ready[:at] + self._weight() + ready[at:]
        return b"" if faults.silent else ready

    def due(self, now: float) -> float | None:
        """See `EmulatedBalance.due`."""
        times = [at for at, _ in self._answers]
        if self._repeat_at is not None:
            times.append(self._repeat_at)
        if self._display.faults.unasked > 0.0:
            times.append(self._unasked_at or now)
        if self._waiting is not None or self._following is not None:
            times.append(now + 0.01)
        return min(times, default=None)

    def control(self, order: dict[str, Any], now: float) -> dict[str, Any]:
        """See `EmulatedBalance.control`."""
        self._advance(now)
        match order:
            case {"do": "put", "times": times, "masses": masses}:
                self._scale.put(Load(tuple(times), tuple(masses)))
            case {"do": "load", "mass": mass}:
                self._scale.change(float(mass))
            case {"do": "prepare", "seed": seed}:
                self._scale.prepare(tuple(seed))
                self._waiting = self._repeat_at = self._following = None
            case {"do": "faults", **changes}:
                self._display.set(changes)
            case {"do": "pace", "scale": scale}:
                self._time_scale = float(scale)
            case {"do": "advance", "seconds": seconds}:
                self._scale.advance(float(seconds))
            case {"do": "power cycle"}:
                self._scale.power_cycle()
                self._waiting = self._repeat_at = self._following = None
            case {"do": "state"}:
                return {
                    "truth": self._scale.truth,
                    "shown": str(self._display.reading()),
                    "time": self._scale.time,
                    "questions": self._questions,
                }
            case _:
                raise ValueError(f"unknown order {order}")
        return {}

    def _advance(self, now: float) -> None:
        if self._now is not None and self._time_scale > 0.0:
            self._scale.advance(max(now - self._now, 0.0) * self._time_scale)
        self._now = now

    def _carry_out(self, command: bytes, now: float) -> None:
        seen = self._display.count
        reply = self._encoder.answer(b"?" if self._display.faults.stranger else command, self._display)
        if isinstance(reply, Repeat):
            self._repeat, self._repeat_at = reply, now
        elif isinstance(reply, Follow):
            self._following, self._stable_value = reply, None
        elif isinstance(reply, Cancel):
            self._waiting = None
            self._reply(reply.line, now)
        elif isinstance(reply, PendingReply):
            self._reply(reply.first, now)
            timeout = COMMAND_PATIENCE if reply.timeout is None else reply.timeout
            self._waiting = (reply, now + (timeout / self._time_scale if self._time_scale > 0.0 else math.inf))
            self._wait_on(now)
        elif self._display.count > seen:
            faults = self._display.faults
            self._send(spoil(reply, faults, self._rng) if reply else b"", now + self._latency + faults.delay)
        else:
            self._reply(reply, now)

    def _wait_on(self, now: float) -> None:
        """Execute the pending command if the display is stable, or end it after its time limit."""
        assert self._waiting is not None
        waiting, until = self._waiting
        if self._scale.stable and not self._display.faults.restless:
            self._waiting = None
            self._reply(waiting.done(), now)
        elif now > until and waiting.expired is not None:
            self._waiting = None
            self._reply(waiting.expired if isinstance(waiting.expired, bytes) else waiting.expired(), now)

    def _follow(self, following: Follow, now: float) -> None:
        """Report the weight once it is stable, and its changes."""
        reading = self._display.reading()
        if self._stable_value is None:
            if reading.status is ReadingStatus.STABLE and reading.value is not None:
                self._stable_value = reading.value
                self._answers.append((now, following.line(reading)))
        elif reading.value is None or abs(reading.value - self._stable_value) >= following.step(self._stable_value):
            self._stable_value = None
            if following.moving and reading.status is not ReadingStatus.STABLE:
                self._answers.append((now, following.line(reading)))

    def _reply(self, line: bytes, now: float) -> None:
        if line:
            faults = self._display.faults
            self._answers.append((now + self._latency + faults.delay, spoil(line, faults, self._rng)))

    def _send(self, line: bytes, due: float) -> None:
        """Send a weight, which may come late or be lost (see `DisplayBehaviour`)."""
        display = self._scale.display
        if line and not display.loses():
            self._answers.append((display.arrival(due, self._time_scale or 1.0), line))

    def _weight(self) -> bytes:
        return weight_line(self._encoder.dialect, self._display.reading())
