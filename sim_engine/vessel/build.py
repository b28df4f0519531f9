"""From a vessel's spec to a vessel: `build_vessel`."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sim_engine.vessel import profile as profiles
from sim_engine.vessel.sdf import MARGIN, SignedDistanceGrid, choose_spacing
from sim_engine.vessel.spec import ProfileShape, VesselSpec
from sim_engine.vessel.vessel import Vessel

Floats = NDArray[np.float64]

DIRECTIONS = 72
"""Half planes in which a vessel's meridians are kept."""


def build_vessel(spec: VesselSpec, *, use_cache: bool = True) -> Vessel:
    """Build a vessel from its shape.

    Args:
        spec: the vessel's name and shape.
        use_cache: keep a mesh's distance grid in the cache directory, and take it from there when the mesh is known.
            Profiles are quick and are always computed.

    Returns:
        The vessel in its own frame (z up, underside at z = 0, opening centred on the axis).

    Raises:
        VesselError: the shape is not a vessel; the message says why and what would be right.
        OSError: a file of it can't be read.
    """
    outline = spec.shape.outline()
    if outline is not None:
        return _build_profile(spec, outline)
    vessel = spec.shape.build(spec, use_cache=use_cache)
    if not isinstance(vessel, Vessel):
        raise TypeError(f"'{spec.shape.kind}' should build a Vessel, not {type(vessel).__name__}")
    return vessel


def _build_profile(spec: VesselSpec, shape: ProfileShape) -> Vessel:
    inner = profiles.check_profile(shape)
    outer = profiles.outer_profile(inner, shape.wall, shape.floor)
    up = np.array([0.0, shape.floor])
    inner, outer = inner + up, outer + up
    polygon = profiles.solid_polygon(inner, outer)
    vertices, faces = profiles.revolve(polygon)
    rim = float(inner[-1, 1])
    widest = float(outer[:, 0].max())
    wall = min(shape.wall, shape.floor)
    angle = 2.0 * np.pi * np.arange(DIRECTIONS) / DIRECTIONS
    meridians = np.stack(
        [
            inner[:, 0] * np.cos(angle)[:, None],
            inner[:, 0] * np.sin(angle)[:, None],
            np.broadcast_to(inner[:, 1], (DIRECTIONS, len(inner))),
        ],
        axis=-1,
    )
    return Vessel(
        spec=spec,
        solid_vertices=vertices,
        solid_faces=faces,
        grid=_profile_grid(polygon, inner, choose_spacing(np.array([2 * widest, 2 * widest, rim]), wall)),
        inner_floor=shape.floor,
        rim_height=rim,
        opening_radius=float(inner[-1, 0]),
        outer_radius=widest,
        capacity=profiles.volume(inner),
        wall_thickness=wall,
        meridians=meridians,
    )


def _profile_grid(polygon: Floats, inner: Floats, spacing: float) -> SignedDistanceGrid:
    """Exact distances at the nodes of a grid that is symmetric about the axis.

    Nodes at the same radius share their distance, so it is computed once for every radius that occurs.
    """
    half = int(np.ceil((polygon[:, 0].max() + MARGIN) / spacing))
    steps = np.arange(-half, half + 1)
    below = int(np.ceil(MARGIN / spacing))
    layers = below + int(np.ceil((polygon[:, 1].max() + MARGIN) / spacing)) + 1
    z = np.asarray((np.arange(layers) - below) * spacing, dtype=np.float64)
    squares, place = np.unique(steps[:, None] ** 2 + steps**2, return_inverse=True)
    r = np.sqrt(squares)[:, None] * spacing
    values = profiles.distance(polygon, r, z).astype(np.float32)
    closed = np.vstack([inner, [0.0, inner[-1, 1]]])
    cavity = (profiles.contains(closed, r, np.broadcast_to(z, values.shape)) & (values > 0.0)).astype(np.uint8)
    shape = (len(steps), len(steps), layers)
    origin = np.array([-half * spacing, -half * spacing, -below * spacing])
    place = place.reshape(-1)
    return SignedDistanceGrid(origin, spacing, values[place].reshape(shape), cavity[place].reshape(shape))
