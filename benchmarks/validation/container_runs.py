"""Runs of the solver without a pour: one vessel, at rest or on a given path, and nothing else.

`run` advances the solver, with a whole liquid or with the half y > 0 of a symmetric one; `box` and `holed_cup` make
containers that are not vessels, as analytic distance grids: a box that is open at the top, a cup with a hole.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sim_engine.hydrostatics import GRAVITY
from sim_engine.liquids import NEUTRAL, SimulationParameters
from sim_engine.simulator import fill
from sim_engine.vessel import profile
from sim_engine.vessel.distance_grid import SignedDistanceGrid
from sim_engine.vessel.vessel import Vessel
from sim_engine.vessel.wall_correction import equivalent_distance, inside_mask

Floats = NDArray[np.float64]

DENSITY = 998.0
"""Density of water [kg/m³]."""

NO_RIM = 1e3
"""Height of a rim that is never reached [m]."""

NOTHING = SignedDistanceGrid(
    origin=np.zeros(3),
    spacing=1e-3,
    values=np.ones((2, 2, 2), dtype=np.float32),
    cavity=np.zeros((2, 2, 2), dtype=np.uint8),
)
"""The solver has two vessels; in cases with fewer, this is the other one."""

FAR_AWAY = np.array([0.0, 0.0, -1e3])


@dataclass(frozen=True)
class Container:
    """A vessel as input of the solver.

    Attributes:
        grid: signed distance and cavity.
        inside: 1 at the grid's nodes where a particle counts as inside.
        wall: smallest thickness [m].
        rim: height of the lip; `NO_RIM` for a tank without pouring [m].
        open: 1 at the nodes that liquid may reach from inside, if they are more than `inside`: those of a hole.
    """

    grid: SignedDistanceGrid
    inside: NDArray[np.uint8]
    wall: float
    rim: float = NO_RIM
    open: NDArray[np.uint8] | None = None

    @classmethod
    def of(cls, vessel: Vessel) -> Container:
        """The container of a vessel."""
        return cls(vessel.grid, inside_mask(vessel.grid), vessel.wall_thickness, vessel.rim_height)

    def plane(self, support: float) -> NDArray[np.float32]:
        """Distance of the equivalent plane at the grid's nodes for a kernel's support [m]."""
        return equivalent_distance(self.grid, self.inside if self.open is None else self.open, self.rim, support)


EMPTY_SPACE = Container(NOTHING, NOTHING.cavity, 1e-3)


@dataclass(frozen=True)
class LiquidState:
    """The whole liquid at one time, also if only its half is simulated.

    Attributes:
        positions: (N, 3) in the world [m].
        velocities: (N, 3) [m/s].
        states: see `ParticleState`, (N,).
    """

    positions: Floats
    velocities: Floats
    states: NDArray[np.uint8]


def symmetric(vectors: Floats, half: NDArray[np.bool_] | None = None) -> Floats:
    """Vectors with their images by the plane y = 0.

    Args:
        vectors: (N, 3).
        half: selected ones, (N,); None: all.
    """
    selected = vectors if half is None else vectors[half]
    return np.concatenate([selected, selected * (1.0, -1.0, 1.0)])


def filled(
    vessel: Vessel, volume: float, particles: int, seed: int, parameters: SimulationParameters, mirrored: bool
) -> Floats:
    """Positions of a load, as pours begin with them (`fill`), shape (N, 3) [m].

    Args:
        vessel, volume, particles, seed: see `fill`.
        parameters: θ.
        mirrored: whether the load is symmetric about y = 0.
    """
    places = fill(vessel, volume, particles, seed, parameters.wall_distance, mirrored=mirrored).astype(float)
    return symmetric(places) if mirrored else places


def still_pose(duration: float) -> Floats:
    """Poses of a vessel that stands at the world's origin, for `run`'s pose table."""
    from sim_engine.fluid.scene_setup import POSE_STEP

    poses = np.zeros((int(duration / POSE_STEP) + 3, 7))
    poses[:, 3] = 1.0
    return poses


def run(
    positions: Floats,
    spacing: float,
    container: Container,
    parameters: SimulationParameters,
    times: Floats,
    *,
    poses: Floats | None = None,
    settling: float = 0.0,
    spill_level: float = -1e2,
    gravity: float = GRAVITY,
    longest_step: float | None = None,
    viscosity: float = 0.0,
    no_slip: bool = True,
    contact_angle: float = NEUTRAL,
    mirrored: bool = False,
) -> Iterator[tuple[int, LiquidState]]:
    """Load a scene and run it to each of the given times.

    Args:
        positions: (N, 3) in the world [m].
        spacing: d [m].
        container: the only vessel.
        parameters: θ; its number of particles is ignored.
        times: increasing [s].
        poses: the vessel's, one per `POSE_STEP` from time 0 on; None: it stands at the origin.
        settling: time before 0 in which the first pose holds [s].
        spill_level: below it and outside the vessel a particle leaves the solver [m].
        gravity: downwards [m/s²].
        longest_step: replaces the solver's own [s].
        viscosity: kinematic [m²/s]; 0: θ's rate alone.
        no_slip: whether a liquid of such a viscosity sticks to the vessel.
        contact_angle: on the vessel [rad].
        mirrored: whether only the positions y > 0 are simulated; the others are their images.

    Yields:
        The index of each time when it has been reached, and the liquid then.

    Raises:
        ArithmeticError: the solver stopped with a fault.
    """
    from sim_engine.fluid.engine import engine
    from sim_engine.fluid.scene_setup import SceneSetup, SolidWalls
    from sim_engine.fluid.state import SUPPORT

    fluid = engine()
    walls = SolidWalls(
        container.grid, container.plane(SUPPORT * spacing), container.inside, container.wall, container.rim
    )
    setup = SceneSetup(
        positions=np.ascontiguousarray(positions[positions[:, 1] > 0.0] if mirrored else positions, dtype=np.float32),
        spacing=spacing,
        density=DENSITY,
        parameters=parameters,
        pourer=walls,
        receiver=SolidWalls(NOTHING, NOTHING.values, NOTHING.cavity, 1e-3, NO_RIM),
        receiver_at=FAR_AWAY,
        spill_level=spill_level,
        poses=still_pose(float(times[-1])) if poses is None else poses,
        settling=settling,
        gravity=gravity,
        longest_step=longest_step,
        viscosity=viscosity,
        no_slip=no_slip,
        contact_angle=contact_angle,
        mirrored=mirrored,
    )
    fluid.load([setup])
    for k, time in enumerate(times):
        fluid.advance(float(time))
        if fluid.fault() is not None:
            raise ArithmeticError(f"at {fluid.time():.3f} s: {fluid.fault()}")
        x, states = fluid.particles()
        state = LiquidState(x.astype(float), fluid.velocities().astype(float), states)
        if mirrored:
            both = np.concatenate([states, states])
            state = LiquidState(symmetric(state.positions), symmetric(state.velocities), both)
        yield k, state


def stir(add: Callable[[Floats], Floats]) -> None:
    """Add to the velocities of the liquid that is loaded.

    Args:
        add: velocities (N, 3) [m/s] to add at positions (N, 3) [m].
    """
    from sim_engine.fluid.engine import engine

    f = engine().state
    n = int(f.particles[0])
    v = f.v.to_numpy()
    v[:n] += add(f.x.to_numpy()[:n].astype(float)).astype(np.float32)
    f.v.from_numpy(v)
    f.fastest[0] = float(np.linalg.norm(v[:n], axis=1).max())


MARGIN = 0.01
"""Distance from the inside to the grid's faces; solid there, so that nothing leaves [m]."""


def box(length: float, width: float, height: float, spacing: float) -> Container:
    """A tank from x = 0 to `length`, y = ±width/2, with its bottom at z = 0; solid all around, open at the top.

    Args:
        length, width: inside [m].
        height: of the grid; walls have no upper edge below it [m].
        spacing: of the grid [m].
    """
    low = np.array([-MARGIN, -width / 2.0 - MARGIN, -MARGIN])
    size = np.array([length, width, height]) + np.array([2.0, 2.0, 1.0]) * MARGIN
    x, y, z = (low[i] + spacing * np.arange(int(np.ceil(size[i] / spacing)) + 1) for i in range(3))
    outside = [
        np.maximum(-x, x - length)[:, None, None],
        (np.abs(y) - width / 2.0)[None, :, None],
        -z[None, None, :],
    ]
    shape = (len(x), len(y), len(z))
    beyond = np.sqrt(sum(np.maximum(np.broadcast_to(o, shape), 0.0) ** 2 for o in outside))
    nearest = np.max(np.stack([np.broadcast_to(o, shape) for o in outside]), axis=0)
    # in the corners of the solid the Euclidean distance, inside the box the distance to the nearest wall
    values = -np.where(nearest > 0.0, beyond, nearest)
    grid = SignedDistanceGrid(low, spacing, values.astype(np.float32), (values > 0.0).astype(np.uint8))
    return Container(grid, np.ones(shape, dtype=np.uint8), MARGIN)


def holed_cup(radius: float, height: float, hole: float, floor: float, spacing: float) -> Container:
    """A straight cup with a sharp round hole in the middle of its floor.

    Args:
        radius, height: inside [m].
        hole: its radius; 0 for none [m].
        floor: thickness; the inner floor lies at z = 0 [m].
        spacing: of the grid [m].
    """
    wall = 0.004
    outer = radius + wall
    corners = [(radius, 0.0), (radius, height), (outer, height), (outer, -floor), (hole, -floor), (hole, 0.0)]
    # without a hole the section is open along the axis, where there is no surface
    order = [corners[-1], *corners[:-1]] if hole == 0.0 else [*corners, corners[0]]
    polygon = np.array(order)
    half = int(np.ceil((outer + MARGIN) / spacing))
    across = spacing * np.arange(-half, half + 1)
    below, above = int(np.ceil((floor + MARGIN) / spacing)), int(np.ceil((height + MARGIN) / spacing))
    z = np.asarray(spacing * np.arange(-below, above + 1), dtype=np.float64)
    squares, place = np.unique(np.round((across[:, None] ** 2 + across**2) / spacing**2), return_inverse=True)
    r = np.sqrt(squares)[:, None] * spacing
    values = profile.distance(polygon, r, z).astype(np.float32)
    shape = (len(across), len(across), len(z))
    values = values[place.reshape(-1)].reshape(shape)
    inside = ((r < radius + 0.5 * wall) & (z > -0.5 * floor) & (z < height)).astype(np.uint8)
    inside = inside[place.reshape(-1)].reshape(shape)
    hollow = np.broadcast_to(r < hole + 0.5 * spacing, (len(squares), len(z))).astype(np.uint8)
    free = np.ascontiguousarray(inside | hollow[place.reshape(-1)].reshape(shape))
    origin = np.array([across[0], across[0], z[0]])
    grid = SignedDistanceGrid(origin, spacing, values, (inside & (values > 0.0)).astype(np.uint8))
    return Container(grid, np.ascontiguousarray(inside), min(wall, floor), open=free)


def block(low: Floats, high: Floats, count: int, seed: int, mirrored: bool = False) -> tuple[Floats, float]:
    """A jittered lattice of about `count` particles that fills a block.

    Args:
        low, high: corners of the volume that the liquid fills, shape (3,) each [m].
        count: desired number of particles.
        seed: of the jitter.
        mirrored: whether it is symmetric about y = 0, with the same number of layers on both sides.

    Returns:
        Positions (N, 3) [m], half a spacing inside the block, and the spacing d [m].
    """
    size = np.asarray(high) - np.asarray(low)
    d = float(np.cbrt(np.prod(size) / count))
    numbers = np.maximum(np.round(size / d).astype(int), 1)
    if mirrored:
        numbers[1] += numbers[1] % 2
    d = float(np.cbrt(np.prod(size) / np.prod(numbers)))
    axes = [low[i] + (np.arange(n) + 0.5) * size[i] / n for i, n in enumerate(numbers)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    points += np.random.default_rng(seed).uniform(-0.05, 0.05, points.shape) * d
    return symmetric(points, points[:, 1] > 0.0) if mirrored else points, d
