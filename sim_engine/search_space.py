"""Boxes that optimisers search: named axes with bounds, mapped to and from the unit cube."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

Scale = Literal["linear", "log"]


@dataclass(frozen=True)
class Axis:
    """One searched quantity.

    Attributes:
        name: an action dimension or a simulation parameter.
        lower: smallest value, in the quantity's SI unit.
        upper: largest value, in the quantity's SI unit.
        scale: how the unit interval maps onto the values.
        integer: values are rounded to whole numbers.
    """

    name: str
    lower: float
    upper: float
    scale: Scale = "linear"
    integer: bool = False

    def __post_init__(self) -> None:
        if not (math.isfinite(self.lower) and math.isfinite(self.upper) and self.lower < self.upper):
            raise ValueError(f"{self.name}: bounds must be finite and increasing, got [{self.lower}, {self.upper}]")
        if self.scale == "log" and self.lower <= 0.0:
            raise ValueError(f"{self.name}: a log scale needs a lower bound above 0, got {self.lower}")

    def decode(self, unit: float) -> float:
        """Value at a position in the unit interval (clipped to it)."""
        u = min(max(float(unit), 0.0), 1.0)
        if self.scale == "log":
            value = math.exp(math.log(self.lower) + u * (math.log(self.upper) - math.log(self.lower)))
        else:
            value = self.lower + u * (self.upper - self.lower)
        value = min(max(value, self.lower), self.upper)
        return float(round(value)) if self.integer else value

    def encode(self, value: float) -> float:
        """Position of a value in the unit interval; values outside the bounds lie outside [0, 1]."""
        if self.scale == "log":
            return (math.log(value) - math.log(self.lower)) / (math.log(self.upper) - math.log(self.lower))
        return (value - self.lower) / (self.upper - self.lower)


@dataclass(frozen=True)
class Space:
    """An ordered set of axes: the box of actions `a` or of simulation parameters `θ_s`."""

    axes: tuple[Axis, ...]

    def __post_init__(self) -> None:
        if not self.axes:
            raise ValueError("a space needs at least one axis")
        if len(set(self.names)) != len(self.axes):
            raise ValueError(f"axes named twice in {self.names}")

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the axes, in order."""
        return tuple(axis.name for axis in self.axes)

    @property
    def dimension(self) -> int:
        """Number of axes."""
        return len(self.axes)

    def decode(self, unit: Sequence[float] | NDArray[np.float64]) -> dict[str, float]:
        """Named values of a point of the unit cube, shape (dimension,)."""
        return {axis.name: axis.decode(u) for axis, u in zip(self.axes, unit, strict=True)}

    def encode(self, values: Mapping[str, float]) -> NDArray[np.float64]:
        """Point of the unit cube for named values, shape (dimension,). Other names are ignored.

        Raises:
            KeyError: a value for one of the axes is missing.
        """
        return np.array([axis.encode(values[axis.name]) for axis in self.axes])

    def contains(self, values: Mapping[str, float], tolerance: float = 1e-9) -> bool:
        """Whether every axis' value lies within its bounds (tolerance in units of the range)."""
        unit = self.encode(values)
        return bool(np.all(unit >= -tolerance) and np.all(unit <= 1.0 + tolerance))

    def draw(self, rng: np.random.Generator) -> dict[str, float]:
        """One point drawn uniformly from the unit cube (the default prior g over actions)."""
        return self.decode(rng.random(self.dimension))
