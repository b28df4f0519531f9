"""Landing position of a jet at any number of particles: the receiver is moved aside, and all passing particles are
recorded.

The standard cup and load, turned from a step at 30 and at 90 °/s to 120°. Every particle is recorded when it passes the
height 60 mm below the lip. The reference is the finest resolution.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from sim_engine.hydrostatics import GRAVITY
from sim_engine.liquids import Liquid, SimulationParameters
from sim_engine.outcome import ParticleState
from sim_engine.scene import PoseError, PourTask, Scene
from sim_engine.simulator import PourSimulator

from .case_result import Figure, Measurement, Series, reported, within
from .convergence import CONE, POURER, ConvergencePour
from .whole_pours import simulated

Floats = NDArray[np.float64]

SPEEDS = (30.0, 90.0)
"""Speeds of the turn [deg/s]."""
FALL = 0.06
"""Height below the lip at which the jet is recorded [m]."""
ASIDE = 0.25
"""Displacement of the receiver [m]."""
DISTANCE = 90.0
"""Distance of the lip from where the receiver's axis would be [mm]."""
TOLERANCE = 1e-3
"""Tolerance of the median and of the spread [m]."""
PARTS = 4
"""Number of parts of equal volume into which the pour is divided."""


@dataclass(frozen=True)
class Landing:
    """All particles that passed the height, in order of time; arrays (M,).

    Attributes:
        times: [s].
        away: distance from the lip towards the receiver [m].
        aside: distance from the plane of symmetry [m].
        speed: away from the lip [m/s].
    """

    times: Floats
    away: Floats
    aside: Floats
    speed: Floats

    @property
    def median(self) -> float:
        """Median of the distance from the lip [m]."""
        return float(np.median(self.away))

    @property
    def spread(self) -> float:
        """Distance between the 10 % and the 90 % quantile of the distance from the lip [m]."""
        low, high = np.quantile(self.away, (0.1, 0.9))
        return float(high - low)

    def over_time(self) -> Floats:
        """Median distance in each of `PARTS` parts of the pour of equal volume, (PARTS,) [m]."""
        return np.array([np.median(section) for section in np.array_split(self.away, PARTS)])


@cache
def landing(
    simulator: PourSimulator, speed: float, parameters: SimulationParameters, seeds: int = 1, mirrored: bool = False
) -> Landing:
    """Record a jet that passes a receiver moved aside.

    Args:
        simulator: of this process.
        speed: of the turn [deg/s].
        parameters: θ.
        seeds: number of pours, with different initial positions, that are combined.
        mirrored: whether only the half y ≥ 0 is simulated.
    """
    pours = [_of_one(simulator, speed, parameters, seed, mirrored) for seed in range(1, seeds + 1)]
    times = np.concatenate([pour.times for pour in pours])
    order = np.argsort(times, kind="stable")
    away, aside, fast = (
        np.concatenate([getattr(pour, name) for pour in pours])[order] for name in ("away", "aside", "speed")
    )
    return Landing(times[order], away, aside, fast)


def _of_one(
    simulator: PourSimulator, speed: float, parameters: SimulationParameters, seed: int, mirrored: bool
) -> Landing:
    """Landing of one pour; by frame, not in the order of time."""
    pour = ConvergencePour(CONE, speed, DISTANCE)
    scene = Scene("landing", POURER, CONE, Liquid(mass=0.1996))
    task = PourTask(scene, pour.action(FALL), parameters, seed, frame_rate=50.0, pose_error=PoseError(x=ASIDE))
    frames = simulated(simulator, task, mirrored).frames
    assert frames is not None
    x = np.stack(frames.positions).astype(float)
    level = simulator.vessel(CONE).rim_height
    before, after = x[:-1], x[1:]
    has_left = np.stack(frames.states)[:-1] != ParticleState.IN_POURER
    frame, particle = np.nonzero(has_left & (before[:, :, 2] >= level) & (after[:, :, 2] < level))
    a, b, span = before[frame, particle], after[frame, particle], np.diff(frames.times)[frame]
    # Free fall between two frames, through both places: z = z_a + w t − g t²/2.
    w = (b[:, 2] - a[:, 2]) / span + 0.5 * GRAVITY * span
    t = np.clip((w + np.sqrt(w**2 + 2.0 * GRAVITY * (a[:, 2] - level))) / GRAVITY, 0.0, span)
    u = (b - a) / span[:, None]
    away = a[:, 0] + u[:, 0] * t + 1e-3 * DISTANCE
    return Landing(frames.times[frame] + t, away, a[:, 1] + u[:, 1] * t, u[:, 0])


def compared(
    simulator: PourSimulator,
    numbers: tuple[int, ...],
    finest: int,
    parameters: SimulationParameters,
    seeds: int = 1,
    mirrored: bool = False,
) -> tuple[list[Measurement], Figure]:
    """Landing at some resolutions, compared with the finest.

    Args:
        simulator: of this process.
        numbers: of particles.
        finest: number of particles of the reference.
        parameters: θ; its number of particles is replaced.
        seeds: number of pours that are combined for each.
        mirrored: whether only the half y ≥ 0 is simulated, except of the finest.
    """
    measurements: list[Measurement] = []
    curves: list[Series] = []
    for panel, speed in enumerate(SPEEDS):
        landings = {
            n: landing(simulator, speed, parameters.model_copy(update={"particles": n}), seeds, mirrored and n < finest)
            for n in (*numbers, finest)
        }
        reference = landings[finest]
        for n in numbers:
            here = landings[n]
            for title, value, expected in (
                ("median", here.median, reference.median),
                ("10 … 90 % spread", here.spread, reference.spread),
            ):
                name = f"{title} of the landing at {speed:g} °/s"
                measurements.append(
                    within(name, value, expected, TOLERANCE, unit="m", criterion="within 1 mm", particles=n)
                )
            off = float(np.abs(here.over_time() - reference.over_time()).max())
            name = f"largest error of the median over {PARTS} parts of the pour at {speed:g} °/s"
            measurements.append(reported(name, off, unit="m", particles=n))
        for n, here in landings.items():
            middles = [float(np.median(section)) for section in np.array_split(here.times, 12)]
            places = [1e3 * float(np.median(section)) for section in np.array_split(here.away, 12)]
            curves.append(Series(f"{n:,} particles", tuple(middles), tuple(places), panel=panel))
    figure = Figure(
        tuple(f"Turned at {speed:g} °/s" for speed in SPEEDS),
        ("time [s]",) * len(SPEEDS),
        ("distance from the lip [mm]",) * len(SPEEDS),
        tuple(curves),
    )
    return measurements, figure
