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

from sim_engine.course import SLICE
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

STEP = SLICE
"""Resolution [s]. A simulation can begin between two slices of its course only, and begins at a multiple of this."""

FALL = 2e-3
"""A tilt that has come down so far is on its way back; less is the tremor of an arm that was read back [rad]."""


def wave_height(velocities: Floats, step: float, radius: float) -> float:
    """Largest height of the waves in a cup that is moved about.

    The first lateral mode as an undamped oscillator that accelerations push, ω² = 1.84 g / R (deep liquid):
    |∫ a(t) exp(iωt) dt| / ω. A sudden start at a speed u raises u/ω, a steady acceleration a about 2 R a / (1.84 g).

    Args:
        velocities: of the cup, shape (T, 3), `step` apart; it is at rest before [m/s].
        step: [s].
        radius: R [m].

    Returns:
        At the wall [m].
    """
    frequency = math.sqrt(1.841 * GRAVITY / radius)
    pushes = np.diff(velocities[:, :2], axis=0, prepend=0.0)
    turned = pushes * np.exp(1j * frequency * step * np.arange(len(pushes)))[:, None]
    response = np.linalg.norm(np.abs(np.cumsum(turned, axis=0)), axis=1)
    return float(response.max()) / frequency


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
    velocities = np.diff(_middles(motion, pourer, times[: begin + 2]), axis=0) / STEP
    height = wave_height(velocities, STEP, pourer.opening_radius)
    return float(begin * STEP) if height <= CALM * pourer.opening_radius else 0.0


def _last_below(pourer: Vessel, volume: float, tilts: Floats) -> int:
    """Index up to which the level stays below the lip by the freeboard: bisection over the first rise of the tilt."""
    limit = -FREEBOARD * pourer.opening_radius
    falls = np.append((np.maximum.accumulate(tilts) - tilts > FALL)[1:], True)
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
