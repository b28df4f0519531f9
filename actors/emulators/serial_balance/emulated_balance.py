"""Who sits at the far end of a virtual line: an emulated balance.

What may go wrong with a virtual balance, and how it then shows on display and line.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from decimal import Decimal
from typing import Any, Protocol

import numpy as np

from actors.balance.dialect_registry import voices
from actors.balance.dialects.protocol_encoder import Cancel, Follow, PendingReply, Repeat, weight_line
from actors.balance.readings import Reading, ReadingStatus
from actors.balance.simulated_balance import EmulatedScale, Load, ScaleSettings


@dataclass(frozen=True)
class BalanceFaults:
    """Faults in force; all off at first.

    Attributes:
        silent: says nothing and hears nothing.
        frozen: the display stands as it was when this began, load and tare notwithstanding.
        restless: never stable.
        powerless: acknowledges tare and zero, and does nothing.
        fault: reports this error instead of weights.
        stranger: understands no question, and says so where its dialect has words for it.
        unit: shown instead of its own, e.g. 'pcs'.
        garbage: share of lines that noise is mixed into.
        halved: share of lines that lose their first half.
        unasked: prints by itself every so many seconds of the clock; 0: never.
        interleaved: unasked lines may cut answers in two.
        delay: answers come so much later [s of the clock].
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
    """A scale's display with faults. See `voice.Display`."""

    def __init__(self, scale: EmulatedScale) -> None:
        self.scale = scale
        self.faults = BalanceFaults()
        self._frozen: Reading | None = None

    def set(self, changes: dict[str, Any]) -> None:
        """Change faults by name; others stay."""
        self.faults = replace(self.faults, **changes)
        self._frozen = (self._frozen or self.reading()) if self.faults.frozen else None

    def reading(self) -> Reading:
        """What the display shows."""
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
    """A line as it comes off a bad cable.

    Args:
        line: as said.
        faults: in force.
        rng: of chance.
    """
    if rng.random() < faults.halved:
        line = line[len(line) // 2 :]
    if rng.random() < faults.garbage:
        at = int(rng.integers(0, len(line) + 1))
        line = line[:at] + rng.bytes(int(rng.integers(1, 12))) + line[at:]
    return line


REPEAT_INTERVAL = 0.2
"""From one repeated reading to the next [s of bench time]."""

COMMAND_PATIENCE = 5.0
"""How long a command waits for rest before the balance gives it up [s of bench time]."""


class EmulatedBalance(Protocol):
    """Hears and speaks; knows no ports."""

    def hear(self, data: bytes, now: float) -> None:
        """Take in what a client sent."""
        ...

    def speak(self, now: float) -> bytes:
        """What is to be sent by now."""
        ...

    def due(self, now: float) -> float | None:
        """When to ask again though nothing was received; None: not before."""
        ...

    def control(self, order: dict[str, Any], now: float) -> dict[str, Any]:
        """Carry out what the one who holds the strings wants; an answer, JSON-ready.

        Raises:
            KeyError, TypeError, ValueError: an order that isn't known.
        """
        ...


class Emulation:
    """A balance that speaks a dialect.

    Args:
        dialect: one of `doors.voices`.
        settings: of its scale.
        time_scale: bench seconds per second of the clock; 0: bench time passes by order only.
        latency: from question to answer [s of the clock].
        seed: of its chance.
    """

    def __init__(
        self, dialect: str, settings: ScaleSettings, time_scale: float, latency: float, seed: tuple[int, ...]
    ) -> None:
        self._voice = voices()[dialect]()
        self._scale = EmulatedScale(settings, seed)
        self._display = FaultyDisplay(self._scale)
        self._time_scale, self._latency = time_scale, latency
        self._rng = np.random.default_rng((*seed, 7))
        self._heard = bytearray()
        self._questions = 0
        self._waiting: tuple[PendingReply, float] | None = None
        self._repeat = Repeat()
        self._repeat_at: float | None = None
        self._following: Follow | None = None
        self._stood_at: Decimal | None = None
        self._unasked_at: float | None = None
        self._answers: list[tuple[float, bytes]] = []
        self._now: float | None = None

    def hear(self, data: bytes, now: float) -> None:
        """See `EmulatedBalance.hear`."""
        self._advance(now)
        if self._display.faults.silent:
            return
        self._heard += data
        for command in self._voice.commands(self._heard):
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
            self._repeat_at = now + REPEAT_INTERVAL / (self._time_scale or 1.0)
            reading = self._display.reading()
            self._answers.append((now, self._repeat.line(reading) if self._repeat.line is not None else self._weight()))
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
            case {"do": "prepare", "seed": seed}:
                self._scale.prepare(tuple(seed))
                self._waiting = self._repeat_at = self._following = None
            case {"do": "faults", **changes}:
                self._display.set(changes)
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
        said = self._voice.answer(b"?" if self._display.faults.stranger else command, self._display)
        if isinstance(said, Repeat):
            self._repeat, self._repeat_at = said, now
        elif isinstance(said, Follow):
            self._following, self._stood_at = said, None
        elif isinstance(said, Cancel):
            self._waiting = None
            self._say(said.line, now)
        elif isinstance(said, PendingReply):
            patience = COMMAND_PATIENCE if said.patience is None else said.patience
            self._waiting = (said, now + (patience / self._time_scale if self._time_scale > 0.0 else math.inf))
            self._wait_on(now)
        else:
            self._say(said, now)

    def _wait_on(self, now: float) -> None:
        """Carry out the command that waits for rest, or give it up."""
        assert self._waiting is not None
        waiting, until = self._waiting
        if self._scale.stable and not self._display.faults.restless:
            self._waiting = None
            self._say(waiting.done(), now)
        elif now > until and waiting.expired is not None:
            self._waiting = None
            self._say(waiting.expired if isinstance(waiting.expired, bytes) else waiting.expired(), now)

    def _follow(self, following: Follow, now: float) -> None:
        """Report the weight once it stands, and its changes."""
        reading = self._display.reading()
        if self._stood_at is None:
            if reading.status is ReadingStatus.STABLE and reading.value is not None:
                self._stood_at = reading.value
                self._answers.append((now, following.line(reading)))
        elif reading.value is None or abs(reading.value - self._stood_at) >= following.step(self._stood_at):
            self._stood_at = None
            if following.moving and reading.status is not ReadingStatus.STABLE:
                self._answers.append((now, following.line(reading)))

    def _say(self, line: bytes, now: float) -> None:
        if line:
            faults = self._display.faults
            self._answers.append((now + self._latency + faults.delay, spoil(line, faults, self._rng)))

    def _weight(self) -> bytes:
        return weight_line(self._voice.dialect, self._display.reading())
