"""Signed distance on a regular grid, used by the solver's walls, the contact check and the quadrature."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sim_engine.vessel.shapes import VesselError

Floats = NDArray[np.float64]

MARGIN = 0.012
"""Least distance from the solid to the grid's faces [m]."""

MAXIMUM_NODES = 4_000_000
"""Cap on nodes per grid (16 MB of distances)."""

LARGEST_SPACING = 0.0015
"""Spacing of thick-walled vessels [m]."""

THINNEST_WALL = 0.8
"""Largest spacing in wall thicknesses, see `choose_spacing`."""


@dataclass(frozen=True, eq=False)
class SignedDistanceGrid:
    """Distance to a solid's surface at the nodes of a regular grid, in the vessel's frame.

    Attributes:
        origin: position of node (0, 0, 0), shape (3,) [m].
        spacing: distance between neighbouring nodes, the same along x, y, z [m].
        values: signed distance at the nodes, shape (nx, ny, nz) [m]; negative inside solid material.
        cavity: 1 at nodes inside the cavity and below the opening plane, shape (nx, ny, nz).
    """

    origin: Floats
    spacing: float
    values: NDArray[np.float32]
    cavity: NDArray[np.uint8]

    @property
    def shape(self) -> tuple[int, int, int]:
        """Nodes along x, y, z."""
        nx, ny, nz = self.values.shape
        return nx, ny, nz

    @property
    def upper(self) -> Floats:
        """Position of the last node, shape (3,) [m]."""
        return self.origin + self.spacing * (np.array(self.shape) - 1)

    @property
    def reach(self) -> float:
        """Distance of the farthest node from the frame's origin [m]."""
        return float(np.linalg.norm(np.maximum(np.abs(self.origin), np.abs(self.upper))))

    def axes(self) -> tuple[Floats, Floats, Floats]:
        """Node coordinates along x, y and z [m]."""
        x, y, z = (self.origin[i] + self.spacing * np.arange(n) for i, n in enumerate(self.shape))
        return x, y, z

    def _locate(self, points: Floats) -> tuple[NDArray[np.int64], Floats, Floats]:
        """Flat index of the cell's first node (N,), position within the cell (3, N), distance to the box (N,)."""
        limits = np.array(self.shape)[:, None] - 1
        scaled = (np.asarray(points, dtype=float).T - self.origin[:, None]) / self.spacing
        clamped = np.minimum(np.maximum(scaled, 0.0), limits)
        x, y, z = scaled - clamped
        beyond = np.sqrt(x * x + y * y + z * z) * self.spacing
        cell = np.minimum(clamped.astype(np.int64), limits - 1)
        _, ny, nz = self.shape
        return (cell[0] * ny + cell[1]) * nz + cell[2], clamped - cell, beyond

    def _corners(self, first: NDArray[np.int64]) -> Floats:
        """Values at a cell's eight corners, shape (2, 2, 2, N)."""
        _, ny, nz = self.shape
        steps = np.array([[[0, 1], [nz, nz + 1]], [[ny * nz, ny * nz + 1], [ny * nz + nz, ny * nz + nz + 1]]])
        return self.values.ravel()[steps[..., None] + first].astype(float)

    def sample(self, points: Floats) -> Floats:
        """Signed distance by trilinear interpolation.

        Args:
            points: shape (N, 3) [m].

        Returns:
            Shape (N,) [m]. Beyond the grid: the value at the nearest point of the box plus the distance to it.
        """
        first, u, beyond = self._locate(points)
        c = self._corners(first)
        c = c[0] * (1.0 - u[0]) + c[1] * u[0]
        c = c[0] * (1.0 - u[1]) + c[1] * u[1]
        result: Floats = c[0] * (1.0 - u[2]) + c[1] * u[2] + beyond
        return result

    def lower_bound(self, points: Floats) -> Floats:
        """A lower bound of the distance to the solid: like `sample`, but valid beyond the grid too.

        There, `sample` may be too large by twice the distance to the box; the solid keeps `MARGIN` from its faces.

        Args:
            points: shape (N, 3) [m].

        Returns:
            Shape (N,) [m].
        """
        _, _, beyond = self._locate(points)
        at_box = self.sample(points) - beyond
        return np.where(beyond > 0.0, np.maximum(at_box - beyond, beyond + MARGIN), at_box)

    def gradient(self, points: Floats) -> Floats:
        """Gradient of the trilinear interpolant, pointing away from the solid.

        Args:
            points: shape (N, 3) [m].

        Returns:
            Shape (N, 3); close to unit length off the medial axis, of the nearest point of the box beyond the grid.
        """
        first, u, _ = self._locate(points)
        c = self._corners(first)
        along = np.empty((len(first), 3))
        for axis in range(3):
            face = np.moveaxis(c, axis, 0)
            difference = face[1] - face[0]
            v, w = (u[i] for i in range(3) if i != axis)
            difference = difference[0] * (1.0 - v) + difference[1] * v
            along[:, axis] = (difference[0] * (1.0 - w) + difference[1] * w) / self.spacing
        return along


def choose_spacing(extent: Floats, wall: float) -> float:
    """Grid spacing for a solid: min(1.5 mm, wall/2), enlarged to at most 0.8 wall to keep to `MAXIMUM_NODES`.

    On the middle surface of a flat wall of thickness w the interpolant stays below (h − w)/2, whatever the wall's
    direction: it averages |s| − w/2 with weights whose standard deviation across the wall is at most h/2. So any h < w
    keeps a wall closed, and no step along a grid axis jumps over one.

    Args:
        extent: the solid's size along x, y, z, shape (3,) [m].
        wall: smallest wall thickness [m].

    Returns:
        Spacing [m].

    Raises:
        VesselError: the vessel is too large for its walls.
    """
    box = np.asarray(extent, dtype=float) + 2.0 * MARGIN
    spacing = min(LARGEST_SPACING, wall / 2.0)
    while np.prod(np.ceil(box / spacing) + 2.0) > MAXIMUM_NODES:
        spacing *= 1.02
    if spacing > THINNEST_WALL * wall and spacing > min(LARGEST_SPACING, wall / 2.0):
        size = " × ".join(f"{1e3 * e:.0f}" for e in extent)
        raise VesselError(
            f"walls of {1e3 * wall:.2g} mm are too thin for a vessel of {size} mm: a grid of {MAXIMUM_NODES:,} nodes "
            f"has a spacing of {1e3 * spacing:.2g} mm and the walls need {1e3 * THINNEST_WALL * wall:.2g} mm; "
            f"thicken the walls to {1e3 * spacing / THINNEST_WALL:.2g} mm or use a smaller vessel"
        )
    return spacing
