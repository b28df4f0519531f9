"""The prior g over actions: uniform over what of the box meets the constraints, drawn evenly."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from scipy.stats import qmc

from actors.optimizer.core.problem import Linear, Point
from sim_engine.space import Space

if TYPE_CHECKING:
    from actors.optimizer.core.region import Region


def actions_of_prior(actions: Space, count: int, seed: int, constraints: Sequence[Linear] = ()) -> tuple[Point, ...]:
    """A scrambled Sobol sequence over the unit cube of actions: every stretch of it covers g evenly.

    Its numbers are binary fractions made by integer arithmetic, the same on every machine.
    """
    region = region_of(actions, constraints)
    if region is not None:
        drawn = region.draw(count, np.random.default_rng(seed), even=True)
        return tuple(tuple(map(float, row)) for row in drawn)
    sampler = qmc.Sobol(actions.dimension, scramble=True, rng=np.random.default_rng(seed))
    exponent = max(1, int(np.ceil(np.log2(max(count, 1)))))
    return tuple(tuple(map(float, row)) for row in sampler.random_base2(exponent)[:count])


def region_of(actions: Space, constraints: Sequence[Linear]) -> Region | None:
    """What the constraints leave of the space; None without any, and nothing slow is loaded then."""
    if not constraints:
        return None
    from actors.optimizer.core.region import Region

    return Region(actions, constraints)
