"""The front of objectives that can't all be had: what finds it, and what of a set lies on it. Pure functions."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from orchestrator.strategies.deployment.objectives import Vector

AUGMENTATION = 0.05
"""Share of the weighted sum in a scalarisation: without it, weakly dominated points would be as good as others."""


def random_weights(count: int, rng: np.random.Generator) -> Vector:
    """Weights drawn evenly from the simplex: positive, adding up to 1."""
    drawn = rng.exponential(size=count)
    return tuple(float(w) for w in drawn / drawn.sum())


def scalarised(
    vectors: Sequence[Vector], weights: Vector, worst: Vector, among: Sequence[Vector] | None = None
) -> list[float]:
    """The augmented Chebyshev function of each vector: max_j λ_j z_j + ρ Σ_j λ_j z_j.

    z_j is objective j over the range of what was observed of it (`among`; the vectors themselves unless given); pours
    that delivered too little (beyond `worst`) don't stretch the range, and come to lie above 1. Every point of the
    front minimises it for some weights, on concave parts too, which no weighted sum reaches.

    Source: Knowles, ParEGO: a hybrid algorithm with on-line landscape approximation for expensive multiobjective
    optimization problems, IEEE Transactions on Evolutionary Computation 10, 2006.
    """
    if not vectors:
        return []
    values, limit = np.array(vectors, dtype=np.float64), np.array(worst, dtype=np.float64)
    known = values if among is None else np.array(among, dtype=np.float64)
    usual = known[np.all(known <= limit + 1e-12, axis=1)]
    lower = usual.min(axis=0) if len(usual) else np.zeros_like(limit)
    upper = usual.max(axis=0) if len(usual) else limit
    span = np.where(upper - lower > 1e-9, upper - lower, np.maximum(limit, 1e-9))
    weighted = np.array(weights) * (values - lower) / span
    return [float(v) for v in weighted.max(axis=1) + AUGMENTATION * weighted.sum(axis=1)]


def undominated(vectors: Sequence[Vector]) -> list[int]:
    """Indices of the vectors that no other one beats: as good in all objectives and better in one."""
    values = np.array(vectors, dtype=np.float64)
    kept = []
    for i, own in enumerate(values):
        beaten = np.all(values <= own, axis=1) & np.any(values < own, axis=1)
        if not beaten.any():
            kept.append(i)
    return kept
