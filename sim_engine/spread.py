"""What several seeds of one pour come to: a prediction is a mean, and how much a single pour differs from it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from sim_engine.losses import normalised_spillage
from sim_engine.outcome import PourOutcome

FRACTIONS = ("received", "spilled", "retained", "in_flight", "escaped")
"""Fractions of a `PourOutcome`; they add up to 1."""


@dataclass(frozen=True)
class Spread:
    """A quantity over seeds.

    Attributes:
        mean: of all seeds.
        deviation: standard deviation of one seed (n − 1 in the denominator); None for a single one.
        count: seeds.
    """

    mean: float
    deviation: float | None
    count: int

    @classmethod
    def of(cls, values: Sequence[float]) -> Spread | None:
        """The spread of some values; None without any."""
        if not values:
            return None
        mean = math.fsum(values) / len(values)
        if len(values) == 1:
            return cls(mean, None, 1)
        return cls(mean, math.sqrt(math.fsum((v - mean) ** 2 for v in values) / (len(values) - 1)), len(values))

    def as_json(self) -> dict[str, Any]:
        """JSON-ready mapping."""
        return {"mean": self.mean, "deviation": self.deviation, "count": self.count}

    def percent(self, decimals: int = 1) -> str:
        """A fraction for people: '3.1 ± 0.4 %'; of a single seed '3.1 %'."""
        spread = "" if self.deviation is None else f" ± {100 * self.deviation:.{decimals}f}"
        return f"{100 * self.mean:.{decimals}f}{spread} %"


def spreads(outcomes: Sequence[PourOutcome]) -> dict[str, Spread]:
    """Every fraction of some outcomes of one pour, and 'spillage', r = spilled / poured, over seeds.

    Args:
        outcomes: of the same task but for the seed; invalid ones are left out. What has no valid outcome, and r where
            too little was poured for it, is missing in the answer.
    """
    valid = [outcome for outcome in outcomes if outcome.invalid is None]
    values = {name: [float(getattr(outcome, name)) for outcome in valid] for name in FRACTIONS}
    values["spillage"] = [r for outcome in valid if (r := normalised_spillage(outcome.fractions)) is not None]
    found = {name: Spread.of(seeds) for name, seeds in values.items()}
    return {name: spread for name, spread in found.items() if spread is not None}
