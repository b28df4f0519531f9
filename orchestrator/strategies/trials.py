"""Simulated trials in the order in which they were asked for, so that decisions don't depend on who finishes first.

Seeds that strategies hand out: one stream per strategy, no number twice.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field

import numpy as np

from actors.optimizer.questions import Data, Point
from orchestrator.requests import Simulate


@dataclass
class Trial:
    """One searched point and the simulations that judge it.

    Attributes:
        point: in the searched space's unit cube.
        requests: to be averaged over.
        costs: of each request: a number, None if it came to nothing; missing while its answer is out.
        context: further coordinates of the observation; see `SuggestProblem.context`.
        refused: some request was, as one that can't be made: it has no cost, and is not lost either.
    """

    point: Point
    requests: tuple[Simulate, ...]
    context: Point = ()
    costs: dict[int, float | None] = field(default_factory=dict)
    refused: bool = False

    @property
    def closed(self) -> bool:
        """All answers are in."""
        return len(self.costs) == len(self.requests)

    @property
    def cost(self) -> float | None:
        """Mean cost of the simulations that gave one; None if none did."""
        known = [cost for _, cost in sorted(self.costs.items()) if cost is not None]
        return sum(known) / len(known) if known else None


class Trials:
    """A window of trials: simulations run several at a time, their outcomes count in the order of asking.

    With `width` trials in flight, trial t is chosen from the outcomes of the trials up to t − width; later ones are
    pending even if they have been answered. So the requests of a seeded campaign depend on no stopwatch.
    """

    def __init__(self) -> None:
        self.width = 1
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
        """The next simulations to ask for, at most `limit`."""
        issued = []
        for _ in range(min(limit, len(self._unissued))):
            trial, index = self._unissued.popleft()
            request = self.all[trial].requests[index]
            self._open.setdefault(request, deque()).append((trial, index))
            issued.append(request)
        return issued

    def settle(self, request: Simulate, cost: float | None, *, refused: bool = False) -> Trial:
        """Enter what came of a simulation (None: nothing), or that it was refused.

        Raises:
            ValueError: it was not asked for, or has been answered already.
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
        """Nothing queued and nothing in flight."""
        return not self._unissued and not self._open

    @property
    def queued(self) -> bool:
        """Simulations wait to be asked for."""
        return bool(self._unissued)

    @property
    def waiting(self) -> int:
        """How many simulations wait to be asked for."""
        return len(self._unissued)

    def withdraw(self) -> None:
        """Forget the trials of which nothing has been asked for yet."""
        while self.all and len(self.all[-1].requests) == sum(t == len(self.all) - 1 for t, _ in self._unissued):
            for _ in self.all.pop().requests:
                self._unissued.pop()

    @property
    def ready(self) -> bool:
        """Everything that the choice of the next trial depends on has been answered."""
        return not self._unissued and all(trial.closed for trial in self.all[: self._horizon])

    @property
    def _horizon(self) -> int:
        return max(0, len(self.all) - self.width + 1)

    def counting(self, *, everything: bool = False) -> list[Trial]:
        """Closed trials that the next choice may use, in the order of asking; `everything`: all that are closed."""
        trials = self.all if everything else self.all[: self._horizon]
        return [trial for trial in trials if trial.closed]

    def data(self, *, everything: bool = False) -> Data:
        """Observations that the next choice may use; `everything`: all answers that are in."""
        observed = [(t, cost) for t in self.counting(everything=everything) if (cost := t.cost) is not None]
        return Data(tuple((*t.point, *t.context) for t, _ in observed), tuple(cost for _, cost in observed))

    def pending(self, *, everything: bool = False) -> tuple[Point, ...]:
        """Points whose answers are out, or don't count yet."""
        trials = self.all if everything else self.all[self._horizon :]
        return tuple(t.point for t in trials if not (everything and t.closed))

    @property
    def answered(self) -> int:
        """Simulations answered."""
        return sum(len(trial.costs) for trial in self.all)

    @property
    def lost_in_a_row(self) -> int:
        """How many of the latest trials that were answered came to nothing, one after the other."""
        count = 0
        for trial in reversed(self.all):
            if trial.closed:
                if trial.cost is not None:
                    break
                count += 1
        return count

    @property
    def lost(self) -> int:
        """Simulations that came to nothing, though they were not refused."""
        return sum(cost is None for trial in self.all if not trial.refused for cost in trial.costs.values())


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
