"""Seeds that strategies hand out: one stream per strategy, no number twice."""

from __future__ import annotations

import numpy as np


class SeedStream:
    """Distinct seeds below 2³¹, the same for the same root seed and name.

    Args:
        seed: of the campaign.
        name: of the strategy's stage, so that two stages of one campaign share no seeds.
    """

    def __init__(self, seed: int, name: str) -> None:
        self._rng = np.random.default_rng(np.random.SeedSequence([seed, *name.encode()]))
        self._given: set[int] = set()

    def next(self) -> int:
        """A seed that this stream has not given before."""
        while (seed := int(self._rng.integers(2**31))) in self._given:
            pass
        self._given.add(seed)
        return seed

    @property
    def rng(self) -> np.random.Generator:
        """For other random choices."""
        return self._rng
