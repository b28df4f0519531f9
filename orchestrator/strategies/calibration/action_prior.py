"""The prior g over actions, where they meet the constraints: uniform, or along some dimensions normal; drawn evenly.

Whoever reads a campaign's file loads this; scipy is loaded by those who draw.

Benches as they may be: draws of θ with nuisances, from a calibration or from what is thought beforehand.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Collection, Sequence
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from actors.optimizer.questions import Linear, Point
from orchestrator.strategies.campaign_plan import NormalPrior
from sim_engine.liquids import SimulationParameters
from sim_engine.search_space import Space

if TYPE_CHECKING:
    from actors.optimizer.feasible_region import Region

Array = NDArray[np.float64]

FINENESS = 2.0**30
"""Places that a draw may have on an axis, those of a Sobol number: logarithms that differ between machines in their
last bits still give the same action."""


def actions_of_prior(
    actions: Space, count: int, seed: int, constraints: Sequence[Linear] = (), prior: Sequence[NormalPrior] = ()
) -> tuple[Point, ...]:
    """A scrambled Sobol sequence over the unit cube of actions: every stretch of it covers g evenly.

    Its numbers are binary fractions made by integer arithmetic, the same on every machine. Those of dimensions with a
    normal prior are sent through the inverse of its distribution, and rounded to such fractions again.

    Args:
        prior: dimensions of `actions` along which g is not uniform.

    Raises:
        ValueError: constraints and prior leave next to nothing.

    Source: sampling by inversion: Devroye, Non-uniform random variate generation, 1986, chapter 2.
    """
    region = region_of(actions, constraints)
    law = partial(_distributed, actions=actions, prior=prior) if prior else None
    if region is not None:
        drawn = region.draw(count, np.random.default_rng(seed), even=True, law=law)
        return tuple(tuple(map(float, row)) for row in drawn)
    from scipy.stats import qmc

    sampler = qmc.Sobol(actions.dimension, scramble=True, rng=np.random.default_rng(seed))
    exponent = max(1, int(np.ceil(np.log2(max(count, 1)))))
    uniform = sampler.random_base2(exponent)[:count]
    return tuple(tuple(map(float, row)) for row in (uniform if law is None else law(uniform)))


def actions_all_over(
    actions: Space, constraints: Sequence[Linear], *, corners: int, drawn: int
) -> list[dict[str, float]]:
    """Allowed actions from everywhere, for checks: the middle, corners, some between. The same whenever asked.

    Args:
        corners: of the box, at most.
        drawn: actions between.

    Returns:
        Values of the searched dimensions [SI].
    """
    rng, region = np.random.default_rng(0), region_of(actions, constraints)
    ends = itertools.islice(itertools.product((0.0, 1.0), repeat=actions.dimension), corners)
    points = np.array([[0.5] * actions.dimension, *ends])
    if region is None:
        between = rng.random((drawn, actions.dimension))
    else:
        points, between = points[region.allows(points)], region.draw(drawn, rng, even=False)
    return [actions.decode(point) for point in (*points, *between)]


def region_of(actions: Space, constraints: Sequence[Linear]) -> Region | None:
    """What the constraints leave of the space; None without any, and nothing slow is loaded then."""
    if not constraints:
        return None
    from actors.optimizer.feasible_region import Region

    return Region(actions, constraints)


def _distributed(uniform: Array, actions: Space, prior: Sequence[NormalPrior]) -> Array:
    """Points (m, dimension) of the unit cube that are distributed as g is, from uniform ones."""
    from scipy.special import ndtr, ndtri

    points = uniform.copy()
    for one in prior:
        i = actions.names.index(one.name)
        axis = actions.axes[i]
        below, above = ndtr((np.array([axis.lower, axis.upper]) - one.mean) / one.deviation)
        values = one.mean + one.deviation * ndtri(below + uniform[:, i] * (above - below))
        places = [axis.encode(value) for value in np.clip(values, axis.lower, axis.upper)]
        points[:, i] = np.rint(np.array(places) * FINENESS) / FINENESS
    return points


FARTHEST = 3.0
"""Standard deviations beyond which no nuisance is drawn."""


def drawn_benches(
    best: SimulationParameters,
    count: int,
    seed: int,
    *,
    posterior: Sequence[SimulationParameters] = (),
    known: Collection[str] = (),
) -> tuple[SimulationParameters, ...]:
    """Equally likely θ of the bench that is to be poured on, its nuisances among them; pure.

    A posterior's draws are taken evenly, again and again if there are fewer than wanted. Nuisances that the calibration
    did not search differ between benches by their declared tolerances, around their values in those draws: normal,
    independent of each other, by a scrambled Sobol sequence, and within their bounds.

    Args:
        best: θ*, or whatever is in force: what all draws are where there is no posterior, nuisances aside.
        count: of draws, at least 1.
        seed: same seed, same draws.
        posterior: complete θ, equally likely.
        known: nuisances that are not to be drawn: the calibration has searched them, or a person vouches for them.

    Returns:
        `count` complete θ.
    """
    from scipy.special import ndtri
    from scipy.stats import qmc

    if count < 1:
        raise ValueError(f"at least one draw is needed, got {count}")
    nuisances = [info for name, info in SimulationParameters.nuisances().items() if name not in known]
    rows = [posterior[(i * len(posterior)) // count] if count <= len(posterior) else posterior[i % len(posterior)]
            for i in range(count)] if posterior else [best] * count  # fmt: skip
    if not nuisances:
        return tuple(rows)
    sampler = qmc.Sobol(len(nuisances), scramble=True, rng=np.random.default_rng([seed % 2**64, *b"bench"]))
    uniform = sampler.random_base2(math.ceil(math.log2(count)) if count > 1 else 0)[:count]
    z = np.clip(ndtri(uniform), -FARTHEST, FARTHEST)
    benches = []
    for row, theta in zip(z, rows, strict=True):
        moved = {
            info.name: min(max(getattr(theta, info.name) + info.tolerance * float(u), info.lower), info.upper)
            for info, u in zip(nuisances, row, strict=True)
        }
        benches.append(theta.model_copy(update=moved))
    return tuple(benches)
