"""What people measure of a turned vessel, and what it says about its profile."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sim_engine.vessel_acquisition.outline_fit import volume_below

Floats = NDArray[np.float64]

SLICES = 240
"""Horizontal slices of a tilted vessel."""


@dataclass(frozen=True, eq=False)
class Radii:
    """Inner radii at heights: callipers, a photograph, points.

    Attributes:
        heights: above the inner floor, shape (n,) [m].
        observed: radii there, shape (n,) [m].
        deviations: of them, shape (n,) [m].
    """

    name: str
    heights: Floats
    observed: Floats
    deviations: Floats

    def predict(self, heights: Floats, radii: Floats) -> Floats:
        """See `Evidence.predict`."""
        result: Floats = np.interp(self.heights, heights, radii)
        return result


@dataclass(frozen=True, eq=False)
class FillTable:
    """Volumes below levels, as a ruler and a balance tell them.

    Attributes:
        levels: above the inner floor, shape (n,) [m].
        observed: volumes, shape (n,) [m³].
        ruler: standard deviation of a level [m].
        balance: standard deviation of a volume [m³].
        radius: about how wide the vessel is, for what a wrong level does to a volume [m].
    """

    levels: Floats
    observed: Floats
    ruler: float
    balance: float
    radius: float
    name: str = "fill table"

    @property
    def deviations(self) -> Floats:
        """See `Evidence.deviations`."""
        return np.full(len(self.levels), np.hypot(self.balance, np.pi * self.radius**2 * self.ruler))

    def predict(self, heights: Floats, radii: Floats) -> Floats:
        """See `Evidence.predict`."""
        return volume_below(heights, radii, self.levels)


@dataclass(frozen=True, eq=False)
class TiltTable:
    """What is left in a vessel that was brimful, tilted slowly and held.

    Attributes:
        tilts: from upright, in (0, π/2], shape (n,) [rad].
        observed: volumes left, shape (n,) [m³].
        angle: standard deviation of a tilt [rad].
        balance: standard deviation of a volume [m³].
    """

    tilts: Floats
    observed: Floats
    angle: float
    balance: float
    name: str = "tilt table"

    @property
    def deviations(self) -> Floats:
        """See `Evidence.deviations`; what a wrong angle does is read off the table itself."""
        if len(self.tilts) < 2:
            return np.full(len(self.tilts), self.balance)
        slope = np.gradient(self.observed, self.tilts)
        return np.hypot(self.balance, slope * self.angle)

    def predict(self, heights: Floats, radii: Floats) -> Floats:
        """See `Evidence.predict`."""
        return np.array([held_when_tilted(heights, radii, float(tilt)) for tilt in self.tilts])


def held_when_tilted(heights: Floats, radii: Floats, tilt: float) -> float:
    """Volume that a turned vessel retains at a tilt by hydrostatics [m³].

    In a slice of radius r the liquid is the disc's part beyond a chord: the free surface stands at the height of the
    lowest barrier on the way out, which is the lip, or a neck below it.

    Args:
        heights: ascending from 0, shape (k,) [m].
        radii: there, shape (k,) [m].
        tilt: in (0, π/2] [rad].
    """
    z = heights[-1] * (np.arange(SLICES) + 0.5) / SLICES
    r = np.interp(z, heights, radii)
    cos, sin = np.cos(tilt), np.sin(tilt)
    # heights of the wall's lowest line, from the floor to the lip; the barrier is the highest of what comes later
    line = heights * cos - radii * sin
    lowest = int(np.argmin(line))
    barrier = lowest + int(np.argmax(line[lowest:]))
    level, beyond = line[barrier], heights[barrier]
    chord = np.clip((z * cos - level) / (sin * np.maximum(r, 1e-9)), -1.0, 1.0)
    area = r**2 * (np.arccos(chord) - chord * np.sqrt(1.0 - chord**2))
    area = np.where(z <= beyond, area, 0.0)
    return float(area.sum() * heights[-1] / SLICES)
