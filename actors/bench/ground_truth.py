"""The virtual bench's reality: a 'real' liquid with hidden parameters, poured with hidden errors.

It runs on a simulator of its own, so that it never takes one from the pool, and calibration sees of it what a balance
shows, nothing else.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from actors.interfaces import InvalidActionError, LaboratoryError, SimulatorPool
from actors.laboratory_settings import VirtualBenchSpec
from sim_engine.action import Action
from sim_engine.outcome import PourOutcome, RecordedFrames, SimulatedPour
from sim_engine.scene import PoseError, PourTask, Scene

ATTEMPTS = 3
"""Initial positions that are tried before the liquid is given up."""

Stream = Literal["pose", "liquid", "balance", "arm"]
_STREAMS: tuple[Stream, ...] = ("pose", "liquid", "balance", "arm")


def stream(seed: int, name: Stream) -> tuple[int, ...]:
    """Seed of one source of chance in one pour; the sources don't disturb each other.

    Args:
        seed: of the pour, any whole number.
        name: of the source.
    """
    return (seed % 2**64, _STREAMS.index(name))


def draw_pose_error(spec: VirtualBenchSpec, seed: int) -> PoseError:
    """Grip and placement of one pour: the systematic error and this pour's share of chance.

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
        # A standard deviation is not a bound; an arm that stands still or runs away is not an error of execution.
        speed_factor=float(np.clip(factor, 0.5, 1.5)),
    )


class TouchingError(LaboratoryError):
    """With the hidden errors of grip and placement the vessels would touch."""


@dataclass(frozen=True)
class Spill:
    """What truly became of the liquid.

    Attributes:
        times: since the motion's begin [s].
        spilled_curve: mass beside the receiver at those times [kg].
        spilled: at last [kg].
        retained: left in the pourer [kg].
        frames: particles, where somebody watches.
    """

    times: tuple[float, ...]
    spilled_curve: tuple[float, ...]
    spilled: float
    retained: float
    frames: RecordedFrames | None = None


async def hidden_pour(spec: VirtualBenchSpec, simulators: SimulatorPool, task: PourTask, seed: int) -> SimulatedPour:
    """What becomes of the 'real' liquid in one pour; same seed, same answer.

    Args:
        spec: of the bench: the hidden θ.
        simulators: a pool of its own.
        task: what is poured and how; θ and seed are filled in here.
        seed: of the pour.

    Raises:
        TouchingError: with these errors of placement the vessels would touch.
        LaboratoryError: the liquid could not be simulated.
    """
    reason = None
    for liquid_seed in np.random.default_rng(stream(seed, "liquid")).integers(0, 2**31, ATTEMPTS):
        try:
            simulated = await simulators.simulate(replace(task, parameters=spec.liquid, seed=int(liquid_seed)))
        except InvalidActionError as touching:
            raise TouchingError(f"the vessels as they truly stand: {touching}") from touching
        if simulated.outcome.invalid is None:
            return simulated
        reason = simulated.outcome.invalid
    raise LaboratoryError(f"the virtual bench's liquid could not be simulated: {reason}")


async def hidden_spill(
    spec: VirtualBenchSpec,
    simulators: SimulatorPool,
    scene: Scene,
    action: Action,
    seed: int,
    record_rate: float = 0.0,
) -> Spill:
    """What becomes of the liquid if the arm does what it is told, with this pour's errors; raises as `hidden_pour`.

    Args:
        spec: of the bench: the hidden θ and errors.
        simulators: a pool of its own.
        scene: as intended.
        action: as commanded.
        seed: of the pour.
        record_rate: of the particles that are kept for those who watch [1/s].
    """
    task = PourTask(scene, action, spec.liquid, 0, record_rate=record_rate, pose_error=draw_pose_error(spec, seed))
    simulated = await hidden_pour(spec, simulators, task, seed)
    return replace(spill_of(simulated.outcome, scene.liquid.mass), frames=simulated.frames)


def spill_of(outcome: PourOutcome, mass: float) -> Spill:
    """Masses of a simulated pour.

    Drops that still fall at the end land where the others did: they are shared between receiver and tray in the
    proportion of those. What escaped through a wall (at most `ESCAPED_LIMIT`) is missing from both.

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
