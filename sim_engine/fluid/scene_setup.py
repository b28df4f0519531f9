"""What the engine needs to know of one scene, in numpy; light to import."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sim_engine.liquids import SimulationParameters
from sim_engine.vessel.distance_grid import SignedDistanceGrid

GRAVITY = 9.81

POSE_STEP = 1e-3
"""Rows of the pose table are so far apart [s]."""


@dataclass(frozen=True, eq=False)
class SolidWalls:
    """A vessel as the solver sees it.

    Attributes:
        grid: signed distance.
        plane: distance of the plane that is as solid as the walls, at the grid's nodes [m].
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
        receiver_at: (3,) [m].
        spill_level: below it and in no vessel a particle is spilled [m].
        poses: (T, 7) of the pourer, `POSE_STEP` apart, from time 0 on.
        settling: the lattice settles for so long before `start`, in the pose of that time [s].
        start: time at which the pourer moves off [s].
        drift: velocity that all liquid is given at `start`, (3,) [m/s].
        gravity: downwards [m/s²].
        longest_step: [s]; gravity, spacing and speeds may shorten it further. None: the solver's own.
        viscosity: kinematic, of a liquid whose viscosity is simulated in SI [m²/s]; 0: θ's rate alone, walls slip.
        no_slip: whether such a liquid sticks to walls.
        tension: surface tension in place of θ's cohesion [N/m].
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
    """The pose at a time, from the table of poses: place [m] and quaternion (w, x, y, z), not normalised, (7,).

    Args:
        poses: see `SceneSetup`.
        time: [s].
    """
    row = max(time, 0.0) / POSE_STEP
    k = min(int(row), len(poses) - 2)
    pose: NDArray[np.float64] = poses[k] + min(row - k, 1.0) * (poses[k + 1] - poses[k])
    return pose
