"""The course of a simulated pour: slices of time, what is seen between them, when it is over, and what came of it."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from sim_engine.errors import SimulationCancelled
from sim_engine.fill import spacing
from sim_engine.motion import Motion
from sim_engine.outcome import ESCAPED_LIMIT, ParticleState, PourOutcome
from sim_engine.task import PourTask

if TYPE_CHECKING:
    from sim_engine.fluid.engine import FluidEngine

SLICE = 0.02
"""The solver is called for so much simulated time at once; curve and frames are taken between calls [s]."""

QUIET = 0.15
"""With nothing in flight for so long after the motion (or with an empty pourer), the pour is over [s]."""

LONGEST_TAIL = 1.0
"""The pour ends so long after the motion even if something is still in flight [s]."""


@dataclass
class Course:
    """One pour on its way.

    Attributes:
        task, motion: what is simulated.
        start: time from which it is simulated, a multiple of `SLICE`; the liquid lies level before [s].
        scene: its place in the engine.
        times, poured, spilled: what was seen: [s], fractions.
        frames: time, positions (N, 3) [m], states (N,).
        slices: how far it is, in `SLICE`.
        over: nothing can change any more.
        cpu_s: that the process spent on it; for pours side by side an even share.

    Raises:
        ValueError: it would start within a slice.
    """

    task: PourTask
    motion: Motion
    start: float
    scene: int
    times: list[float] = field(default_factory=lambda: [0.0])
    poured: list[float] = field(default_factory=lambda: [0.0])
    spilled: list[float] = field(default_factory=lambda: [0.0])
    frames: list[tuple[float, NDArray[np.float32], NDArray[np.uint8]]] = field(default_factory=list)
    slices: int = 0
    over: bool = False
    cpu_s: float = 0.0
    _next_frame: float = 0.0
    _still_since: float | None = None

    def __post_init__(self) -> None:
        self.slices = round(self.start / SLICE)
        if abs(self.start - self.clock) > 1e-9:
            raise ValueError(f"a pour is simulated from a multiple of {SLICE:g} s on, not from {self.start:.6g} s")

    @property
    def clock(self) -> float:
        """Time that was simulated to [s]."""
        return self.slices * SLICE

    def look(self, fluid: FluidEngine, counts: NDArray[np.int32]) -> None:
        """Take down what is to be seen between two slices, and decide whether the pour is over.

        Args:
            fluid: the engine.
            counts: particles in each state, shape (5,).
        """
        n = self.task.parameters.particles
        now = fluid.time(self.scene)
        if self.task.record_rate > 0.0 and self.clock >= self._next_frame:
            self.frames.append((now, *fluid.particles(self.scene)))
            while self._next_frame <= self.clock:
                self._next_frame += 1.0 / self.task.record_rate
        if now > self.times[-1]:
            self.times.append(now)
            self.poured.append(1.0 - float(counts[ParticleState.IN_POURER]) / n)
            self.spilled.append(float(counts[ParticleState.SPILLED]) / n)
        if fluid.fault(self.scene) is not None or self.clock >= self.motion.duration + LONGEST_TAIL:
            self.over = True
            return
        # Over when nothing is in flight and nothing can start to fly.
        if counts[ParticleState.IN_FLIGHT] > 0:
            self._still_since = None
        elif self._still_since is None:
            self._still_since = self.clock
        done = self.clock >= self.motion.duration or counts[ParticleState.IN_POURER] == 0
        self.over = done and self._still_since is not None and self.clock - self._still_since >= QUIET


def follow(fluid: FluidEngine, courses: Sequence[Course], cancelled: Callable[[], bool] | None) -> None:
    """Advance neighbouring scenes slice by slice until all are over.

    Raises:
        SimulationCancelled: `cancelled` said so.
    """
    first, end = courses[0].scene, courses[-1].scene + 1
    until = np.zeros(end)
    for course in courses:
        until[course.scene] = course.start
    begun = time.process_time()
    while True:
        fluid.advance_many(until, first, end)
        counts = fluid.census_all() if end - first > 1 else fluid.census(first)[None]
        for course in courses:
            if not course.over:
                course.look(fluid, counts[course.scene - first])
        now = time.process_time()
        running = [course for course in courses if not course.over]
        for course in running or courses[-1:]:
            course.cpu_s += (now - begun) / max(len(running), 1)
        begun = now
        if not running:
            return
        if cancelled is not None and cancelled():
            raise SimulationCancelled
        for course in running:
            course.slices += 1
            until[course.scene] = course.clock


def outcome(fluid: FluidEngine, course: Course, loading: float) -> PourOutcome:
    """Count where everybody ended.

    Args:
        fluid: the engine.
        course: of a pour that is over.
        loading: CPU seconds that setting it up took.
    """
    n, scene = course.task.parameters.particles, course.scene
    counts = fluid.census(scene)
    received, spilled, retained, in_flight, escaped = (
        float(counts[state]) / n
        for state in (
            ParticleState.RECEIVED,
            ParticleState.SPILLED,
            ParticleState.IN_POURER,
            ParticleState.IN_FLIGHT,
            ParticleState.ESCAPED,
        )
    )
    invalid = fluid.fault(scene)
    if invalid is None and escaped > ESCAPED_LIMIT:
        invalid = (
            f"{100 * escaped:.2g} % of the particles crossed vessel walls "
            f"(at most {100 * ESCAPED_LIMIT:g} % is accepted)"
        )
    return PourOutcome(
        received=received,
        spilled=spilled,
        retained=retained,
        in_flight=in_flight,
        escaped=escaped,
        particles=n,
        spacing=spacing(course.task.scene.liquid.volume, n),
        density_error=fluid.mean_compression(scene),
        simulated_time=fluid.time(scene),
        steps=fluid.steps(scene),
        cpu_s=course.cpu_s + loading,
        seed=course.task.seed,
        curve_times=tuple(course.times),
        curve_poured=tuple(course.poured),
        curve_spilled=tuple(course.spilled),
        invalid=invalid,
    )
