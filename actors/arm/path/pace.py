"""When an arm is where: accelerations that joints can make, and times at which a path is written down."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from sim_engine.motion import Phase, PourMotion, Segment, turn

FloatArray = NDArray[np.float64]

STEEPEST = math.radians(1000.0)
"""Largest acceleration of a tilt [rad/s²]: what a wrist that holds a full vessel follows closely; stands for steps."""

TILT_STEP = math.radians(1.0)
"""Largest turn between two waypoints [rad]: on a circle of 100 mm the chord is then 4 μm off."""

RAMP_ERROR = math.radians(0.01)
"""Largest difference between an accelerated turn and its chords [rad]."""


def followable(motion: PourMotion, steepest: float = STEEPEST) -> PourMotion:
    """The motion as joints can make it: no steps in speed, no acceleration above `steepest`.

    A turn that asks for more keeps its speed and its ends and gets ramps of `steepest`: it lags behind by half a ramp,
    ends one ramp (speed / steepest) later, and everything after it is as much later. Other motions stay as they are.

    Args:
        motion: as `sim_engine.motion.plan_motion` makes it: every phase a turn from rest to rest, or a hold.
        steepest: [rad/s²].
    """
    if _hardest(motion.segments) <= steepest * (1.0 + 1e-9):
        return motion
    segments: list[Segment] = []
    phases: list[Phase] = []
    late = 0.0
    for phase in motion.phases:
        own = [s for s in motion.segments if phase.start - 1e-9 <= s.start < phase.end - 1e-9]
        start, end = phase.start + late, phase.end + late
        if own:
            speed = max(max(abs(s.velocity), abs(s.velocity + s.acceleration * s.duration)) for s in own)
            acceleration = min(_hardest(tuple(own)), steepest)
            turned = turn(start, own[0].tilt, own[-1].end_tilt, speed, acceleration)
            segments += turned
            end = turned[-1].start + turned[-1].duration
            late = end - phase.end
        phases.append(Phase(phase.name, start, end))
    return replace(motion, segments=tuple(segments), phases=tuple(phases))


def _hardest(segments: tuple[Segment, ...]) -> float:
    """Largest acceleration, infinite for a step in speed [rad/s²]."""
    before, ended, hardest = 0.0, -math.inf, 0.0
    for s in segments:
        if s.start > ended + 1e-9:
            if abs(before) > 1e-9:
                return math.inf
            before = 0.0
        if abs(s.velocity - before) > 1e-6:
            return math.inf
        hardest = max(hardest, abs(s.acceleration))
        before, ended = s.velocity + s.acceleration * s.duration, s.start + s.duration
    return math.inf if abs(before) > 1e-6 else hardest


def pour_times(motion: PourMotion, finer: int = 1) -> FloatArray:
    """Times of a pour's waypoints, shape (T,) [s]: all ends of segments and phases, and as many between as needed.

    Args:
        motion: a followable one.
        finer: so many times more than that.
    """
    ends = {0.0, *(p.start for p in motion.phases), *(p.end for p in motion.phases)}
    pieces = [np.array(sorted(ends))]
    for s in motion.segments:
        count = max(
            abs(s.end_tilt - s.tilt) / TILT_STEP,
            s.duration * math.sqrt(abs(s.acceleration) / (8.0 * RAMP_ERROR)),
        )
        pieces.append(s.start + np.linspace(0.0, s.duration, finer * max(math.ceil(count), 1) + 1))
    times = np.sort(np.concatenate(pieces))
    # ends that were computed in two ways differ in the last bits; the phases' own stay
    distinct = np.concatenate([[True], np.diff(times) > 1e-6])
    kept: FloatArray = times[distinct]
    for end in ends:
        kept[np.argmin(np.abs(kept - end))] = end
    return kept


def trapezoid(length: float, speed: float, acceleration: float, step: float) -> tuple[FloatArray, FloatArray]:
    """From rest to rest along a length: times and distances, about every `step` seconds and at the ramps' ends.

    Args:
        length: > 0.
        speed: at most.
        acceleration: and deceleration.
        step: [s].
    """
    peak = min(speed, math.sqrt(length * acceleration))
    ramp = peak / acceleration
    cruise = max(length / peak - ramp, 0.0)
    count = max(math.ceil(ramp / step), 1)
    rising = np.linspace(0.0, ramp, count + 1)
    steady = np.linspace(ramp, ramp + cruise, max(math.ceil(cruise / step), 1) + 1)[1:] if cruise > 1e-9 else rising[:0]
    times = np.concatenate([rising, steady, ramp + cruise + rising[1:]])
    end = times[-1]
    way = np.where(
        times <= ramp,
        0.5 * acceleration * times**2,
        np.where(times <= ramp + cruise, peak * (times - 0.5 * ramp), length - 0.5 * acceleration * (end - times) ** 2),
    )
    way[-1] = length
    return times, way
