"""Strategies that only studies use.

- `SimulatedTable` makes simulations that many repetitions score; `AnsweredByTable` answers another strategy from them.
- `FinalPour` repeats the pour that a deployment recommends.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Sequence
from typing import Literal

from orchestrator.learning.deployment.costing import Costing
from orchestrator.learning.requests import Decision, Failed, Outcome, Poured, Request, Simulate, Simulated, Slots
from orchestrator.learning.single_action import OnePour
from orchestrator.learning.stage_result import StageResult
from orchestrator.learning.strategy import Progress, Strategy, is_sound
from orchestrator.learning.trials import SeedStream
from sim_engine.action import Action
from sim_engine.liquids import SimulationParameters

Key = tuple[tuple[tuple[str, float], ...], tuple[tuple[str, float | None], ...]]


class Tabled(StageResult):
    """Simulations that the repetitions of a study share; their outcomes are in the journal of their run."""

    kind: Literal["table"] = "table"

    simulations: int
    """Number of simulations with an answer."""


class FinalResult(StageResult):
    """A pour of the action that a deployment recommends, with a seed that was not used for its selection."""

    kind: Literal["final"] = "final"

    action_si: dict[str, float | None] | None
    """All dimensions [SI]; None if nothing was recommended."""

    loss: float
    """Loss in its own unit; the worst loss if nothing was weighed."""

    spillage: float | None
    """r = spilled / poured; None below 5 % poured, and if nothing was weighed."""

    made: bool
    """Whether the action was poured and weighed."""

    reason: str
    """Reason why it was not made, or that almost nothing was poured."""


class SimulatedTable:
    """Simulate every θ at every action once. An action has the same seed under every θ, as in C1."""

    def __init__(
        self, scene: str, actions: Sequence[Action], thetas: Sequence[SimulationParameters], seed: int
    ) -> None:
        seeds = SeedStream(seed, "table")
        each = [(action, seeds.next()) for action in actions]
        self._answered = 0
        self._total = len(actions) * len(thetas)
        self._unissued = deque(Simulate(scene, action, theta, s, "table") for theta in thetas for action, s in each)
        self._open: list[Simulate] = []
        self.decisions: list[Decision] = [Decision(f"{len(thetas)} θ at {len(actions)} actions, {self._total} in all")]

    @property
    def finished(self) -> bool:
        """Every simulation has been answered."""
        return not self._unissued and not self._open

    def ask(self, slots: Slots) -> list[Request]:
        """Return the next simulations."""
        requests = [self._unissued.popleft() for _ in range(min(slots.simulations, len(self._unissued)))]
        self._open += requests
        return list(requests)

    def tell(self, request: Request, outcome: Outcome) -> None:
        """Record the outcome of a simulation. Raises ValueError if it was not requested."""
        if not isinstance(request, Simulate) or request not in self._open:
            raise ValueError(f"this simulation was not asked for: {request}")
        self._open.remove(request)
        self._answered += 1

    def progress(self) -> Progress:
        """Simulations answered, and their total number."""
        return Progress(self._answered, self._total)

    def result(self) -> Tabled:
        """Number of simulations answered."""
        return Tabled(simulations=self._answered)


class AnsweredByTable:
    """Wraps a strategy and answers its simulations from a table; only its other requests reach the laboratory."""

    def __init__(self, inner: Strategy, table: Iterable[tuple[Simulate, Outcome]]) -> None:
        """Wrap a strategy.

        Args:
            inner: any strategy that simulates only at the θ and actions of the table.
            table: requests of a `SimulatedTable` and their outcomes.
        """
        self._inner = inner
        self._known = {_key(request): outcome for request, outcome in table}

    @property
    def finished(self) -> bool:
        """Whether the strategy is finished."""
        return self._inner.finished

    @property
    def decisions(self) -> list[Decision]:
        """Decisions of the strategy."""
        return list(getattr(self._inner, "decisions", ()))

    def ask(self, slots: Slots) -> list[Request]:
        """Requests of the strategy other than simulations."""
        others: list[Request] = []
        while not self._inner.finished:
            requests = self._inner.ask(slots)
            simulations = [request for request in requests if isinstance(request, Simulate)]
            others += [request for request in requests if not isinstance(request, Simulate)]
            for request in simulations:
                self._inner.tell(request, self._answer(request))
            if not simulations:
                break
        return others

    def tell(self, request: Request, outcome: Outcome) -> None:
        """Pass the outcome to the strategy."""
        self._inner.tell(request, outcome)

    def progress(self) -> Progress:
        """Progress of the strategy."""
        return self._inner.progress()

    def result(self) -> StageResult:
        """Result of the strategy."""
        return self._inner.result()

    def _answer(self, request: Simulate) -> Outcome:
        match outcome := self._known.get(_key(request)):
            case None:
                raise ValueError(f"the table has no simulation of {request.parameters} at {request.action}")
            case Simulated(result) if result.invalid is None and is_sound(result.fractions):
                return outcome
        return Failed("simulation", getattr(outcome, "reason", "") or "invalid outcome")


class FinalPour:
    """Repeat the pour that a deployment recommends, with a seed that was not used for its selection.

    The smallest of several measured losses is biased low, and a single pour of another strategy has no such bias. Pours
    of recommended actions are comparable.

    An action that is impossible or fails has the worst loss and counts as all spilled. The same holds for a pour with
    almost no flow, and for a deployment without a recommendation. In a study, the strategies of a repetition share the
    seed.
    """

    def __init__(self, costing: Costing, action: Action | None, seed: int) -> None:
        """Plan the pour.

        Args:
            costing: scene and loss of the deployment.
            action: recommended action; with None, nothing is poured.
        """
        self._costing = costing
        self._action = action
        self._pour = None if action is None else OnePour(costing.scene, action, seed)
        self._made: FinalResult | None = None if action is not None else self._lost("nothing was recommended")
        self.decisions: list[Decision] = [] if self._pour is None else self._pour.decisions

    @property
    def finished(self) -> bool:
        """Whether the pour has been made or has failed."""
        return self._made is not None

    def ask(self, slots: Slots) -> list[Request]:
        """Return the pour, once."""
        return [] if self._pour is None else self._pour.ask(slots)

    def tell(self, request: Request, outcome: Outcome) -> None:
        """Record the outcome. Raises ValueError if the pour was not requested."""
        if self._pour is None or self._action is None:
            raise ValueError(f"this pour was not asked for: {request}")
        self._pour.tell(request, outcome)
        match outcome:
            case Poured(measurement) if is_sound(measurement.fractions):
                loss = self._costing.poured(measurement, self._action)
                spillage = measurement.fractions.spillage
                self._made = FinalResult(
                    action_si=self._action.values(),
                    loss=loss,
                    spillage=spillage,
                    made=True,
                    reason="" if spillage is not None else "hardly anything was poured",
                )
            case Poured():
                self._made = self._lost("weighing: the balance gave no numbers")
            case Failed(kind, reason):
                self._made = self._lost(f"{kind}: {reason}")

    def progress(self) -> Progress:
        """Pours done, and their total number."""
        return Progress(pours=int(self.finished), of_pours=1)

    def result(self) -> FinalResult:
        """The outcome; until there is one, the result of a lost pour."""
        return self._lost("it has not been poured yet") if self._made is None else self._made

    def _lost(self, reason: str) -> FinalResult:
        action = None if self._action is None else self._action.values()
        return FinalResult(action_si=action, loss=self._costing.worst, spillage=None, made=False, reason=reason)


def _key(request: Simulate) -> Key:
    return tuple(sorted(request.parameters.model_dump().items())), tuple(sorted(request.action.values().items()))
