"""Sloshing: the frequency of the first lateral mode in a straight cup, and its decay.

The cup stands until the liquid is at rest, is pushed aside by `PUSH` within about half a period, and stands again. The
velocities are projected on the flow of the first mode, u = ∇(J₁(k r) cos θ cosh(k z)), which is orthogonal to the flows
of all others. A damped oscillation is fitted to the projection.

Theory (linear, without viscosity): ω² = g k tanh(k H) with k = 1.8412 / R, the first zero of J₁'. The decay is the
solver's own: water's would take many seconds.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import curve_fit
from scipy.special import jv, jvp

from sim_engine.hydrostatics import GRAVITY
from sim_engine.liquids import SimulationParameters
from sim_engine.simulator import spacing
from sim_engine.vessel.vessel import build_vessel

from .case_result import Figure, Measurement, Series, reported, within
from .container_runs import Container, filled, run, still_pose
from .hydrostatic_cases import CUP, HEIGHT, RADIUS, VOLUME

Floats = NDArray[np.float64]

WAVE_NUMBER = 1.8412 / RADIUS
FREQUENCY = math.sqrt(GRAVITY * WAVE_NUMBER * math.tanh(WAVE_NUMBER * HEIGHT)) / (2.0 * math.pi)
"""3.30 Hz."""

REST, PUSH_TIME, PUSH = 1.0, 0.15, 0.006
"""Start of the push [s], its duration [s] and its distance [m]."""
WATCHED = 1.6
"""Observed time after the push [s]."""


def _damped(t: Floats, offset: float, amplitude: float, decay: float, frequency: float, phase: float) -> Floats:
    return np.asarray(offset + amplitude * np.exp(-decay * t) * np.cos(2.0 * math.pi * frequency * t + phase))


def fit_oscillation(t: Floats, y: Floats, guess: float) -> tuple[float, float]:
    """Frequency [Hz] and decay rate [1/s] of a damped oscillation.

    Args:
        t: times from 0 on, shape (T,) [s].
        y: values, shape (T,).
        guess: initial frequency [Hz].

    Returns:
        NaNs if there is no such fit.
    """
    best: tuple[float, float, float] | None = None
    scale = float(np.std(y)) or 1.0
    for phase in (0.0, 0.5 * math.pi, math.pi, 1.5 * math.pi):
        for factor in (0.8, 1.0, 1.2):
            start = (0.0, 2.0, 1.0, guess * factor, phase)
            try:
                coefficients, _ = curve_fit(_damped, t, (y - y.mean()) / scale, p0=start, maxfev=4000)
            except RuntimeError:
                continue
            error = float(np.sum((_damped(t, *coefficients) - (y - y.mean()) / scale) ** 2))
            if best is None or error < best[0]:
                best = error, abs(float(coefficients[3])), float(coefficients[2])
    return (math.nan, math.nan) if best is None else best[1:]


def first_mode(x: Floats, y: Floats, z: Floats) -> Floats:
    """Flow of the first lateral mode along x, up to a factor.

    Args:
        x, y, z: from the cup's axis and inner floor, shape (N,) each [m].

    Returns:
        Shape (N, 3).
    """
    k = WAVE_NUMBER
    r = np.maximum(np.hypot(x, y), 1e-9)
    cos, sin = x / r, y / r
    along = k * jvp(1, k * r) * cos * np.cosh(k * z)
    around = -jv(1, k * r) / r * sin * np.cosh(k * z)
    up = k * jv(1, k * r) * cos * np.sinh(k * z)
    flow: Floats = np.column_stack([along * cos - around * sin, along * sin + around * cos, up])
    return flow


def sloshing(
    particles: int, parameters: SimulationParameters, mirrored: bool = False
) -> tuple[list[Measurement], list[Series]]:
    """Push the cup and measure the liquid's oscillation.

    Args:
        particles: N.
        parameters: θ; its number of particles is replaced.
        mirrored: whether only the half y ≥ 0 is simulated.
    """
    from sim_engine.fluid.scene_setup import POSE_STEP

    vessel = build_vessel(CUP)
    start = filled(vessel, VOLUME, particles, 1, parameters, mirrored)
    end = REST + PUSH_TIME + WATCHED
    poses = still_pose(end)
    phase = np.clip((np.arange(len(poses)) * POSE_STEP - REST) / PUSH_TIME, 0.0, 1.0)
    poses[:, 0] = PUSH * 0.5 * (1.0 - np.cos(math.pi * phase))
    times = np.arange(REST + PUSH_TIME, end, 0.01)
    speeds = np.empty(len(times))
    d, cup = spacing(VOLUME, particles), Container.of(vessel)
    for k, liquid in run(start, d, cup, parameters, times, poses=poses, mirrored=mirrored):
        place, speed = liquid.positions, liquid.velocities
        flow = first_mode(place[:, 0] - PUSH, place[:, 1], place[:, 2] - vessel.inner_floor)
        speeds[k] = np.sum(speed * flow) / math.sqrt(particles * float(np.sum(flow**2)))
    frequency, decay = fit_oscillation(times - times[0], speeds, FREQUENCY)
    measurements = [
        within(
            "frequency of the first mode",
            frequency,
            FREQUENCY,
            0.05 * FREQUENCY,
            unit="Hz",
            criterion="within 5 %",
            particles=particles,
        ),
        reported("decay rate", decay, unit="1/s", particles=particles),
        # Lamb: a wave in a viscous liquid decays with 2 ν k²
        reported("viscosity that would damp so", decay / (2.0 * WAVE_NUMBER**2), unit="m²/s", particles=particles),
    ]
    curve = Series(f"{particles:,} particles", tuple((times - times[0]).tolist()), tuple((1e3 * speeds).tolist()))
    return measurements, [curve]


def sloshing_figure(curves: list[Series]) -> Figure:
    """Curves of all resolutions and of the undamped oscillation of theory."""
    t = np.linspace(0.0, WATCHED, 300)
    size = max(abs(v) for v in curves[0].y)
    sign = math.copysign(1.0, curves[0].y[int(np.argmax(np.abs(curves[0].y)))])
    peak = curves[0].x[int(np.argmax(np.abs(curves[0].y)))]
    theory = sign * size * np.cos(2.0 * math.pi * FREQUENCY * (t - peak))
    reference = Series("theory, undamped", tuple(t.tolist()), tuple(theory.tolist()), "reference")
    return Figure(
        ("Sloshing after a push",),
        ("time after the push [s]",),
        ("speed of the first mode, rms [mm/s]",),
        (*curves, reference),
    )
