"""Requests of a strategy that are queued or pending: simulated trials and queries to the optimiser, with their seeds.

- `Trial` is one searched point with its simulations; `Trials` is the sequence of all trials.
- `OptimizerQueries` holds the pending queries with the continuation of each.
- `SeedStream` yields seeds for one strategy, without repetition.

The order of the requests, and not that of completion, defines the data of each decision. Decisions therefore do not
depend on which simulation finishes first.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from actors.optimizer.questions import Data, Point, Suggestion, SuggestionQuery
from orchestrator.learning.requests import Failed, Outcome, Simulate, Suggest, Suggested
from orchestrator.learning.run_errors import LearningError


@dataclass
class Trial:
    """A searched point with the simulations that evaluate it.

    Attributes:
        point: point in the unit cube of the searched space.
        requests: simulations whose costs are averaged.
        costs: cost of each answered request, by index; None if the request yielded no cost.
        context: further coordinates of the observation; see `CalibrationQuery`.
        refused: whether some request was refused because its action is impossible. It has no cost and is not counted as
            lost.
    """

    point: Point
    requests: tuple[Simulate, ...]
    context: Point = ()
    costs: dict[int, float | None] = field(default_factory=dict)
    refused: bool = False

    @property
    def closed(self) -> bool:
        """Whether all answers have arrived."""
        return len(self.costs) == len(self.requests)

    @property
    def cost(self) -> float | None:
        """Mean cost of the simulations that have one; None if none has."""
        defined = [cost for _, cost in sorted(self.costs.items()) if cost is not None]
        return sum(defined) / len(defined) if defined else None


class Trials:
    """Sequence of trials with a fixed look-back: simulations run in parallel, their outcomes count in request order.

    With `width` trials running, trial t is chosen from the outcomes of the trials up to t − width. Later trials count
    as pending even if they have been answered. The requests of a seeded campaign therefore do not depend on timing.
    """

    def __init__(self, width: int = 1) -> None:
        self.width = width
        self.all: list[Trial] = []
        self._unissued: deque[tuple[int, int]] = deque()
        self._open: dict[Simulate, deque[tuple[int, int]]] = {}

    def __len__(self) -> int:
        return len(self.all)

    def add(self, trial: Trial) -> None:
        """Queue a trial's simulations."""
        self._unissued.extend((len(self.all), i) for i in range(len(trial.requests)))
        self.all.append(trial)

    def issue(self, limit: int) -> list[Simulate]:
        """Return the next simulations to request, at most `limit`."""
        issued = []
        for _ in range(min(limit, len(self._unissued))):
            trial, index = self._unissued.popleft()
            request = self.all[trial].requests[index]
            self._open.setdefault(request, deque()).append((trial, index))
            issued.append(request)
        return issued

    def settle(self, request: Simulate, cost: float | None, *, refused: bool = False) -> Trial:
        """Record the cost of a simulation (None: no cost), or that it was refused.

        Raises:
            ValueError: the simulation was not requested or has been answered already.
        """
        waiting = self._open.get(request)
        if not waiting:
            raise ValueError(f"this simulation was not asked for, or has been answered already: {request}")
        trial, index = waiting.popleft()
        if not waiting:
            del self._open[request]
        self.all[trial].costs[index] = cost
        self.all[trial].refused |= refused
        return self.all[trial]

    @property
    def idle(self) -> bool:
        """Whether no simulation is queued or running."""
        return not self._unissued and not self._open

    @property
    def queued(self) -> bool:
        """Whether simulations are queued."""
        return bool(self._unissued)

    def abandon(self, trial: Trial) -> int:
        """Remove the simulations of a trial that have not been requested yet, and return their number."""
        number = next(i for i, other in enumerate(self.all) if other is trial)
        queued = [place for place in self._unissued if place[0] == number]
        self._unissued = deque(place for place in self._unissued if place[0] != number)
        trial.requests = trial.requests[: len(trial.requests) - len(queued)]
        return len(queued)

    @property
    def ready(self) -> bool:
        """Whether everything that the choice of the next trial depends on has been answered."""
        return not self._unissued and all(trial.closed for trial in self.all[: self._horizon])

    @property
    def _horizon(self) -> int:
        return max(0, len(self.all) - self.width + 1)

    def counting(self, *, everything: bool = False) -> list[Trial]:
        """Closed trials that the next choice may use, in request order; with `everything`, all closed trials."""
        trials = self.all if everything else self.all[: self._horizon]
        return [trial for trial in trials if trial.closed]

    def data(self, *, everything: bool = False) -> Data:
        """Observations that the next choice may use; with `everything`, all closed trials."""
        observed = [(t, cost) for t in self.counting(everything=everything) if (cost := t.cost) is not None]
        return Data(tuple((*t.point, *t.context) for t, _ in observed), tuple(cost for _, cost in observed))

    def pending(self, *, everything: bool = False) -> tuple[Point, ...]:
        """Points that are not answered or whose answers do not count yet."""
        trials = self.all if everything else self.all[self._horizon :]
        return tuple(t.point for t in trials if not (everything and t.closed))

    @property
    def answered(self) -> int:
        """Number of simulations answered."""
        return sum(len(trial.costs) for trial in self.all)

    @property
    def lost(self) -> int:
        """Number of simulations without a cost that were not refused."""
        return sum(cost is None for trial in self.all if not trial.refused for cost in trial.costs.values())


class SeedStream:
    """Distinct seeds below 2³¹; the same root seed and name yield the same seeds.

    Args:
        seed: seed of the campaign.
        name: name of the strategy's stage, so that two stages of one campaign have different streams.
    """

    def __init__(self, seed: int, name: str) -> None:
        self._rng = np.random.default_rng(np.random.SeedSequence([seed, *name.encode()]))
        self._given: set[int] = set()

    def next(self) -> int:
        """Return a seed that this stream has not returned before."""
        while (seed := int(self._rng.integers(2**31))) in self._given:
            pass
        self._given.add(seed)
        return seed

    @property
    def rng(self) -> np.random.Generator:
        """Random generator for other random choices."""
        return self._rng


class OptimizerQueries:
    """Suggest requests, each with a function that handles its answer."""

    def __init__(self, seeds: SeedStream) -> None:
        self._seeds = seeds
        self._unissued: list[Suggest] = []
        self._then: dict[Suggest, Callable[[Suggestion], None]] = {}

    def put(self, query: SuggestionQuery, purpose: str, then: Callable[[Suggestion], None]) -> None:
        """Queue a query and draw its seed."""
        request = Suggest(replace(query, seed=self._seeds.next()), purpose)
        self._unissued.append(request)
        self._then[request] = then

    def issue(self) -> list[Suggest]:
        """Return the queries that have not been issued yet."""
        issued, self._unissued = self._unissued, []
        return issued

    @property
    def out(self) -> bool:
        """Whether an answer is pending."""
        return bool(self._then)

    def answer(self, request: Suggest, outcome: Outcome) -> None:
        """Pass an answer to the continuation of its request.

        Raises:
            ValueError: the request was not made or has been answered already.
            LearningError: the optimiser returned no suggestion, so that there is no next point to try.
        """
        then = self._then.pop(request, None)
        if then is None:
            raise ValueError(f"this query was not made, or has been answered already (purpose {request.purpose!r})")
        if not isinstance(outcome, Suggested):
            reason = outcome.reason if isinstance(outcome, Failed) else f"unexpected outcome {type(outcome).__name__}"
            raise LearningError(f"the optimiser has no answer to {request.purpose!r}: {reason}")
        then(outcome.suggestion)
