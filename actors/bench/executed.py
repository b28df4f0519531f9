"""Which part of what an arm did is the pour, and what a pourer did that sits askew in the fingers."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from sim_engine.sampled_motion import SampledMotion

FloatArray = NDArray[np.float64]

AT_START = 2e-3
"""How near the pour's first pose the arm stands when it begins [rad]."""

AT_REST = 1e-6
"""Joints that change by less from sample to sample stand still [rad]."""

LONGEST_REST = 6.0
"""Rest in the middle of a motion is simulated for so long [s]: what runs out meanwhile has run out by then."""


def slipped(motion: SampledMotion, grip_tilt: float) -> SampledMotion:
    """The motion of a pourer that sits in the fingers turned by so much [rad] about the y axis of its underside."""
    c, s = math.cos(0.5 * grip_tilt), math.sin(0.5 * grip_tilt)
    w, x, y, z = (motion.poses[:, k] for k in range(3, 7))
    turned = np.stack([c * w - s * y, c * x - s * z, c * y + s * w, c * z + s * x], axis=-1)
    return SampledMotion(motion.times, np.concatenate([motion.poses[:, :3], turned], axis=-1))


def executed_pour(times: FloatArray, joints: FloatArray, start: FloatArray) -> tuple[FloatArray, FloatArray] | None:
    """The part of a history that is the pour: from the first movement away from its first pose to the last movement.

    The clock plays no part in where it begins or ends, and long rests are shortened, so that the same motion is cut the
    same however long anybody took over it.

    Args:
        times: shape (T,), increasing [s].
        joints: shape (T, 6) [rad].
        start: the pour's first joints, shape (6,) [rad].

    Returns:
        Times from 0, and joints; None if nothing moved after the arm had stood there.
    """
    away = np.max(np.abs(joints - start), axis=1) >= AT_START
    moves = np.max(np.abs(np.diff(joints, axis=0)), axis=1) > AT_REST
    rests = np.flatnonzero(~away[:-1] & ~moves)
    if len(rests) == 0:
        return None
    first = int(rests[0])
    left = np.flatnonzero(away[first:])
    if len(left) == 0:
        return None
    begin = first + int(left[0])
    while begin > first and moves[begin - 1]:
        begin -= 1
    end = begin + int(np.flatnonzero(moves[begin:])[-1]) + 1
    return _without_long_rests(np.diff(times[begin : end + 1]), moves[begin:end], joints[begin : end + 1])


def _without_long_rests(
    gaps: FloatArray, moved: NDArray[np.bool_], joints: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Times from 0; of a rest only its beginning is kept."""
    kept, now, rest = [(0.0, 0)], 0.0, 0.0
    for i, (gap, moves) in enumerate(zip(gaps, moved, strict=True), start=1):
        allowed = float(gap) if moves else min(float(gap), LONGEST_REST - rest)
        rest = 0.0 if moves else rest + allowed
        if allowed > 0.0:
            now += allowed
            kept.append((now, i))
    return np.array([t for t, _ in kept]), joints[[i for _, i in kept]]
