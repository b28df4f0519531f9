"""Onset of dribbling: how much of a slow pour runs down the outside of the cup, at any number of particles.

200 mL of water in a straight cup are tilted to 80° at several speeds. The film of the simulated outflow is compared
with the critical Weber number of a sharp edge with contact angle 90°, We_c = 1 (`sim_engine.dribbling`): the liquid
that leaves while the film is slower is the reference. It comes from the outflow curve of many particles without the
model. This checks the predicted flow, and that the number of particles has no effect. It does not check the critical
Weber number, nor the relation of a flow to its film: both are those of the model.
"""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import NDArray

from sim_engine.action import DEG, Action
from sim_engine.dribbling import critical_weber
from sim_engine.lip_flow import film_of_flow, weber
from sim_engine.liquids import SimulationParameters
from sim_engine.scene import PourTask
from sim_engine.simulator import PourSimulator

from .case_result import Figure, Measurement, Series, reported, within
from .whole_pours import SCENE, simulated

Floats = NDArray[np.float64]

SPEEDS = (5.0, 10.0, 20.0, 40.0)
"""Angular velocities [deg/s]."""

TILT = 80.0
"""Largest tilt [deg]; the outer wall falls away from the lip below 90°."""

ADHESION = 1.0

FINE = 5_000
"""Number of particles of the reference."""

WINDOW = 0.12
"""Time over which the outflow is averaged [s]: at 1 mL/s it is three particles of the reference."""

TOLERANCE = 0.05


def _pour(theta: SimulationParameters, speed: float) -> PourTask:
    action = Action(
        angular_velocity=speed * DEG,
        max_angle=TILT * DEG,
        hold_time=3.0,
        x_offset=0.1,
        height=0.1,
        return_velocity=None,
    )
    return PourTask(SCENE, action, theta, 1)


@cache
def slow_share(simulator: PourSimulator, theta: SimulationParameters, speed: float) -> float:
    """Fraction of the poured liquid that leaves below the critical Weber number, by the simulated outflow.

    Args:
        theta: without adhesion.
        speed: angular velocity [deg/s].
    """
    task = _pour(theta, speed)
    motion, cup = simulator.prepare(task), simulator.vessel(SCENE.pourer)
    outcome = simulator.simulate(task).outcome
    times = np.arange(0.0, outcome.curve_times[-1], 0.5 * WINDOW)
    poured = np.interp(times, outcome.curve_times, outcome.curve_poured)
    left = np.clip(np.convolve(np.diff(poured), [0.5, 0.5], mode="same"), 0.0, None)
    left *= poured[-1] / left.sum()
    flows = SCENE.liquid.volume * left / (0.5 * WINDOW)
    numbers = np.zeros(len(flows))
    for k, tilt in enumerate(motion.tilt(times[:-1] + 0.25 * WINDOW)):
        if flows[k] > 0.0:
            velocity, film = film_of_flow(SCENE.liquid, cup, flows[k : k + 1], float(tilt))
            numbers[k] = weber(SCENE.liquid, velocity, film)[0]
    slow = numbers < critical_weber(ADHESION, SCENE.liquid.contact_angle)
    return float(left[slow].sum() / left.sum())


def onset(
    simulator: PourSimulator,
    counts: tuple[int, ...],
    parameters: SimulationParameters,
    speeds: tuple[float, ...],
    mirrored: bool = False,
) -> tuple[list[Measurement], Figure]:
    """Dribbled fraction of the poured liquid against the speed of the tilt.

    Args:
        simulator: of this process.
        counts: numbers of particles.
        parameters: θ; number of particles and adhesion are replaced.
        speeds: angular velocities [deg/s].
        mirrored: whether only the half y ≥ 0 is simulated, except of the reference.
    """
    fine = parameters.model_copy(update={"particles": FINE})
    references = [slow_share(simulator, fine, speed) for speed in speeds]
    measurements: list[Measurement] = []
    curves: list[Series] = []
    for count in counts:
        theta = parameters.model_copy(update={"particles": count, "lip_adhesion": ADHESION})
        outcomes = [simulated(simulator, _pour(theta, speed), mirrored).outcome for speed in speeds]
        shares = [outcome.dribbled / outcome.fractions.poured for outcome in outcomes]
        curves.append(Series(f"{count:,} particles", speeds, tuple(shares)))
        measurements += [
            within(
                f"dribbled over poured at {speed:g} °/s",
                share,
                reference,
                TOLERANCE,
                criterion=f"within {TOLERANCE:g}",
                particles=count,
            )
            for speed, share, reference in zip(speeds, shares, references, strict=True)
        ]
        measurements += [
            reported(f"spilled over poured at {speed:g} °/s", o.spilled / o.fractions.poured, particles=count)
            for speed, o in zip(speeds, outcomes, strict=True)
        ]
    curves.append(Series("slower than the critical Weber number", speeds, tuple(references), "reference"))
    titles = ("Onset of dribbling",), ("angular velocity [°/s]",), ("dribbled over poured",)
    return measurements, Figure(*titles, tuple(curves))
