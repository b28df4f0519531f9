"""`tension`: cohesion's forces against the energy that they are the gradient of, summed over all pairs, without
columns.
"""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from benchmarks.validation.container_runs import DENSITY, FAR_AWAY, NO_RIM, NOTHING, still_pose
from sim_engine.fluid.engine import engine
from sim_engine.fluid.kernels import BULK_BOND, HALF_ATTRACTION
from sim_engine.fluid.scene_setup import RANGE, SceneSetup, SolidWalls, cohesion_acceleration
from sim_engine.fluid.tension import ALONE, BLUNT, BONDED, CALM
from sim_engine.fluid.walls import FAR
from sim_engine.liquids import SimulationParameters

Floats = NDArray[np.float64]

D = 3e-3
TENSION = 0.07
DT = 1e-6


def blob(seed: int) -> Floats:
    """Liquid of an odd shape, with a few particles astray: more of them than a column holds [m]."""
    rng = np.random.default_rng(seed)
    axis = np.arange(-6, 7) * D
    points = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
    reach = rng.uniform(2.0, 5.5, 3) * D
    inside = points[np.sum((points / reach) ** 2, axis=1) < 1.0]
    astray = rng.uniform(-9.0, 9.0, (5, 3)) * D
    return np.concatenate([inside, astray]) + rng.uniform(-0.3, 0.3, (len(inside) + 5, 3)) * D


def energy(points: Floats) -> float:
    """Σ of the particles' energies over all pairs; lengths in units of the range, energies in those of a particle."""
    q = points / (RANGE * D)
    r = q[:, None] - q[None]
    size = np.linalg.norm(r, axis=2)
    u = np.where(size > 0.0, np.maximum(1.0 - size, 0.0), 0.0)
    bond = u**4 * (16.0 - u * (38.4 - u * (32.0 - u * (64.0 / 7.0))))
    pull = np.where(u > 0.0, 64.0 * (u * (1.0 - u)) ** 3, 0.0) / np.where(size > 0.0, size, 1.0)
    lean = np.linalg.norm(np.sum(pull[:, :, None] * r, axis=1), axis=1) / (HALF_ATTRACTION * RANGE**3)
    lacking = np.maximum(BONDED - bond.sum(axis=1) / (BULK_BOND * RANGE**3), 0.0)
    return float(np.sum(np.sqrt(np.maximum(lean - CALM, 0.0) ** 2 + (ALONE * lacking) ** 2 + BLUNT**2)))


def slope(points: Floats, particle: int) -> Floats:
    """−∂(energy)/∂(place in units of the range) of one particle, (3,)."""
    step = 1e-6 * RANGE * D
    found = np.empty(3)
    for axis in range(3):
        ahead, behind = points.copy(), points.copy()
        ahead[particle, axis] += step
        behind[particle, axis] -= step
        found[axis] = -(energy(ahead) - energy(behind)) / (2.0 * step / (RANGE * D))
    return found


def scene(points: Floats) -> SceneSetup:
    nothing = SolidWalls(NOTHING, NOTHING.values, NOTHING.cavity, 1e-3, NO_RIM)
    return SceneSetup(
        positions=points.astype(np.float32),
        spacing=D,
        density=DENSITY,
        parameters=SimulationParameters(cohesion=TENSION),
        pourer=nothing,
        receiver=nothing,
        receiver_at=FAR_AWAY,
        spill_level=-1.0,
        poses=still_pose(1.0),
        settling=0.0,
    )


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_forces_are_the_gradient_of_the_energy_in_every_scene_of_a_load(seed: int) -> None:
    """Whatever a pour that diverged has left behind in this process."""
    blobs = [blob(seed), blob(seed + 10), blob(seed + 20)]
    fluid = engine()
    fluid.load([scene(points) for points in blobs])
    f = fluid.state
    f.phi.fill(FAR)
    for left_behind in (f.seat, f.lean, f.pulled, f.bonds, f.missing):
        left_behind.fill(np.nan)
    for s in range(len(blobs)):
        f.pull_waited[s] = DT
    fluid.stepper.cohere(0, len(blobs))
    unit = cohesion_acceleration(TENSION, DENSITY, D) * DT
    for s, points in enumerate(blobs):
        forces = fluid.velocities(s).astype(float) / unit
        largest = float(np.abs(forces).max())
        assert np.abs(forces.sum(axis=0)).max() < 1e-4 * largest * len(points)
        stray = len(points) - 1
        for particle in (0, len(points) // 2, len(points) - 8, stray):
            assert forces[particle] == pytest.approx(slope(points, particle), abs=2e-3 * largest)
