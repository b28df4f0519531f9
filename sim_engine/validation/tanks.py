"""Containers that are not vessels, as distance grids made by hand: a box that is open at the top, a cup with a hole."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sim_engine.validation.stage import Container
from sim_engine.vessel import profile
from sim_engine.vessel.sdf import SignedDistanceGrid

Floats = NDArray[np.float64]

MARGIN = 0.01
"""From the inside to the grid's faces; solid there, so that nothing gets out [m]."""


def box(length: float, width: float, height: float, spacing: float) -> Container:
    """A tank from x = 0 to `length`, y = ±width/2, floor at z = 0; solid all around, open at the top.

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


def block(low: Floats, high: Floats, count: int, seed: int) -> tuple[Floats, float]:
    """A jittered lattice of about `count` particles that fills a block.

    Args:
        low, high: corners of the volume that the liquid fills, shape (3,) each [m].
        count: wanted number of particles.
        seed: of the jitter.

    Returns:
        Positions (N, 3) [m], half a spacing inside the block, and the spacing d [m].
    """
    size = np.asarray(high) - np.asarray(low)
    d = float(np.cbrt(np.prod(size) / count))
    numbers = np.maximum(np.round(size / d).astype(int), 1)
    d = float(np.cbrt(np.prod(size) / np.prod(numbers)))
    axes = [low[i] + (np.arange(n) + 0.5) * size[i] / n for i, n in enumerate(numbers)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    return points + np.random.default_rng(seed).uniform(-0.05, 0.05, points.shape) * d, d
