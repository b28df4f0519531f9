"""When a simulation has to begin: of liquid that lies level in a slowly turning cup hydrostatics knows all.

A slow pour spends half of its time before anything can leave. Simulating that costs as much as the pour and decides
nothing. So the lattice is laid level into the cup as it is tilted shortly before it may spill, and moves off with it.
That is allowed only while the motion is slow: waves that it could have made must be low.

Source: ours. Limitations: waves from before the begin are left out; `CALM` bounds them.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from sim_engine.hydrostatics import GRAVITY, level
from sim_engine.motion import Motion
from sim_engine.vessel.vessel import Vessel

Floats = NDArray[np.float64]

LEAD = 0.3
"""The simulation begins so long before the level is `FREEBOARD` below the lip [s]."""

FREEBOARD = 0.12
"""In opening radii: below that, no wave that `CALM` allows reaches the lip."""

CALM = 0.06
"""Waves may be so high, in opening radii: 2.4 mm in a cup of 40 mm, about what turning it at 30 deg/s makes."""

STEP = 0.02
"""Resolution, and what the begin is a multiple of [s]."""


def wave_height(speed: float, acceleration: float, radius: float) -> float:
    """Height of the waves in a cup whose liquid is suddenly given a speed, and is then accelerated.

    The first lateral mode: a push of speed u raises u/ω with ω² = 1.84 g / R (deep liquid); an acceleration a tilts the
    surface by a/g.

    Args:
        speed: [m/s].
        acceleration: [m/s²].
        radius: R [m].

    Returns:
        At the wall [m].
    """
    return max(speed / math.sqrt(1.841 * GRAVITY / radius), radius * acceleration / GRAVITY)


def calm_until(motion: Motion, pourer: Vessel, volume: float) -> float:
    """Time up to which the liquid lies level, and far enough below the lip, in the turning pourer.

    Args:
        motion: of the pourer.
        pourer: the vessel.
        volume: of the liquid [m³].

    Returns:
        A multiple of `STEP` [s]; 0 if the pour has to be simulated from its begin.
    """
    times = np.arange(0.0, motion.duration + STEP, STEP)
    if len(times) < 4:
        return 0.0
    tilts = motion.tilt(times)
    begin = _last_below(pourer, volume, tilts) - round(LEAD / STEP)
    if begin <= 0:
        return 0.0
    speeds, accelerations = _centre(motion, pourer, times[: begin + 2])
    height = wave_height(float(speeds.max()), float(accelerations.max()), pourer.opening_radius)
    return float(begin * STEP) if height <= CALM * pourer.opening_radius else 0.0


def _last_below(pourer: Vessel, volume: float, tilts: Floats) -> int:
    """Index up to which the level stays below the lip by the freeboard: bisection over the first rise of the tilt."""
    limit = -FREEBOARD * pourer.opening_radius
    falls = np.append(np.diff(tilts) < -1e-9, True)
    low, high = 0, int(np.argmax(falls))
    if level(pourer, volume, float(tilts[0])) > limit:
        return 0
    while high - low > 1:
        middle = (low + high) // 2
        if level(pourer, volume, float(tilts[middle])) > limit:
            high = middle
        else:
            low = middle
    return low


def liquid_velocity(motion: Motion, pourer: Vessel, time: float) -> Floats:
    """Velocity of the pourer's middle, shape (3,) [m/s]."""
    places = _middles(motion, pourer, np.array([time, time + 1e-3]))
    return np.asarray((places[1] - places[0]) / 1e-3)


def _middles(motion: Motion, pourer: Vessel, times: Floats) -> Floats:
    """The point at half height on the pourer's axis over time, shape (T, 3) [m]."""
    poses = motion.sample(times)
    w, x, y, z = poses[:, 3:7].T
    axis = np.column_stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)])
    return np.asarray(poses[:, :3] + 0.5 * (pourer.inner_floor + pourer.rim_height) * axis)


def _centre(motion: Motion, pourer: Vessel, times: Floats) -> tuple[Floats, Floats]:
    """Speeds [m/s] and accelerations [m/s²] of the pourer's middle; a start from rest counts as a speed."""
    places = _middles(motion, pourer, times)
    velocities = np.diff(places, axis=0) / STEP
    accelerations = np.diff(velocities, axis=0) / STEP
    return np.linalg.norm(velocities, axis=1), np.linalg.norm(accelerations, axis=1)
