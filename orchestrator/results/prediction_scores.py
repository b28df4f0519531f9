"""Comparison of weighed pours with the simulator's predictions: a row per pour, and scores per split."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

from sim_engine.action import Action
from sim_engine.prediction_band import PredictionInterval, SampleStatistics


@dataclass(frozen=True)
class ScoredRow:
    """A weighed pour and its prediction.

    Attributes:
        line: line in the table of pours.
        split: 'train', 'test' or 'transfer'.
        action: the action of the pour.
        measured: r = spilled / poured as weighed; None if too little was poured.
        predicted: r over the simulations; None if none of them could be used, or poured enough.
        band: prediction interval of a single pour.
        lost: simulations that could not be used.
    """

    line: int
    split: str
    action: Action
    measured: float | None
    predicted: SampleStatistics | None
    band: PredictionInterval | None
    lost: int = 0

    @property
    def difference(self) -> float | None:
        """Measured minus predicted."""
        if self.measured is None or self.predicted is None:
            return None
        return self.measured - self.predicted.mean

    @property
    def held(self) -> bool | None:
        """Whether the interval contains the pour; None if one of them is unknown."""
        return None if self.measured is None or self.band is None else self.band.holds(self.measured)


@dataclass(frozen=True)
class Score:
    """Quality of the predictions of some pours.

    Attributes:
        pours: pours that have both r and a prediction.
        error: mean |Δ|; None without pours.
        correlation: Spearman's, of measured and predicted r; None for fewer than three pours, or if all values are
            equal.
        held: pours inside their interval.
    """

    pours: int
    error: float | None
    correlation: float | None
    held: int

    @property
    def share_held(self) -> float | None:
        """The share of the pours inside their interval."""
        return self.held / self.pours if self.pours else None

    def as_json(self) -> dict[str, Any]:
        """JSON-ready mapping."""
        return {
            "pours": self.pours,
            "mean_error": self.error,
            "spearman": self.correlation,
            "held": self.held,
            "share_held": self.share_held,
        }

    def text(self) -> str:
        """'mean |Δ| 1.6 %, Spearman 0.97, 15 of 16 pours inside their 90 % band'."""
        if self.error is None:
            return "no pour with a spillage to compare"
        ranks = "" if self.correlation is None else f", Spearman {self.correlation:.2f}"
        pours = "pour" if self.pours == 1 else "pours"
        return f"mean |Δ| {100 * self.error:.2f} %{ranks}, {self.held} of {self.pours} {pours} inside the 90 % band"


def score(rows: Iterable[ScoredRow]) -> Score:
    """Mean |Δ|, rank correlation, and the number of pours inside their intervals."""
    known = [row for row in rows if row.difference is not None]
    differences = [abs(row.difference or 0.0) for row in known]
    measured = [row.measured or 0.0 for row in known]
    predicted = [row.predicted.mean for row in known if row.predicted is not None]
    return Score(
        pours=len(known),
        error=math.fsum(differences) / len(known) if known else None,
        correlation=rank_correlation(measured, predicted),
        held=sum(row.held is True for row in known),
    )


def scores(rows: Sequence[ScoredRow]) -> dict[str, Score]:
    """Scores by split, and for 'all' if there is more than one split."""
    splits = list(dict.fromkeys(row.split for row in rows))
    found = {split: score(row for row in rows if row.split == split) for split in splits}
    return {**found, "all": score(rows)} if len(splits) > 1 else found


def rank_correlation(first: Sequence[float], second: Sequence[float]) -> float | None:
    """Spearman's ρ; None for fewer than three pairs, or if one side has only equal values."""
    if len(first) < 3 or len(set(first)) < 2 or len(set(second)) < 2:
        return None
    a, b = _ranks(first), _ranks(second)
    middle = (len(a) - 1) / 2.0
    products = math.fsum((x - middle) * (y - middle) for x, y in zip(a, b, strict=True))
    squares = [math.fsum((x - middle) ** 2 for x in ranks) for ranks in (a, b)]
    return products / math.sqrt(squares[0] * squares[1])


def _ranks(values: Sequence[float]) -> list[float]:
    """Ranks from 0; equal values share their mean rank."""
    ordered = sorted(values)
    places: dict[float, list[int]] = {}
    for place, value in enumerate(ordered):
        places.setdefault(value, []).append(place)
    return [math.fsum(places[value]) / len(places[value]) for value in values]
