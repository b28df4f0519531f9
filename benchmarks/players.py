"""Shared parts of benchmarks that play strategies on toy problems: scene, outcomes, means with intervals."""

from __future__ import annotations

import random
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, TypeVar

import numpy as np

from actors.optimizer.questions import SpaceFillingQuery
from actors.optimizer.suggest import propose
from orchestrator.learning.requests import (
    Outcome,
    Pour,
    Poured,
    Request,
    Simulate,
    Simulated,
    Slots,
    Suggest,
    Suggested,
)
from orchestrator.learning.strategy import Strategy
from sim_engine.liquids import Liquid
from sim_engine.outcome import PourMeasurement, PourOutcome
from sim_engine.scene import Scene
from sim_engine.search_space import Space
from sim_engine.vessel.shapes import cylinder

SCENE = Scene(
    "cup",
    cylinder("beaker", inner_radius=0.04, inner_height=0.1),
    cylinder("cup", inner_radius=0.03, inner_height=0.08),
    Liquid(mass=0.2),
    fixed={"height": 0.03},
)

Floats = np.ndarray[Any, np.dtype[np.float64]]
T = TypeVar("T")


def play(strategy: Strategy, answer: Callable[[Request], Outcome], *, pours_last: bool = True) -> None:
    """Run a strategy until it finishes; optimiser queries are answered here.

    Args:
        strategy: strategy to run.
        answer: returns the outcome of a simulation or a pour.
        pours_last: finish pours after other requests; otherwise all requests finish in order.
    """
    waiting: list[Request] = []
    while not strategy.finished:
        busy = sum(isinstance(one, Simulate) for one in waiting), sum(isinstance(one, Pour) for one in waiting)
        waiting += strategy.ask(Slots(1 - busy[0], 1 - busy[1]))
        if pours_last:
            waiting.sort(key=lambda one: isinstance(one, Pour))
        request = waiting.pop(0)
        if isinstance(request, Suggest):
            query = request.query
            if not isinstance(query, SpaceFillingQuery):
                query = replace(query, map_resolution=0)  # maps are only for figures and do not affect decisions
            outcome: Outcome = Suggested(propose(query))
        else:
            outcome = answer(request)
        strategy.tell(request, outcome)


def simulated(spilled: float, seed: int, cpu_s: float = 1.0) -> PourOutcome:
    """Return a simulated pour that spills this share of the load (0 … 1) and retains nothing."""
    spilled = min(max(spilled, 0.0), 1.0)
    return PourOutcome(1 - spilled, spilled, 0.0, 0.0, 0.0, 500, 0.007, 0.01, 2.0, 400, cpu_s, seed)


def unit(space: Space, action: Any) -> Floats:
    """Return the point of the unit cube for an action."""
    return space.encode({name: getattr(action, name) for name in space.names})


@dataclass
class Numbers:
    """A toy world that evaluates simulations and pours at points of the unit cube.

    Attributes:
        true: loss of a pour without scatter.
        observed: weighed loss of the pour with this number.
        simulated: mean simulated loss.
        scatter: standard deviation of simulations over seeds.
        poured: losses of the pours, without scatter.
        places: points of the pours.
    """

    space: Space
    true: Callable[[Floats], float]
    observed: Callable[[Floats, int], float]
    simulated: Callable[[Floats], float]
    scatter: float
    poured: list[float] = field(default_factory=list)
    places: list[Floats] = field(default_factory=list)

    def answer(self, request: Request) -> Outcome:
        """Return the outcome of a simulation or a pour."""
        assert isinstance(request, Simulate | Pour)
        at = unit(self.space, request.action)
        if isinstance(request, Pour):
            spilled = self.observed(at, len(self.poured))
            self.poured.append(self.true(at))
            self.places.append(at)
            return Poured(PourMeasurement(0.2, 0.2 * spilled, 0.0))
        chance = self.scatter * float(np.random.default_rng(request.seed).standard_normal())
        return Simulated(simulated(self.simulated(at) + chance, request.seed))


def interval(values: list[float]) -> tuple[float, float, float]:
    """Return the mean and its 95 % bootstrap interval."""
    draws = random.Random(0)
    means = sorted(float(np.mean(draws.choices(values, k=len(values)))) for _ in range(2000))
    return float(np.mean(values)), means[50], means[1949]


def by_turn(campaigns: Sequence[Sequence[T]]) -> dict[str, list[T]]:
    """Return the first pours of campaigns, all others, and all, by the name of a row."""
    return {
        "first pours": [pours[0] for pours in campaigns if pours],
        "all others": [pour for pours in campaigns for pour in pours[1:]],
        "all": [pour for pours in campaigns for pour in pours],
    }


def coverage(intervals: Sequence[Sequence[float]], share: float) -> tuple[float, float]:
    """Return the share of losses inside their intervals, and the mean interval score (smaller is better).

    Source: interval score, Gneiting & Raftery, JASA 2007, equation 43.

    Args:
        intervals: low end, high end and loss of each pour.
        share: probability of the intervals.
    """
    low, high, lost = np.array(intervals).T
    missed = np.maximum(low - lost, 0.0) + np.maximum(lost - high, 0.0)
    score = high - low + 2.0 / (1.0 - share) * missed
    return float(np.mean((low <= lost) & (lost <= high))), float(np.mean(score))
