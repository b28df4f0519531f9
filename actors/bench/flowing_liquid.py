"""Liquid that flows while the arm of a virtual bench moves, so that the balance shows it live.

`FlowingLiquid` reads the joints that the arm's emulator has executed, about fifty times a second, pours out of the cup
of `actors.dosing.virtual_dosing_bench` at that tilt, and changes the load on the balance's emulator. It is used for
doses: other pours simulate particles after the motion (`actors.bench.virtual_bench`).

Limitations: straight cups only; the receiver is hit wherever it stands.
"""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from actors.arm.arm_settings import ArmSettings, arm_kind
from actors.dosing.virtual_dosing_bench import LONGEST_DOSE, TIME_STEP, LivePour, TrueCup, TrueScale, VirtualDosingBench
from actors.interfaces import LaboratoryError
from actors.runtime.bench_clock import device_clock
from sim_engine.collision import rotations
from sim_engine.liquids import Liquid

INTERVAL = 0.02
"""Time between two readings of the arm [s]."""

LATEST = 0.08
"""Time from one reading to the next one [s of the clock], for which the clock of the bench waits."""

SILENCE = 30.0
"""Time without an answer of the arm's emulator after which nothing flows any more [s]: the emulator has ended."""


@dataclass(frozen=True)
class FlowOrder:
    """What flows.

    Attributes:
        cup: the true cup.
        liquid: in it; its mass is the true content.
        constants: number from which onset and discharge are drawn.
        seed: of the dose.
        wetness: of the lip, 0 … 1.
        base: load on the balance without the liquid [kg].
        held_tilt: by which the cup is held more tilted than the arm reports, besides what is drawn [rad].
    """

    cup: TrueCup
    liquid: Liquid
    constants: int
    seed: int
    wetness: float
    base: float
    held_tilt: float = 0.0


@dataclass(frozen=True)
class FlowEnd:
    """What flowed: masses in the receiver, next to it, and left in the cup [kg].

    Attributes:
        upright: time for which the cup has been upright at the end [s of controller time]; 0 if it is not.
        times, tilts, masses: times [s], tilts [rad] and masses in the receiver [kg], about fifty a second.
    """

    received: float
    spilled: float
    left: float
    upright: float
    times: tuple[float, ...]
    tilts: tuple[float, ...]
    masses: tuple[float, ...]


class JointHistory(Protocol):
    """Joint motion of an arm's emulator; see `actors.bench.virtual_bench.History`."""

    @property
    def times(self) -> tuple[float, ...]:
        """Controller times [s], increasing."""
        ...

    @property
    def joints(self) -> tuple[tuple[float, ...], ...]:
        """Joint angles at each time [rad]."""
        ...

    @property
    def now(self) -> float:
        """Controller time of the request [s]."""
        ...


class FlowingLiquid:
    """Liquid that follows an arm, in a thread, until `end`.

    Args:
        order: what flows.
        arm: the true geometry of the arm.
        history: returns the joint motion since a controller time [s].
        load: sets the load on the balance [kg].
    """

    def __init__(
        self,
        order: FlowOrder,
        arm: ArmSettings,
        history: Callable[[float], JointHistory],
        load: Callable[[float], None],
    ) -> None:
        self._order, self._arm, self._history, self._put = order, arm, history, load
        figure = arm_kind(arm).figure()
        if figure is None:
            raise LaboratoryError(f"an arm of the kind '{arm.kind}' has no figure: its joints give no tilt")
        self._figure = figure
        scale = TrueScale()  # the balance has an emulator of its own
        self._bench = VirtualDosingBench(
            order.cup,
            order.liquid,
            scale,
            order.constants,
            dose_seed=order.seed,
            wetness=order.wetness,
            held_tilt=order.held_tilt,
        )
        self._pour: LivePour = self._bench.pour()
        self._since = self._clock = history(1e12).now
        self._tilt = self._speed = 0.0
        self._upright_since: float | None = None
        self._signals: list[tuple[float, float, float]] = []
        self._ending = threading.Event()
        self._begun = self._clock
        self._thread = threading.Thread(target=self._run, name="liquid", daemon=True)
        self._thread.start()

    def end(self) -> FlowEnd:
        """Stop following, let the last drops fall, and return the masses."""
        self._ending.set()
        self._thread.join(10.0)
        with contextlib.suppress(LaboratoryError):
            self._follow()
        received = self._pour.at_rest()
        self._put(self._order.base + received)
        upright = 0.0 if self._upright_since is None else self._clock - self._upright_since
        columns = np.array(self._signals).reshape(-1, 3)
        return FlowEnd(
            received,
            self._pour.spilled,
            self._bench.content,
            upright,
            *(tuple(map(float, column)) for column in columns.T),
        )

    def _run(self) -> None:
        answered, clock = time.monotonic(), device_clock(self._arm.clock)
        try:
            while not self._ending.wait(INTERVAL):
                try:
                    self._follow()
                    answered = time.monotonic()
                except LaboratoryError:  # a single lost answer is made up for by the next one
                    if time.monotonic() - answered > SILENCE:
                        return
                clock.promise("liquid", LATEST)
                if self._clock - self._begun > 20.0 * LONGEST_DOSE:
                    return
        finally:
            clock.withdraw("liquid")

    def _follow(self) -> None:
        """Pour along the motion since the last call."""
        changes = self._history(self._since)
        fresh = [(t, q) for t, q in zip(changes.times, changes.joints, strict=True) if self._since < t <= changes.now]
        if not fresh:
            return
        times = np.array([t for t, _ in fresh])
        turned = rotations(self._figure.pourer(np.array([q for _, q in fresh])))
        tilts = np.arccos(np.clip(turned[:, 2, 2], -1.0, 1.0))
        load = 0.0
        for moment, tilt in zip(times, tilts, strict=True):
            load = self._advance(float(moment), float(tilt), load)
        self._since = float(times[-1])
        self._signals.append((self._clock - self._begun, self._tilt, self._pour.received))
        self._put(self._order.base + load)

    def _advance(self, moment: float, tilt: float, load: float) -> float:
        span, before = moment - self._clock, self._tilt
        steps = max(round(span / TIME_STEP), 0)
        for k in range(1, steps + 1):
            now = before + (tilt - before) * k / steps
            speed = (tilt - before) / span
            load = self._pour.step(now, speed - self._speed)
            self._speed, self._tilt = speed, now
        if steps:
            self._clock = moment
        if self._tilt > 0.02:
            self._upright_since = None
        elif self._upright_since is None:
            self._upright_since = self._clock
        return load
