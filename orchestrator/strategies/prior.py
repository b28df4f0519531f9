"""The prior g over actions: uniform over the box, drawn evenly."""

from __future__ import annotations

import numpy as np
from scipy.stats import qmc

from actors.optimizer.core.problem import Point
from sim_engine.space import Space


def actions_of_prior(actions: Space, count: int, seed: int) -> tuple[Point, ...]:
    """A scrambled Sobol sequence over the unit cube of actions: every stretch of it covers g evenly.

    Its numbers are binary fractions made by integer arithmetic, the same on every machine.
    """
    sampler = qmc.Sobol(actions.dimension, scramble=True, rng=np.random.default_rng(seed))
    exponent = max(1, int(np.ceil(np.log2(max(count, 1)))))
    return tuple(tuple(map(float, row)) for row in sampler.random_base2(exponent)[:count])
