"""Measurements of a vessel of revolution, and their predictions from its profile.

`Radii`, `FillTable` and `TiltTable` implement `sim_engine.vessel_acquisition.outline_fit.Evidence`.
"""

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
    """Inner radii at heights, from callipers.

    Attributes:
        heights: above the inner floor, shape (n,) [m].
        observed: radii at these heights, shape (n,) [m].
        deviations: standard deviations of the radii, shape (n,) [m].
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
    """Volumes below levels, measured with a ruler and a balance.

    Attributes:
        levels: above the inner floor, shape (n,) [m].
        observed: volumes, shape (n,) [m³].
        ruler: standard deviation of a level [m].
        volume_error: standard deviation of a volume [m³].
        radius: approximate radius of the vessel, which converts an error of level into one of volume [m].
    """

    levels: Floats
    observed: Floats
    ruler: float
    volume_error: float
    radius: float
    name: str = "fill table"

    @property
    def deviations(self) -> Floats:
        """See `Evidence.deviations`."""
        return np.full(len(self.levels), np.hypot(self.volume_error, np.pi * self.radius**2 * self.ruler))

    def predict(self, heights: Floats, radii: Floats) -> Floats:
        """See `Evidence.predict`."""
        return volume_below(heights, radii, self.levels)


@dataclass(frozen=True, eq=False)
class TiltTable:
    """Volumes left in a vessel that was brimful, tilted slowly and held.

    Attributes:
        tilts: from upright, in (0, π/2], shape (n,) [rad].
        observed: volumes left, shape (n,) [m³].
        angle: standard deviation of a tilt [rad].
        volume_error: standard deviation of a volume [m³].
    """

    tilts: Floats
    observed: Floats
    angle: float
    volume_error: float
    name: str = "tilt table"

    @property
    def deviations(self) -> Floats:
        """See `Evidence.deviations`; the effect of an error of angle is computed from the table itself."""
        if len(self.tilts) < 2:
            return np.full(len(self.tilts), self.volume_error)
        slope = np.gradient(self.observed, self.tilts)
        return np.hypot(self.volume_error, slope * self.angle)

    def predict(self, heights: Floats, radii: Floats) -> Floats:
        """See `Evidence.predict`."""
        return np.array([held_when_tilted(heights, radii, float(tilt)) for tilt in self.tilts])


def held_when_tilted(heights: Floats, radii: Floats, tilt: float) -> float:
    """Volume that a vessel of revolution retains at a tilt by hydrostatics [m³].

    In a slice of radius r the liquid is the part of the disc beyond a chord. The free surface is at the height of the
    lowest barrier on the way out, which is the lip, or a neck below it.

    Args:
        heights: ascending from 0, shape (k,) [m].
        radii: at these heights, shape (k,) [m].
        tilt: in (0, π/2] [rad].
    """
    z = heights[-1] * (np.arange(SLICES) + 0.5) / SLICES
    r = np.interp(z, heights, radii)
    cos, sin = np.cos(tilt), np.sin(tilt)
    # heights of the wall's lowest line, from the floor to the lip; the barrier is the maximum of the following heights
    line = heights * cos - radii * sin
    lowest = int(np.argmin(line))
    barrier = lowest + int(np.argmax(line[lowest:]))
    level, beyond = line[barrier], heights[barrier]
    chord = np.clip((z * cos - level) / (sin * np.maximum(r, 1e-9)), -1.0, 1.0)
    area = r**2 * (np.arccos(chord) - chord * np.sqrt(1.0 - chord**2))
    area = np.where(z <= beyond, area, 0.0)
    return float(area.sum() * heights[-1] / SLICES)
