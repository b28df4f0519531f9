"""The engine's input for one scene, in numpy. This module has no slow imports."""

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
