"""Initial positions: a jittered lattice that fills the pourer from the bottom."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sim_engine.errors import InvalidSceneError
from sim_engine.vessel.vessel import Vessel, in_cavity

JITTER = 0.05
"""Largest displacement from the lattice, in spacings; it makes seeds differ and breaks the crystal."""


def spacing(volume: float, particles: int) -> float:
    """d = (V/N)^(1/3) [m]."""
    return float((volume / particles) ** (1.0 / 3.0))


def fill(
    vessel: Vessel, volume: float, particles: int, seed: int, wall_distance: float = 0.5, tilt: float = 0.0
) -> NDArray[np.float32]:
    """Positions of exactly `particles` particles of volume V/N each.

    Args:
        vessel: filled from below.
        volume: of the liquid [m³].
        particles: N.
        wall_distance: lattice points keep about that many spacings from solid, as the density constraint will.
        tilt: of the vessel when it is filled, towards +x [rad].
        seed: shifts the lattice, jitters it, and chooses among the places of the topmost layer.

    Returns:
        Shape (N, 3), float32, in the vessel's frame [m].

    Raises:
        InvalidSceneError: at this number of particles the liquid does not fit under the rim.
    """
    rng = np.random.default_rng(seed)
    d = spacing(volume, particles)
    # A narrow or brimful vessel may leave the lattice too few places: then squeeze it, the solver relaxes it again.
    # Rims are lowered for particles, so the uppermost spacing is used only if nothing else helps.
    for top in (vessel.rim_height - d, vessel.rim_height):
        for squeeze in (1.0, 0.98, 0.96, 0.94, 0.92, 0.9, 0.87, 0.84):
            places = _lattice(vessel, d, d * squeeze, wall_distance, top, rng)
            if len(places) >= particles:
                order = np.lexsort((rng.random(len(places)), np.round(_height(places, tilt) / (d * squeeze))))
                chosen = places[order[:particles]]
                chosen += rng.uniform(-JITTER, JITTER, chosen.shape) * d
                return chosen.astype(np.float32)
    raise InvalidSceneError(
        f"{vessel.name}: {1e6 * volume:.4g} mL as {particles} particles do not fit under the rim (it holds "
        f"{1e6 * vessel.capacity:.4g} mL to the brim); pour less, use more particles, or a larger vessel"
    )


def _height(places: NDArray[np.float64], tilt: float) -> NDArray[np.float64]:
    """Height of places of the vessel's frame in a tilted vessel, up to a constant (N,) [m]."""
    height: NDArray[np.float64] = places[:, 2] * np.cos(tilt) - places[:, 0] * np.sin(tilt)
    return height


def _lattice(
    vessel: Vessel, d: float, step: float, wall_distance: float, top: float, rng: np.random.Generator
) -> NDArray[np.float64]:
    """Places of a cubic lattice, shifted at random, in the cavity below `top`, shape (M, 3) [m]."""
    reach = vessel.outer_radius + step
    across = np.arange(-reach, reach, step)
    shift = rng.uniform(-0.5, 0.5, 2) * step
    z = np.arange(vessel.inner_floor + wall_distance * d, top, step)
    places = np.stack(np.meshgrid(across + shift[0], across + shift[1], z, indexing="ij"), axis=-1).reshape(-1, 3)
    places = places[vessel.grid.sample(places) >= 0.9 * wall_distance * d]
    return places[in_cavity(vessel.grid, places)]
