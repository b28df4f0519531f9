"""What a pour is worth by what it will tell: the least loss that may be expected once it has been weighed.

A pour on the slope of the valley tells which hypothesis is right, one on a plateau hardly anything, whatever either
loses. With H pours to follow (4 at most) the next one minimises

    E c(x) − H (min_x′ E c(x′) − E_y min_x′ E[c(x′) | y at x]),    c = clip(f, 0, 1)

What y may be is dealt to a few values; each reweighs the hypotheses and moves what each of them expects elsewhere. The
minimum over x′ is one over places: what was poured, the best of each hypothesis, and some all over the region.

Source: knowledge gradient, Frazier et al. 2009; over hypotheses, ours.
Limitations: one pour ahead; the places are not polished, so the best one by `least_loss` is among them.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from actors.optimizer.core.averaged import AveragedProcess, clipped_moments
from actors.optimizer.core.region import Feasibility

Array = NDArray[np.float64]

SHOWN = np.array([0.0, 0.02, 0.06, 0.14, 0.28, 0.46, 0.66, 0.84, 1.0])
"""What a pour may show, in units of the largest cost: closer where little is lost, for there decisions are made."""

SOME = 8
"""Places that are thought about because little is expected to be lost there, and as many that are disputed most."""

HEAVIEST, EVEN = 16, 16
"""Heavy hypotheses whose best places are thought about; places all over the region."""

TARGETS = 64
"""Places all over the region at which the least loss afterwards is looked for, beside the best of each hypothesis."""


def looked_ahead(
    process: AveragedProcess,
    pour: Array,
    candidates: Array,
    known: Array,
    left: int,
    allowed: Callable[[Array, Array], Array],
    feasibility: Feasibility | None,
) -> Array:
    """The place (dimension,) of the next pour.

    Args:
        process: of the cost.
        pour: (dimension,), the best by what it loses and saves itself.
        candidates: (m, dimension), the first of them all over the region.
        known: (k, dimension), poured actions that may be poured again; k ≥ 0.
        left: H.
        allowed: what values (p,) of pours at places (p, dimension) become by limits and refusals.
        feasibility: of requests; None while nothing was refused.
    """
    if left == 0:
        return pour
    means, deviations, noises = process.components(candidates)
    costs = clipped_moments(means, deviations)[0]
    between = process.mixture @ means**2 - (process.mixture @ means) ** 2
    disputed = np.sqrt(np.maximum(between, 0.0)) / (process.mixture @ noises)
    heavy = np.argsort(-process.mixture, kind="stable")[:HEAVIEST]
    chosen = [
        np.argsort(process.mixture @ costs, kind="stable")[:SOME],
        np.argsort(-disputed, kind="stable")[:SOME],
        costs[heavy].argmin(axis=1),
        np.arange(min(EVEN, len(candidates))),
    ]
    places = np.concatenate([pour[None, :], candidates[np.unique(np.concatenate(chosen))]])
    others = np.concatenate([costs.argmin(axis=1), np.arange(min(TARGETS, len(candidates)))])
    targets = np.unique(np.concatenate([places, known, candidates[others]]), axis=0)
    if feasibility is not None and (likely := feasibility.likely(targets)).any():
        targets = targets[likely]
    now = float(process.predict(targets)[0].min())
    value = process.predict(places)[0] - left * (now - process.worst * foreseen(process, places, targets))
    return np.asarray(places[int(np.argmin(allowed(value / process.worst, places)))])


def foreseen(process: AveragedProcess, places: Array, targets: Array) -> Array:
    """Least expected cost (p,) over targets (m, dimension), in units of the worst, after a pour at places (p, ·)."""
    means, deviations, _ = process.components(targets)
    at, its, noises = process.components(places)
    spreads = np.hypot(its, noises)
    covariances = process.covariances(places, targets)
    edges = np.concatenate([[-np.inf], 0.5 * (SHOWN[1:] + SHOWN[:-1]), [np.inf]])
    found = []
    for i in range(len(places)):
        chances = np.diff(ndtr((edges[:, None] - at[:, i]) / spreads[:, i]), axis=0)  # (shown, components)
        slope = covariances[:, i] / spreads[:, i, None] ** 2
        left = np.sqrt(np.maximum(deviations**2 - slope * covariances[:, i], 1e-10))
        moved = means + slope * (SHOWN[:, None] - at[:, i])[:, :, None]  # (shown, components, targets)
        costs = clipped_moments(moved, np.broadcast_to(left, moved.shape))[0]
        found.append(float(np.einsum("kc,c,kcm->km", chances, process.mixture, costs).min(axis=1).sum()))
    return np.array(found)
