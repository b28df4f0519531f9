"""How far a bench may differ from what it is believed to be, by the units of what is searched."""

from __future__ import annotations

import math

from actors.optimizer.core.mismatch import Play
from sim_engine.action import ACTION_DIMENSIONS, DEG
from sim_engine.space import Axis, Space

LENGTH = 0.010
"""Deviation of where something stands [m]: a receiver is placed by hand."""

ANGLE = 2.0 * DEG
"""Deviation of a tilt [rad]."""

CLOCK = 0.05
"""Relative deviation of a speed, an acceleration or a time."""

UNKNOWN = 0.1
"""Deviation of what has no unit of these, as a share of the searched range."""


def play_of(actions: Space) -> tuple[Play, ...]:
    """Of each searched dimension."""
    return tuple(_play(axis) for axis in actions.axes)


def _play(axis: Axis) -> Play:
    dimension = ACTION_DIMENSIONS.get(axis.name)
    unit = "" if dimension is None else dimension.unit
    if axis.scale == "log":  # a factor is a shift there
        return Play(shift=CLOCK / math.log(axis.upper / axis.lower) if unit not in ("m", "rad", "") else UNKNOWN)
    width = axis.upper - axis.lower
    match unit:
        case "m":
            return Play(shift=LENGTH / width)
        case "rad":
            return Play(shift=ANGLE / width)
        case "":
            return Play(shift=UNKNOWN)
        case _:
            return Play(factor=CLOCK, origin=axis.lower / width)
