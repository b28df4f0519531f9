"""Offsets between a bench and the simulator, and the selection of simulations for a query.

- `offset_priors` returns the assumed deviation of each searched dimension, which depends on its unit.
- `displacement` converts nuisances of a bench to an offset of the action.
- `thinned` subsamples observations if there are too many for a fast answer.

The types `OffsetPrior` and `BenchOffset` belong to the optimiser's queries (`actors.optimizer.questions`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from actors.optimizer.questions import BenchOffset, Data, OffsetPrior, Point
from sim_engine.action import ACTION_DIMENSIONS, DEG
from sim_engine.liquids import SimulationParameters
from sim_engine.search_space import Axis, Space

LENGTH = 0.010
"""Standard deviation of a position [m]; receivers are placed by hand."""

ANGLE = 2.0 * DEG
"""Standard deviation of a tilt [rad]."""

CLOCK = 0.05
"""Relative standard deviation of a speed, an acceleration or a time."""

UNKNOWN = 0.1
"""Standard deviation of a dimension with any other unit, as a fraction of the searched range."""


def offset_priors(actions: Space) -> tuple[OffsetPrior, ...]:
    """Assumed deviation of each searched dimension."""
    return tuple(_offset_prior(axis) for axis in actions.axes)


def displacement(believed: SimulationParameters, bench: SimulationParameters, actions: Space) -> BenchOffset:
    """Offset at which a simulator with one set of nuisances behaves like a bench with another set.

    Nuisances of dimensions that are not searched are left to the rest of the model.

    Args:
        believed: parameters of the simulator.
        bench: possible parameters of the bench.
    """
    scales, shifts = [], []
    moved = {
        "x_offset": bench.receiver_x - believed.receiver_x,
        "y_offset": believed.receiver_y - bench.receiver_y,  # the receiver moves, which shifts the pourer the other way
        "height": believed.receiver_z - bench.receiver_z,
        "max_angle": bench.tilt_zero - believed.tilt_zero,
    }
    for axis in actions.axes:
        factor = bench.speed_factor / believed.speed_factor if axis.name == "angular_velocity" else 1.0
        if axis.scale == "log":
            middle = axis.decode(0.5)
            factor *= max(1.0 + moved.get(axis.name, 0.0) / middle, 0.1)
            scales.append(1.0)
            shifts.append(math.log(factor) / math.log(axis.upper / axis.lower))
        else:
            width = axis.upper - axis.lower
            scales.append(factor)
            shifts.append(((factor - 1.0) * axis.lower + moved.get(axis.name, 0.0)) / width)
    return BenchOffset(tuple(scales), tuple(shifts))


def _offset_prior(axis: Axis) -> OffsetPrior:
    dimension = ACTION_DIMENSIONS.get(axis.name)
    unit = "" if dimension is None else dimension.unit
    if axis.scale == "log":  # a factor is a shift on a logarithmic axis
        return OffsetPrior(shift=CLOCK / math.log(axis.upper / axis.lower) if unit not in ("m", "rad", "") else UNKNOWN)
    width = axis.upper - axis.lower
    match unit:
        case "m":
            return OffsetPrior(shift=LENGTH / width)
        case "rad":
            return OffsetPrior(shift=ANGLE / width)
        case "":
            return OffsetPrior(shift=UNKNOWN)
        case _:
            return OffsetPrior(factor=CLOCK, origin=axis.lower / width)


def thinned(data: Data, around: Sequence[Point], most: int) -> Data:
    """Select at most `most` observations: half of them nearest to `around`, the others spread over the rest.

    The selection depends on the points and never on the costs. Leaving out high costs would bias the remaining
    observations towards low costs.
    """
    if len(data) <= most:
        return data
    points = np.array(data.points)
    kept: list[int] = []
    if around:
        near = np.linalg.norm(points[:, None, :] - np.array(around)[None, :, :], axis=2).min(axis=1)
        kept = [int(i) for i in np.argsort(near, kind="stable")[: most // 2]]
    distance = np.full(len(points), np.inf)
    for i in kept:
        distance = np.minimum(distance, np.linalg.norm(points - points[i], axis=1))
    while len(kept) < most:
        distance[kept] = -1.0
        farthest = int(np.argmax(distance))
        kept.append(farthest)
        distance = np.minimum(distance, np.linalg.norm(points - points[farthest], axis=1))
    kept.sort()
    return Data(tuple(data.points[i] for i in kept), tuple(data.costs[i] for i in kept))
