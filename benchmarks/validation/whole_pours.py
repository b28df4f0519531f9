"""Whole pours: the standard pour's outflow against its limit, delivered fraction, seeds, and the free jet.

The standard pour: 200 mL in a straight cup (R 40 mm, H 100 mm) turned at 30 °/s, from a step, to 120° about the inner
lip. The reference fractions in the pourer are those of infinitely fine particles. SPlisHSPlasH (DFSPH, volume maps,
2,000 to 10,000) and Decant with two different corrections of the lip (1,000 to 20,000), each extrapolated linearly in
the spacing, agree within 0.003. At 2,000 particles SPlisHSPlasH still has 0.035 to 0.05 less.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sim_engine.action import DEG, Action
from sim_engine.hydrostatics import GRAVITY
from sim_engine.liquids import Liquid, SimulationParameters
from sim_engine.outcome import SimulatedPour
from sim_engine.scene import PourTask, Scene
from sim_engine.simulator import PourSimulator
from sim_engine.vessel.shapes import cylinder

from .case_result import Figure, Measurement, Series, at_least, at_most, reported, within

TIMES = (2.3, 2.7, 3.1)
LEFT = (0.945, 0.675, 0.31)
"""Fraction left in the standard pour, at `TIMES` [s]."""
TOLERANCE = 0.01

SCENE = Scene(
    "standard pour",
    cylinder("cup", inner_radius=0.04, inner_height=0.10),
    cylinder("glass", inner_radius=0.045, inner_height=0.09),
    Liquid(mass=0.1996, density=998.0),
)

ACTION = Action(
    angular_velocity=30 * DEG,
    angular_acceleration=None,
    max_angle=120 * DEG,
    hold_time=0.5,
    return_velocity=None,
    x_offset=0.08,
    height=0.11,
)

FALL = 0.35
"""Height of the lip above the receiver's rim for the free jet [m]."""


def simulated(simulator: PourSimulator, task: PourTask, mirrored: bool) -> SimulatedPour:
    """Simulate a pour, whole or by half.

    Raises:
        ValueError: it is to be mirrored, but it is not symmetric, or has too few particles.
    """
    run = simulator.simulate(replace(task, scene=replace(task.scene, mirrored=mirrored)))
    if run.outcome.mirrored != mirrored:
        raise ValueError(f"{task.scene.name}, {task.parameters.particles} particles: it can't be simulated by half")
    return run


def pour(
    simulator: PourSimulator, particles: int, parameters: SimulationParameters, seed: int = 1, mirrored: bool = False
) -> SimulatedPour:
    """The standard pour."""
    theta = parameters.model_copy(update={"particles": particles})
    return simulated(simulator, PourTask(SCENE, ACTION, theta, seed), mirrored)


def left_at(run: SimulatedPour, times: tuple[float, ...]) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    """Fraction still in the pourer at some times [s]."""
    return np.asarray(1.0 - np.interp(times, run.outcome.curve_times, run.outcome.curve_poured), dtype=float)


def outflow(
    simulator: PourSimulator, particles: int, parameters: SimulationParameters, seeds: int, mirrored: bool = False
) -> tuple[list[Measurement], list[Series]]:
    """The standard pour's outflow curve.

    Args:
        simulator: of this process.
        particles: N.
        parameters: θ; its number of particles is replaced.
        seeds: number of seeds; one of 2,000 particles differs from their mean by 0.0015.
        mirrored: whether only the half y ≥ 0 is simulated.
    """
    runs = [pour(simulator, particles, parameters, seed, mirrored) for seed in range(1, seeds + 1)]
    lefts = np.mean([left_at(run, TIMES) for run in runs], axis=0)
    measurements = [
        within(
            f"left in the pourer at {time:g} s",
            float(left),
            reference,
            TOLERANCE,
            criterion=f"within {TOLERANCE:g}",
            particles=particles,
        )
        for time, left, reference in zip(TIMES, lefts, LEFT, strict=True)
    ]
    first = runs[0].outcome
    curve = Series(f"{particles:,} particles", first.curve_times, tuple(1.0 - p for p in first.curve_poured))
    return measurements, [curve]


def outflow_figure(curves: list[Series]) -> Figure:
    """Curves of all resolutions in one figure."""
    return Figure(
        ("Outflow of the standard pour",),
        ("time [s]",),
        ("left in the pourer",),
        (*curves, Series("the limit", TIMES, LEFT, "reference")),
    )


def delivered(
    simulator: PourSimulator, particles: int, parameters: SimulationParameters, seeds: int, mirrored: bool = False
) -> list[Measurement]:
    """Fraction of the standard pour that arrives, and its variation over seeds.

    Args:
        particles: N.
        parameters: θ; its number of particles is replaced.
        seeds: number of seeds.
        mirrored: whether only the half y ≥ 0 is simulated.
    """
    outcomes = [pour(simulator, particles, parameters, seed, mirrored).outcome for seed in range(1, seeds + 1)]
    arrived = np.array([o.received for o in outcomes])
    return [
        at_least(
            f"delivered, mean of {seeds} seeds",
            float(arrived.mean()),
            0.95,
            criterion="at least 0.95",
            particles=particles,
        ),
        reported(f"delivered, standard deviation of {seeds} seeds", float(arrived.std(ddof=1)), particles=particles),
        at_most(
            "escaped, largest of the seeds",
            max(o.escaped for o in outcomes),
            0.0,
            criterion="none",
            particles=particles,
        ),
    ]


def repeatability(
    simulator: PourSimulator, particles: int, parameters: SimulationParameters, mirrored: bool = False
) -> list[Measurement]:
    """The same pour twice, and with another seed.

    Args:
        particles: N.
        parameters: θ; its number of particles is replaced.
        mirrored: whether only the half y ≥ 0 is simulated.
    """
    first, again, other = (pour(simulator, particles, parameters, seed, mirrored).outcome for seed in (1, 1, 2))
    same = replace(first, cpu_s=0.0) == replace(again, cpu_s=0.0)
    differs = replace(first, cpu_s=0.0, seed=2) != replace(other, cpu_s=0.0)
    return [
        at_least("same seed gives the same bits (1: yes)", float(same), 1.0, criterion="yes", particles=particles),
        at_least("another seed gives others (1: yes)", float(differs), 1.0, criterion="yes", particles=particles),
    ]


def free_jet(
    simulator: PourSimulator, particles: int, parameters: SimulationParameters, mirrored: bool = False
) -> tuple[list[Measurement], Figure]:
    """The fall of the mass centre of parcels of the jet.

    A parcel is the liquid in free flight within a slab of height. It is followed for a tenth of a second, and a
    parabola is fitted to the height of its mass centre. Forces between its particles cannot move it.

    Args:
        particles: N.
        parameters: θ; its number of particles is replaced.
        mirrored: whether only the half y ≥ 0 is simulated.
    """
    from sim_engine.outcome import ParticleState

    rate, span = 50.0, 5  # frames are taken every 0.02 s at most
    theta = parameters.model_copy(update={"particles": particles})
    action = ACTION.with_values(height=FALL, x_offset=0.12)
    frames = simulated(simulator, PourTask(SCENE, action, theta, 1, frame_rate=rate), mirrored).frames
    assert frames is not None
    rim = 0.004 + 0.09
    z = np.stack(frames.positions)[:, :, 2].astype(float)
    flying = np.stack(frames.states) == ParticleState.IN_FLIGHT
    middles, falls, weights = [], [], []
    for k in range(len(frames.times) - span):
        parcel = flying[k] & flying[k + span] & (z[k] < rim + FALL - 0.06) & (z[k] > rim + FALL - 0.16)
        parcel &= z[k + span] > rim + 0.03
        if parcel.sum() < max(10, particles // 200):
            continue
        t = frames.times[k : k + span + 1]
        fit = np.polyfit(t - t[0], z[k : k + span + 1][:, parcel].mean(axis=1), 2)
        middles.append(float(t[span // 2]))
        falls.append(-2.0 * float(fit[0]))
        weights.append(int(parcel.sum()))
    fall = float(np.average(falls, weights=weights)) if falls else float("nan")
    measurement = within(
        f"fall of {len(falls)} parcels of the jet, mean",
        fall,
        GRAVITY,
        0.01 * GRAVITY,
        unit="m/s²",
        criterion="within 1 %",
        particles=particles,
    )
    figure = Figure(
        ("Fall of the jet's parcels",),
        ("time [s]",),
        ("acceleration [m/s²]",),
        (
            Series(f"{particles:,} particles", tuple(middles), tuple(falls)),
            Series("g", (middles[0], middles[-1]) if middles else (0.0, 1.0), (GRAVITY, GRAVITY), "reference"),
        ),
    )
    return [measurement], figure
