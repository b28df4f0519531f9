"""The ground truth of a bench: what truly happens to the liquid, which calibration sees only through the balance.

- `GroundTruth` has the hooks that a pour calls. On hardware they do nothing; virtual benches override them.
- `true_pour` and `true_spill` simulate one pour of a virtual bench's ground truth, which has hidden parameters and
  is poured with hidden pose errors. `Spill` holds the resulting masses. The simulations run in a simulator pool of
  their own, so that they never occupy a simulator of the calibration.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator, Awaitable, Callable
from dataclasses import dataclass, replace
from typing import Any, Literal, TypeVar

import numpy as np

from actors.arm.arm_interface import Executed, PlannedPour
from actors.dosing_settings import DosingSettings
from actors.interfaces import DoseTarget, InvalidActionError, LaboratoryError, ProgressCallback, SimulatorPool
from actors.laboratory_settings import BenchSettings
from actors.runtime.bench_clock import DeviceClock
from sim_engine.action import Action
from sim_engine.outcome import PourMeasurement, PourOutcome, RecordedFrames, SimulatedPour
from sim_engine.scene import PoseError, PourTask, Scene

T = TypeVar("T")

WATCHED_RATE = 10.0
"""Frame rate of the ground truth's particles for the live view [1/s]."""

FASTEST_DOSE = 1.0
"""Largest time scale of a dose, whose commands and readings follow each other in tenths of a second: at 2, delays of a
busy machine cost first doses of 2.5 g another 2 to 5 g."""

ATTEMPTS = 3
"""Number of initial particle positions to try before the simulation of the liquid fails."""

Stream = Literal["pose", "liquid", "balance", "arm"]
_STREAMS: tuple[Stream, ...] = ("pose", "liquid", "balance", "arm")


def stream(seed: int, name: Stream) -> tuple[int, ...]:
    """Return the seed of one source of randomness in one pour; the sources are independent.

    Args:
        seed: of the pour, any integer.
        name: of the source.
    """
    return (seed % 2**64, _STREAMS.index(name))


def draw_pose_error(spec: BenchSettings, seed: int) -> PoseError:
    """Draw the grip and placement errors of one pour: systematic error plus random error.

    Args:
        spec: mean errors and standard deviations.
        seed: of the pour.
    """
    noise = np.random.default_rng(stream(seed, "pose")).standard_normal(5)
    mean, deviation = spec.pose_error, spec.pose_noise
    factor = mean.speed_factor + deviation.speed_factor * noise[3]
    return PoseError(
        x=float(mean.x + deviation.x * noise[0]),
        y=float(mean.y + deviation.y * noise[1]),
        z=float(mean.z + deviation.z * noise[4]),
        tilt=float(mean.tilt + deviation.tilt * noise[2]),
        # A standard deviation sets no bound, and a speed factor near 0 or far above 1 is not a plausible execution
        # error.
        speed_factor=float(np.clip(factor, 0.5, 1.5)),
    )


def liquid_seed(seed: int) -> int:
    """Seed of the liquid of a dose."""
    return int(np.random.default_rng(stream(seed, "liquid")).integers(2**31))


class TouchingError(LaboratoryError):
    """With the hidden errors of grip and placement the vessels would touch."""


@dataclass(frozen=True)
class Spill:
    """The true masses of one pour.

    Attributes:
        times: since the start of the motion [s].
        spilled_curve: spilled mass at those times [kg].
        spilled: final spilled mass [kg].
        retained: mass left in the pourer [kg].
        frames: recorded particles, if a live view needs them.
    """

    times: tuple[float, ...]
    spilled_curve: tuple[float, ...]
    spilled: float
    retained: float
    frames: RecordedFrames | None = None


async def true_pour(spec: BenchSettings, simulators: SimulatorPool, task: PourTask, seed: int) -> SimulatedPour:
    """Simulate the ground truth in one pour; the same seed gives the same result.

    Args:
        spec: of the bench, with the ground truth.
        simulators: a separate pool for the ground truth.
        task: scene and motion of the pour; θ and seed are filled in here.
        seed: of the pour.

    Raises:
        TouchingError: with these placement errors the vessels would touch.
        LaboratoryError: the liquid could not be simulated.
    """
    reason = None
    task = replace(task, scene=replace(task.scene, mirrored=None))  # real liquid is not its own mirror image
    for liquid_seed in np.random.default_rng(stream(seed, "liquid")).integers(0, 2**31, ATTEMPTS):
        try:
            simulated = await simulators.simulate(replace(task, parameters=spec.theta, seed=int(liquid_seed)))
        except InvalidActionError as touching:
            raise TouchingError(f"the vessels as they truly stand: {touching}") from touching
        if simulated.outcome.invalid is None:
            return simulated
        reason = simulated.outcome.invalid
    raise LaboratoryError(f"the virtual bench's liquid could not be simulated: {reason}")


async def true_spill(
    spec: BenchSettings,
    simulators: SimulatorPool,
    scene: Scene,
    action: Action,
    seed: int,
    frame_rate: float = 0.0,
) -> Spill:
    """Simulate the liquid for an arm that executes the commanded action with this pour's errors; raises like
    `true_pour`.

    Args:
        spec: of the bench, with the ground truth and errors.
        simulators: a separate pool for the ground truth.
        scene: the intended scene.
        action: the commanded action.
        seed: of the pour.
        frame_rate: rate of the recorded particle frames for the live view [1/s].
    """
    task = PourTask(scene, action, spec.theta, 0, frame_rate=frame_rate, pose_error=draw_pose_error(spec, seed))
    simulated = await true_pour(spec, simulators, task, seed)
    return replace(spill_of(simulated.outcome, scene.liquid.mass), frames=simulated.frames)


def spill_of(outcome: PourOutcome, mass: float) -> Spill:
    """Return the masses of a simulated pour.

    Drops that still fall at the end are shared between receiver and tray in the proportion of the landed drops. Mass
    that escaped through a wall (at most `ESCAPED_LIMIT`) is counted in neither.

    Args:
        outcome: of the liquid's simulation.
        mass: loaded [kg].
    """
    landed = outcome.received + outcome.spilled
    falling = outcome.in_flight * (outcome.spilled / landed if landed > 0.0 else 1.0)
    spilled = mass * (outcome.spilled + falling)
    curve = tuple(mass * spilt for spilt in outcome.curve_spilled)
    times = outcome.curve_times
    end = max(outcome.simulated_time, times[-1] if times else 0.0) + 0.1
    return Spill((*times, end), (*curve, spilled), spilled, mass * outcome.retained)


@dataclass(frozen=True)
class GroundTruthTask:
    """The current pour; `seed` is the seed of all its randomness.

    Attributes:
        show: receives the liquid's frames if a live view needs them.
    """

    scene: Scene
    action: Action
    path: PlannedPour
    seed: int
    show: Callable[[RecordedFrames], None] | None = None

    @property
    def frame_rate(self) -> float:
        """Frame rate of the ground truth's particles [1/s]; 0 without a live view. The simulation is unaffected."""
        return 0.0 if self.show is None else WATCHED_RATE

    def shown(self, frames: RecordedFrames | None) -> None:
        """Pass the liquid's frames to `show`."""
        if self.show is not None and frames is not None:
            self.show(frames)


class GroundTruth:
    """Hooks around arm and balance during a pour. On hardware they do nothing.

    Args:
        time_scale: bench seconds per second of the clock.

    Attributes:
        clock: of the devices.
    """

    def __init__(self, time_scale: float) -> None:
        self._time_scale = time_scale
        self.clock = DeviceClock()

    async def prepare(self, pour: GroundTruthTask) -> None:
        """Called before the operator prepares the pour."""

    @contextlib.asynccontextmanager
    async def followed(self) -> AsyncIterator[None]:
        """Context from before the arm leaves home until it is back."""
        yield

    async def note(self) -> None:
        """Called at the end of each transfer motion of the arm."""

    async def tilts(self) -> None:
        """Called when the arm stands at the pour's first pose and is about to tilt."""

    async def lands(self, executed: Executed | None, broken: Exception | None) -> None:
        """Called after the executed motion; determines the liquid's masses.

        Args:
            executed: poses as read back from the arm, if available.
            broken: why the pour was aborted, if it was.

        Raises:
            LaboratoryError: the masses are unknown.
        """

    async def between(self, vessel: str, place: str, width: float) -> None:
        """Called when open fingers stand around a place, before they close on a vessel of this width [m]."""

    async def lifted(self, vessel: str) -> None:
        """Called when a gripped vessel leaves its place."""

    async def placed(self, vessel: str, place: str, *, on_balance: bool) -> None:
        """Called when the fingers have let go of a vessel at a place."""

    async def poured_back(self, seed: int) -> None:
        """Called when the receiver was poured back into the pourer."""

    async def emptied(self, vessel: str, seed: int) -> None:
        """Called when a vessel was emptied at the waste place."""

    async def simulated_dose(
        self, scene: Scene, dose: DoseTarget, seed: int, dosing: DosingSettings, progress: ProgressCallback | None
    ) -> PourMeasurement | None:
        """The whole dose, if arm and balance need not act it out; None: they do."""
        return None

    async def prepare_dose(self, scene: Scene, dose: DoseTarget, seed: int, carried: tuple[str, str] | None) -> None:
        """Called before the operator prepares a dose.

        Args:
            scene: pourer, receiver and liquid.
            dose: wanted amount.
            seed: of the dose.
            carried: names of source and cup that the arm carries; None without places.

        Raises:
            InvalidActionError: a virtual bench has no such cup.
        """

    @contextlib.asynccontextmanager
    async def slowed(self) -> AsyncIterator[None]:
        """Context in which the clock of a virtual bench runs at most `FASTEST_DOSE` times as fast as a real one."""
        yield

    async def untouched(self) -> bool:
        """Whether it is certain that nothing has left the pourer; only an emulated arm can tell."""
        return False

    async def flows(self, show: Callable[[RecordedFrames], None] | None = None) -> None:
        """Called when the arm is about to tilt for a dose: from now on the liquid follows its motion.

        Args:
            show: receives the particles meanwhile, if a live view needs them.
        """

    async def flowed(self) -> dict[str, Any]:
        """Called after a dose, also after an aborted one. Returns the true masses of a virtual bench."""
        return {}

    async def lasting(self, doing: Awaitable[T], seconds: float) -> T:
        """Await an operation of the arm that takes `seconds` of bench time."""
        return await doing

    async def wait(self, seconds: float) -> None:
        """Let bench time pass [s]."""
        end = self.clock.now + seconds / self._time_scale
        while (left := end - self.clock.now) > 0.0:
            await asyncio.sleep(left)

    async def settle(self, seconds: float) -> None:
        """Wait at least `seconds` of bench time, so that the last drops fall."""
        await self.wait(seconds)

    async def end(self) -> None:
        """Called when the pour is over, in every case."""

    async def close(self) -> None:
        """Called when the bench is closed."""
