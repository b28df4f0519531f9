"""Liquid that flows while the arm of a virtual bench moves, so that the balance shows it live.

`FlowingLiquid` reads the joints that the arm's emulator has executed, about fifty times a second, moves the pourer
along them, and changes the load on the balance's emulator. It is used for doses: other pours simulate particles after
the motion (`actors.bench.virtual_bench`). The liquid of a dose is a `PourTask`, poured as particles in another process,
or a `FormulaLiquid`: the cup of `actors.dosing.virtual_dosing_bench`.

Limitations: every dose begins with an empty receiver, which does not run over. Of a formula liquid, straight cups only;
the receiver is hit wherever it stands.
"""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from actors.arm.arm_settings import ArmSettings, arm_kind
from actors.dosing.particle_liquid import ParticleFlow
from actors.dosing.virtual_dosing_bench import LONGEST_DOSE, TIME_STEP, TrueCup, TrueScale, VirtualDosingBench
from actors.interfaces import LaboratoryError
from actors.runtime.bench_clock import device_clock
from sim_engine.action import Action
from sim_engine.collision import rotations
from sim_engine.liquids import Liquid
from sim_engine.live_pour import LivePours
from sim_engine.outcome import RecordedFrames
from sim_engine.scene import PourTask

Floats = NDArray[np.float64]

INTERVAL = 0.02
"""Time between two readings of the arm [s]."""

LATEST = 0.04
"""Time from one reading to the next one [s of the clock], for which the clock of the bench waits: the balance may see
the liquid late by as much, also on a busy host or where its simulation is slower than the clock."""

SLICE = 10
"""Samples of the arm's motion after which the promise is renewed, more than there are without a delay: however slow the
simulation, the clock of the bench waits until it has caught up."""

SILENCE = 30.0
"""Time without an answer of the arm's emulator after which nothing flows any more [s]: the emulator has ended."""

FOLLOWED = Action(angular_velocity=1.0, x_offset=0.1, height=0.1)
"""Action of a dose's `PourTask`; it has no effect, because the pourer follows the arm."""


@dataclass(frozen=True)
class FormulaLiquid:
    """The liquid in a straight cup, without particles.

    Attributes:
        cup: the true cup.
        liquid: in it; its mass is the true content.
        constants: number from which onset and discharge are drawn.
        seed: of the dose.
        wetness: of the lip, 0 … 1.
    """

    cup: TrueCup
    liquid: Liquid
    constants: int
    seed: int
    wetness: float


@dataclass(frozen=True)
class FlowOrder:
    """What flows.

    Attributes:
        liquid: a formula, or a pour of particles: scene, true content, placement of the receiver, θ and seed.
        base: load on the balance without the liquid [kg].
        held_tilt: by which the cup is held more tilted than the arm reports; a formula draws some more [rad].
        on_tray: whether the tray with what is spilled stands on the balance.
        watched: whether frames of the particles are kept for a live view.
    """

    liquid: FormulaLiquid | PourTask
    base: float
    held_tilt: float = 0.0
    on_tray: bool = False
    watched: bool = False


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


class _FormulaFlow:
    """A formula in the manner of `ParticleFlow`."""

    def __init__(self, order: FlowOrder, formula: FormulaLiquid) -> None:
        self._bench = VirtualDosingBench(
            formula.cup,
            formula.liquid,
            TrueScale(),  # the balance has an emulator of its own
            formula.constants,
            dose_seed=formula.seed,
            wetness=formula.wetness,
            held_tilt=order.held_tilt,
        )
        self._pour = self._bench.pour()
        self._time = self._tilt = self._speed = 0.0
        self.received = self.spilled = 0.0
        self.left = self._bench.content

    def follow(self, times: Floats, poses: Floats) -> float:
        """See `ParticleFlow.follow`; returns the load on the balance, with the impact of the stream [kg]."""
        load = 0.0
        for moment, tilt in zip(map(float, times), map(float, _tilts(poses)), strict=True):
            span, before = moment - self._time, self._tilt
            steps = max(round(span / TIME_STEP), 0)
            for k in range(1, steps + 1):
                speed = (tilt - before) / span
                self._tilt = before + (tilt - before) * k / steps
                load = self._pour.step(self._tilt, speed - self._speed)
                self._speed = speed
            if steps:
                self._time = moment
        self._note(self._pour.received)
        return load

    def land(self) -> None:
        """See `ParticleFlow.land`."""
        self._note(self._pour.at_rest())

    def _note(self, received: float) -> None:
        self.received, self.spilled, self.left = received, self._pour.spilled, self._bench.content


class FlowingLiquid:
    """Liquid that follows an arm, in a thread, until `end`.

    Args:
        order: what flows.
        arm: the true geometry of the arm.
        history: returns the joint motion since a controller time [s].
        load: sets the load on the balance [kg].
        pours: simulates particles.

    Raises:
        LaboratoryError: the liquid cannot be simulated.
    """

    def __init__(
        self,
        order: FlowOrder,
        arm: ArmSettings,
        history: Callable[[float], JointHistory],
        load: Callable[[float], None],
        pours: LivePours,
    ) -> None:
        self._order, self._arm, self._history, self._put = order, arm, history, load
        self._kind = arm_kind(arm)
        if self._kind.figure() is None:
            raise LaboratoryError(f"an arm of the kind '{arm.kind}' has no figure: its joints give no tilt")
        self._flow: _FormulaFlow | ParticleFlow
        if isinstance(order.liquid, FormulaLiquid):
            self._flow = _FormulaFlow(order, order.liquid)
        else:
            recent = history(history(1e12).now - 1.0).joints[-1:]
            if not recent:
                raise LaboratoryError("the emulator of the arm does not report where the arm stands")
            pose = self._poses(np.array(recent))[0]
            self._flow = ParticleFlow(order.liquid, pours, pose, watched=order.watched)
        self._bench_clock = device_clock(arm.clock)
        self._begun = self._clock = history(1e12).now  # a process may have been started before
        self._tilt = 0.0
        self._problem: LaboratoryError | None = None
        self._upright_since: float | None = None
        self._signals: list[tuple[float, float, float]] = []
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._run, name="liquid", daemon=True)
        self._bench_clock.promise("liquid", LATEST)
        self._thread.start()

    def frames(self) -> RecordedFrames | None:
        """Frames of the particles since the last call; None without new ones."""
        return self._flow.frames() if isinstance(self._flow, ParticleFlow) else None

    def end(self) -> FlowEnd:
        """Stop following, let the last drops fall, and return the masses.

        Raises:
            LaboratoryError: the liquid could not be simulated.
        """
        self._ending.set()
        self._thread.join()  # however long its step takes: what simulates particles is for one thread at a time
        with contextlib.suppress(LaboratoryError):
            self._follow()
        self._bench_clock.withdraw("liquid")
        if self._problem is not None:
            raise self._problem
        flow = self._flow
        flow.land()
        self._put(self._order.base + flow.received + self._spilled)
        upright = 0.0 if self._upright_since is None else self._clock - self._upright_since
        columns = np.array(self._signals).reshape(-1, 3)
        return FlowEnd(flow.received, flow.spilled, flow.left, upright, *(tuple(map(float, c)) for c in columns.T))

    @property
    def _spilled(self) -> float:
        """What is spilled onto the balance [kg]."""
        return self._flow.spilled if self._order.on_tray else 0.0

    def _run(self) -> None:
        answered, spent = time.monotonic(), 0.0
        try:
            while not self._ending.wait(max(INTERVAL - spent, 0.0)):
                begun = time.monotonic()
                try:
                    self._follow()
                    answered = time.monotonic()
                except LaboratoryError:  # a single lost answer is made up for by the next one
                    if time.monotonic() - answered > SILENCE:
                        return
                spent = time.monotonic() - begun
                self._bench_clock.promise("liquid", LATEST)
                if self._problem is not None or self._clock - self._begun > 20.0 * LONGEST_DOSE:
                    return
        finally:
            self._bench_clock.withdraw("liquid")

    def _follow(self) -> None:
        """Pour along the motion since the last call."""
        changes = self._history(self._clock)
        fresh = [(t, q) for t, q in zip(changes.times, changes.joints, strict=True) if self._clock < t <= changes.now]
        if not fresh or self._problem is not None:
            return
        moments = [t for t, _ in fresh]
        times = np.array(moments) - self._begun
        poses = self._poses(np.array([q for _, q in fresh]))
        for first in range(0, len(times), SLICE):
            some = slice(first, first + SLICE)
            try:
                load = self._flow.follow(times[some], poses[some])
            except LaboratoryError as problem:
                self._problem = problem
                return
            self._clock = moments[some][-1]
            self._tilt = float(_tilts(poses[some][-1:])[0])
            if self._tilt > 0.02:
                self._upright_since = None
            elif self._upright_since is None:
                self._upright_since = self._clock
            self._signals.append((self._clock - self._begun, self._tilt, self._flow.received))
            self._put(self._order.base + load + self._spilled)
            self._bench_clock.promise("liquid", LATEST - (changes.now - self._clock))

    def _poses(self, joints: Floats) -> Floats:
        """True poses of the pourer, (T, 7); a formula has its own error of the grip."""
        held = 0.0 if isinstance(self._order.liquid, FormulaLiquid) else self._order.held_tilt
        twice = np.concatenate([joints[:1], joints])  # a motion has two poses or more
        return self._kind.pourer_motion(twice, np.arange(float(len(twice))), grip_tilt=held).poses[1:]


def _tilts(poses: Floats) -> Floats:
    """Angles of the pourer from the vertical (T,) [rad]."""
    tilts: Floats = np.arccos(np.clip(rotations(poses)[:, 2, 2], -1.0, 1.0))
    return tilts
