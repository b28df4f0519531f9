"""The cavity of a vessel: the volume that rain would fill up to the brim.

Each free node has a level: the lowest height to which a path from it to the outside must rise. Liquid stands where the
level is higher than the node itself. Horizontal slices consist of a few connected parts each, so the levels are found
on the small graph of those parts. Handles, feet and dents need no special treatment: they hold no pool, or a smaller
one than the cavity.

Limitations: air that an overhang would trap counts as liquid; holes narrower than the grid's spacing are not detected.
"""

from __future__ import annotations

import heapq
import math
from collections import defaultdict
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sim_engine.vessel.mesh_distance import Crossings, GridLayout

Floats = NDArray[np.float64]
Part = tuple[int, int]
"""Slice and label of a connected part of it."""


@dataclass(frozen=True)
class CavityFill:
    """The largest pool that rain leaves in a solid.

    Attributes:
        pool: its nodes, shape of the grid.
        brim: first slice at which it overflows; 0 without a pool.
        outside: nodes that drain below the brim, shape of the grid.
        enclosed: nodes in voids that no liquid reaches.
        drained: nodes surrounded by solid in their slice that hold no liquid, because it runs out below.
        drain: lowest slice with such a node; −1 without any.
    """

    pool: NDArray[np.bool_]
    brim: int
    outside: NDArray[np.bool_]
    enclosed: int
    drained: int
    drain: int


def flood(free: NDArray[np.bool_], sealed: NDArray[np.bool_] | None = None) -> CavityFill:
    """Find the largest pool.

    Args:
        free: nodes without solid; the grid's outermost ones are free, shape (nx, ny, nz).
        sealed: free nodes that are not connected to the node above them, shape of `free`; None: all are connected.
    """
    from scipy import ndimage

    depth = free.shape[2]
    labels = np.zeros(free.shape, dtype=np.int32)
    sizes: dict[Part, int] = {}
    open_parts: set[Part] = set()
    neighbours: dict[Part, set[Part]] = defaultdict(set)
    for k in range(depth):
        labels[:, :, k], count = ndimage.label(free[:, :, k])
        layer = labels[:, :, k]
        number = np.bincount(layer.ravel(), minlength=count + 1)
        sizes.update({(k, component): int(number[component]) for component in range(1, count + 1)})
        border = np.concatenate([layer[0], layer[-1], layer[:, 0], layer[:, -1]])
        open_parts |= {(k, int(component)) for component in np.unique(border) if component}
        if k:
            below = labels[:, :, k - 1]
            both = (layer > 0) & (below > 0)
            if sealed is not None:
                both &= ~sealed[:, :, k - 1]
            # a pair as one number: numpy sorts rows ten times as slowly
            pairs = np.unique(layer[both].astype(np.int64) * free[:, :, k].size + below[both])
            for upper, lower in zip(*(part.tolist() for part in np.divmod(pairs, free[:, :, k].size)), strict=True):
                neighbours[(k, upper)].add((k - 1, lower))
                neighbours[(k - 1, lower)].add((k, upper))
    levels = _levels(open_parts, neighbours)
    wet = {component for component in sizes if component[0] < levels.get(component, -1)}
    best = _largest_pool(wet, neighbours, sizes)
    brim = levels[next(iter(best))] if best else 0
    drained = [
        component for component in sizes if component not in open_parts and component in levels and component not in wet
    ]
    outside = {component for component, level in levels.items() if level < brim}
    return CavityFill(
        pool=_nodes(labels, best),
        brim=brim,
        outside=_nodes(labels, outside),
        enclosed=sum(size for component, size in sizes.items() if component not in levels),
        drained=sum(sizes[component] for component in drained),
        drain=min((component[0] for component in drained), default=-1),
    )


def _levels(open_parts: set[Part], neighbours: dict[Part, set[Part]]) -> dict[Part, int]:
    """Level of every part that has a path to the outside (Dijkstra's method with the highest slice as length)."""
    levels: dict[Part, int] = {}
    queue = [(component[0], component) for component in open_parts]
    heapq.heapify(queue)
    while queue:
        level, component = heapq.heappop(queue)
        if component in levels:
            continue
        levels[component] = level
        for other in neighbours[component]:
            if other not in levels:
                heapq.heappush(queue, (max(level, other[0]), other))
    return levels


def _largest_pool(wet: set[Part], neighbours: dict[Part, set[Part]], sizes: dict[Part, int]) -> set[Part]:
    best: set[Part] = set()
    best_size, left = 0, set(wet)
    while left:
        pool, stack = set(), [left.pop()]
        while stack:
            component = stack.pop()
            pool.add(component)
            connected = neighbours[component] & left
            left -= connected
            stack.extend(connected)
        size = sum(sizes[component] for component in pool)
        if size > best_size:
            best, best_size = pool, size
    return best


def _nodes(labels: NDArray[np.int32], parts: set[Part]) -> NDArray[np.bool_]:
    mask = np.zeros(labels.shape, dtype=bool)
    by_slice: dict[int, list[int]] = defaultdict(list)
    for k, label in parts:
        by_slice[k].append(label)
    for k, chosen in by_slice.items():
        mask[:, :, k] = np.isin(labels[:, :, k], chosen)
    return mask


def brim_height(fill: CavityFill, free: NDArray[np.bool_], layout: GridLayout, hits: Crossings) -> float:
    """Exact height of the brim: the lowest saddle of the rim between the last dry slice and the first that overflows.

    Args:
        fill: with a pool.
        free: as given to `flood`.
        layout: of the grid.
        hits: crossings of columns with the surface.

    Returns:
        z [m].
    """
    from scipy import ndimage

    k = fill.brim
    below, above = (layout.origin[2] + layout.spacing * (k - 1), layout.origin[2] + layout.spacing * k)
    height = np.where(free[:, :, k - 1], -math.inf, math.inf)
    within = (hits.z > below) & (hits.z <= above)
    top = np.full(height.shape, -math.inf)
    np.maximum.at(top, (hits.i[within], hits.j[within]), hits.z[within])
    covered = ~free[:, :, k - 1] & free[:, :, k]
    height[covered] = np.where(np.isfinite(top[covered]), top[covered], above)
    candidates = np.unique(height[np.isfinite(height)])
    first, last = 0, len(candidates) - 1
    while first < last:
        middle = (first + last) // 2
        labels, _ = ndimage.label(height <= candidates[middle])
        joined = np.intersect1d(labels[fill.pool[:, :, k - 1]], labels[fill.outside[:, :, k - 1]])
        if joined.any():
            last = middle
        else:
            first = middle + 1
    return float(candidates[last]) if len(candidates) else above


def floor_height(fill: CavityFill, layout: GridLayout, hits: Crossings) -> float:
    """Lowest z of the pool, where its columns meet the solid below them [m]."""
    wet = fill.pool.any(axis=2)
    lowest = layout.origin[2] + layout.spacing * np.argmax(fill.pool, axis=2)
    floor = np.full(wet.shape, -math.inf)
    under = (hits.z <= lowest[hits.i, hits.j]) & (hits.z > lowest[hits.i, hits.j] - layout.spacing)
    np.maximum.at(floor, (hits.i[under], hits.j[under]), hits.z[under])
    known = wet & np.isfinite(floor)
    return float(floor[known].min()) if known.any() else float(lowest[wet].min())
