"""The engine's input for one scene, in numpy: its setup, and the strength of cohesion and viscosity in it.

This module has no slow imports.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sim_engine.liquids import SimulationParameters
from sim_engine.vessel.distance_grid import SignedDistanceGrid

GRAVITY = 9.81

POSE_STEP = 1e-3
"""Interval between rows of the pose table [s]."""

RANGE = 3.0
"""Range of cohesion over spacing d."""
SURFACE = 0.66
"""Energy of a surface of one spacing squared by the sums of `tension`: scales cohesion to its tension. Measured by the
frequency of drops (`benchmarks.validation.capillarity`)."""
CAPILLARY = 0.56
"""Longest interval of cohesion, as a fraction of the capillary time; at 0.9 of it drops heat up."""
APART = 0.6
"""Particles and their own images add up to this distance to theirs, in spacings, each another one. Without it they keep
0.4 spacings from the plane of symmetry, and form layers as at a wall."""
LONGEST_WAIT = 0.01
"""Longest interval of viscosity [s]."""


@dataclass(frozen=True, eq=False)
class SolidWalls:
    """A vessel as input of the solver.

    Attributes:
        grid: signed distance.
        plane: distance of the plane equivalent to the walls, at the grid's nodes [m].
        inside: 1 at the grid's nodes where a particle counts as inside.
        thickness: of the thinnest wall [m].
        rim: height of the lip in the vessel's frame [m].
    """

    grid: SignedDistanceGrid
    plane: NDArray[np.float32]
    inside: NDArray[np.uint8]
    thickness: float
    rim: float


@dataclass(frozen=True, eq=False)
class SceneSetup:
    """One scene.

    Attributes:
        positions: (N, 3) in the world [m].
        spacing: d [m].
        density: of the liquid [kg/m³].
        parameters: θ_s.
        pourer, receiver: the vessels.
        receiver_at: position of the receiver, (3,) [m].
        spill_level: a particle below it and in no vessel is spilled [m].
        poses: (T, 7) of the pourer, `POSE_STEP` apart, from time 0 on.
        settling: time for the lattice to settle before `start`, in the pose at `start` [s].
        start: time at which the pourer begins to move [s].
        drift: initial velocity of all liquid at `start`, (3,) [m/s].
        gravity: downwards [m/s²].
        longest_step: [s]; gravity, spacing and speeds may shorten it further. None: the solver's default.
        viscosity: kinematic, of a liquid whose viscosity is simulated in SI [m²/s]; 0: θ's rate alone, walls slip.
        no_slip: whether such a liquid sticks to walls.
        tension: surface tension that replaces θ's cohesion [N/m].
        contact_angle: on both vessels [rad].
        mirrored: whether the positions are the half y ≥ 0 of a liquid that is symmetric about the plane y = 0.
        apart: largest distance that is added to that of a particle from its own image, in spacings.
    """

    positions: NDArray[np.float32]
    spacing: float
    density: float
    parameters: SimulationParameters
    pourer: SolidWalls
    receiver: SolidWalls
    receiver_at: NDArray[np.float64]
    spill_level: float
    poses: NDArray[np.float64]
    settling: float
    start: float = 0.0
    drift: tuple[float, float, float] = (0.0, 0.0, 0.0)
    gravity: float = GRAVITY
    longest_step: float | None = None
    viscosity: float = 0.0
    no_slip: bool = True
    tension: float | None = None
    contact_angle: float = 0.5 * math.pi
    mirrored: bool = False
    apart: float = APART


def pose_at(poses: NDArray[np.float64], time: float) -> NDArray[np.float64]:
    """The pose at a time, from the table of poses: position [m] and quaternion (w, x, y, z), not normalised, (7,).

    Args:
        poses: see `SceneSetup`.
        time: [s].
    """
    row = max(time, 0.0) / POSE_STEP
    k = min(int(row), len(poses) - 2)
    pose: NDArray[np.float64] = poses[k] + min(row - k, 1.0) * (poses[k + 1] - poses[k])
    return pose


def pull_interval(tension: float, density: float, spacing: float) -> float:
    """Longest interval of cohesion: `CAPILLARY` of √(ρ d³ / (2π σ)) (Brackbill et al. 1992) [s].

    Args:
        tension: σ [N/m].
        density: of the liquid [kg/m³].
        spacing: d [m].
    """
    return CAPILLARY * math.sqrt(density * spacing**3 / (2.0 * math.pi * max(tension, 1e-9)))


def cohesion_acceleration(tension: float, density: float, spacing: float) -> float:
    """Acceleration of a particle by one unit of the energies' slopes, σ d² / SURFACE / (ρ d³ · RANGE d) [m/s²].

    Args:
        tension: σ [N/m].
        density: of the liquid [kg/m³].
        spacing: d [m].
    """
    return tension / (SURFACE * RANGE * density * spacing**2)


def adhesion(contact_angle: float, wall_distance: float) -> float:
    """Attraction of particles by walls, in units of the energies' slopes; negative values repel.

    All layers that rest on a wall have together the energy −σ cos θ per area of it.

    Args:
        contact_angle: θ [rad].
        wall_distance: of the first layer at rest, in spacings.
    """
    cosine = math.cos(contact_angle)
    if abs(cosine) < 1e-9:
        return 0.0
    reach = [1.0 - (wall_distance + k) / RANGE for k in range(math.ceil(RANGE))]
    return cosine * SURFACE / sum(_wall_bond(u) for u in reach if u > 0.0)


def _wall_bond(u: float) -> float:
    """As `wall_bond`, of a number."""
    series = 1.0 / 60.0 - u * (17.0 / 420.0 - u * (11.0 / 280.0 - u * (1.0 / 56.0 - u / 315.0)))
    return 64.0 * math.pi * u**6 * series


def eddy_rate(constant: float) -> float:
    """Rate of relaxation over the rate at which a pair separates, from Smagorinsky's constant C."""
    return 5.0 * constant**2 * math.sqrt(15.0)


def relax_interval(viscosity: float) -> float:
    """Interval of viscosity, at most `LONGEST_WAIT` and a tenth of its own time [s].

    Args:
        viscosity: XSPH rate [1/s].
    """
    return min(LONGEST_WAIT, 0.1 / max(viscosity, 1e-9))
