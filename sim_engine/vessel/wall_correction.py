"""Wall correction: the distance of the plane that has the same kernel integral as the vessel's walls.

The density constraint uses a wall as the kernel's integral over a half-space at the wall's signed distance. In a
concave corner there is more solid than that: particles were pressed into it until they touched both walls, and jumped
between them as the nearer one changed. At an edge there is less: a hole in a floor acted as if it was narrower. This
module integrates the kernel over everything outside the cavity and converts the result into the distance of a plane
with the same integral, which has no such jumps. Walls count as infinitely thick, whatever is behind them.

Source: after Bender et al. 2019 (volume maps); the conversion to an equivalent plane is new here.
"""

from __future__ import annotations

import hashlib

import numpy as np
from numpy.typing import NDArray

from sim_engine.resources import load_arrays, store_arrays
from sim_engine.vessel.distance_grid import SignedDistanceGrid

Floats = NDArray[np.float64]

EDITION = 1
"""Version of `equivalent_distance`; increased with any change to it, so that older cached results are not used."""

PLACES = 64
"""Number of results of `equivalent_distance` kept on disk, of about 1 MB each. The digest of a new result selects its
place, where it replaces the old one: vessels drawn for each simulation do not fill the disk."""


def half_space(q: Floats) -> Floats:
    """∫ W over the half-space beyond a plane at distance q·h (Wendland C2): 1 at q = −1, ½ at 0, 0 at 1."""
    u = np.clip(1.0 - np.abs(q), 0.0, 1.0)
    beyond = 21.0 * u**6 * (1.0 / 6.0 - u * (3.0 / 14.0 - u / 14.0))
    return np.where(q >= 0.0, beyond, 1.0 - beyond)


def _fast_length(n: int) -> int:
    """The smallest number ≥ n that has no prime factors other than 2, 3 and 5."""
    while True:
        rest = n
        for factor in (2, 3, 5):
            while rest % factor == 0:
                rest //= factor
        if rest == 1:
            return n
        n += 1


def _convolved(values: Floats, kernel: Floats) -> Floats:
    """Convolution at positions where the whole kernel lies inside the values; scipy has one, but imports slowly.

    Single precision, in which the result is stored.

    Args:
        values: (a, b, c).
        kernel: (k, k, k), symmetric.

    Returns:
        (a − k + 1, b − k + 1, c − k + 1).
    """
    values, kernel = values.astype(np.float32), kernel.astype(np.float32)
    shape = tuple(_fast_length(n + k - 1) for n, k in zip(values.shape, kernel.shape, strict=True))
    axes = (0, 1, 2)
    product = np.fft.rfftn(values, shape, axes) * np.fft.rfftn(kernel, shape, axes)
    inside = tuple(slice(k - 1, n) for n, k in zip(values.shape, kernel.shape, strict=True))
    return np.fft.irfftn(product, shape, axes)[inside].astype(np.float64)


def _grown(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """A mask extended by the six neighbours of every node in it."""
    grown = mask.copy()
    for axis in range(3):
        line, grown_line = np.moveaxis(mask, axis, 0), np.moveaxis(grown, axis, 0)
        grown_line[1:] |= line[:-1]
        grown_line[:-1] |= line[1:]
    return grown


def inside_mask(grid: SignedDistanceGrid) -> NDArray[np.uint8]:
    """Nodes of the grid at which a particle counts as inside the vessel.

    These are the cavity and the wall up to its middle: a particle that leans on the wall stays inside. The result is
    kept in the cache directory.
    """
    digest = hashlib.sha256(repr(grid.shape).encode() + grid.values.tobytes() + grid.cavity.tobytes()).hexdigest()
    name = f"inside-{digest[:24]}"
    known = load_arrays(name)
    if known is not None and "inside" in known and known["inside"].shape == grid.shape:
        return np.ascontiguousarray(known["inside"], np.uint8)
    from scipy import ndimage  # takes a sixth of a second to import

    nearest = ndimage.distance_transform_edt(grid.values <= 0.0, return_distances=False, return_indices=True)
    inside = np.ascontiguousarray(grid.cavity[tuple(nearest)].astype(np.uint8))
    store_arrays(name, {"inside": inside})
    return inside


def equivalent_distance(
    grid: SignedDistanceGrid, inside: NDArray[np.uint8], rim_height: float, support: float
) -> NDArray[np.float32]:
    """Distance of the equivalent plane at the grid's nodes; less than the signed distance in a corner, more at an edge.

    The result is kept in the cache directory.

    Args:
        grid: signed distance and cavity.
        inside: 1 at nodes in the cavity, continued into the wall up to its middle.
        rim_height: of the lip in the vessel's frame [m]. Within one to two supports of it, and outside the cavity, the
            result is the signed distance: there the wall ends, or the node is on its other side.
        support: h of the kernel [m].

    Returns:
        Shape of the grid [m].
    """
    step = grid.spacing
    if not inside.any() or not (grid.axes()[2] < rim_height - support).any():
        return grid.values
    near = _grown(inside > 0)  # only next to the cavity does the result differ from the signed distance
    about = repr((EDITION, np.__version__, grid.shape, step, grid.origin.tolist(), rim_height, support))
    digest = hashlib.sha256(about.encode() + grid.values.tobytes() + inside.tobytes()).digest()
    name = f"plane-{digest[0] % PLACES:02}"
    distances = np.ascontiguousarray(grid.values, np.float32).copy()
    corrected = _kept_planes(name, digest, int(near.sum()))
    if corrected is None:
        corrected = _planes(grid, inside, near, rim_height, support)[near]
        store_arrays(name, {"digest": np.frombuffer(digest, np.uint8), "plane": corrected}, compressed=False)
    distances[near] = corrected
    return distances


def _kept_planes(name: str, digest: bytes, count: int) -> NDArray[np.float32] | None:
    """The array stored under a name, if it has this digest."""
    known = load_arrays(name)
    if known is None or not {"digest", "plane"} <= known.keys() or known["digest"].tobytes() != digest:
        return None
    return known["plane"].astype(np.float32) if known["plane"].shape == (count,) else None


def _planes(
    grid: SignedDistanceGrid,
    inside: NDArray[np.uint8],
    near: NDArray[np.bool_],
    rim_height: float,
    support: float,
) -> NDArray[np.float32]:
    """Compute `equivalent_distance` for a vessel that has a cavity below its rim.

    Args:
        near: nodes in the cavity and next to it.
    """
    step = grid.spacing
    reach = int(np.ceil(support / step))
    z = grid.axes()[2]
    weight = np.clip((rim_height - support - z) / support, 0.0, 1.0)
    depth = np.clip(0.5 - grid.values.astype(np.float64) / step, 0.0, 1.0)
    solid = np.where(inside > 0, depth, 1.0)
    solid[:, :, z > rim_height] = 0.0
    offsets = np.arange(-reach, reach + 1) * step / support
    r = np.sqrt(offsets[:, None, None] ** 2 + offsets[None, :, None] ** 2 + offsets[None, None, :] ** 2)
    u = np.clip(1.0 - r, 0.0, None)
    kernel = u**4 * (1.0 + 4.0 * r)
    kernel /= kernel.sum()
    box = tuple(slice(int(where.min()), int(where.max()) + 1) for where in np.nonzero(near))
    padded = np.pad(solid, reach, mode="edge")[tuple(slice(b.start, b.stop + 2 * reach) for b in box)]
    share = np.clip(_convolved(padded, kernel), 0.0, 1.0)
    q = np.linspace(-1.0, 1.0, 801)
    plane = support * np.interp(-share, -half_space(q), q)
    plane = np.where(share > 1e-4, plane, np.maximum(grid.values[box], support))
    distances = grid.values.astype(np.float64)
    distances[box] = np.where(
        near[box], weight[box[2]] * plane + (1.0 - weight[box[2]]) * distances[box], distances[box]
    )
    return np.ascontiguousarray(distances, dtype=np.float32)
