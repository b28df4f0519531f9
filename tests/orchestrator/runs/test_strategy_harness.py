"""`strategy_harness`: the harness that authors of strategies use: what it accepts, and what it finds."""

from __future__ import annotations

import itertools
from dataclasses import replace
from typing import Any, Literal

import pytest

from orchestrator.learning.deployment.d2 import RealOnly
from orchestrator.learning.requests import Outcome, Pour, Request, Simulate, Slots
from orchestrator.learning.stage_result import StageResult
from orchestrator.learning.strategy import Progress
from orchestrator.runs.strategy_harness import (
    ACTIONS,
    SCENE,
    THETA,
    StrategyHarness,
    check_strategy,
    replay,
)
from tests.support.plans import deployment_plan
from tests.support.toy_spillage import narrow_cup

CENTRE = SCENE.action(ACTIONS.decode([0.5, 0.5]))


class Nothing(StageResult):
    """A result without content."""

    kind: Literal["harness-nothing"] = "harness-nothing"


class Simulates:
    """Simulates one action five times."""

    def __init__(self) -> None:
        self.left, self.open = 5, 0

    @property
    def finished(self) -> bool:
        return self.left == 0 and self.open == 0

    def ask(self, slots: Slots) -> list[Request]:
        count = min(self.left, slots.simulations)
        requests: list[Request] = [self.request(self.left - k) for k in range(count)]
        self.left, self.open = self.left - count, self.open + count
        return requests

    def request(self, number: int) -> Simulate:
        return Simulate(SCENE.name, CENTRE, THETA, seed=number)

    def tell(self, request: Request, outcome: Outcome) -> None:
        self.open -= 1

    def progress(self) -> Progress:
        return Progress(5 - self.left, 5)

    def result(self) -> Any:
        return Nothing()


class AsksTooMuch(Simulates):
    """Asks for one simulation more than there are slots."""

    def ask(self, slots: Slots) -> list[Request]:
        return super().ask(replace(slots, simulations=slots.simulations + 1))


class PoursTwice(Simulates):
    """Asks for two pours at a time."""

    def ask(self, slots: Slots) -> list[Request]:
        return [Pour(SCENE.name, CENTRE, 1, 1), Pour(SCENE.name, CENTRE, 2, 2)] if self.left else []


class NeverEnds(Simulates):
    """Simulates for ever."""

    def ask(self, slots: Slots) -> list[Request]:
        self.left = 9
        return super().ask(slots)


class Stalls(Simulates):
    """Asks for nothing before it has finished."""

    def ask(self, slots: Slots) -> list[Request]:
        return []


class EndsEarly(Simulates):
    """Has finished before its last outcome."""

    @property
    def finished(self) -> bool:
        return self.left == 0


class Arbitrary(Simulates):
    """Draws its seeds from a generator that has no seed."""

    seeds = itertools.count()

    def request(self, number: int) -> Simulate:
        return replace(super().request(number), seed=next(self.seeds))


class FollowsTheFirst(Simulates):
    """Its next requests depend on which simulation returned last."""

    last = 0

    def tell(self, request: Request, outcome: Outcome) -> None:
        super().tell(request, outcome)
        self.last = getattr(request, "seed", 0)

    def request(self, number: int) -> Simulate:
        return replace(super().request(number), seed=number + 100 * self.last)


@pytest.mark.parametrize(
    ("cls", "message"),
    [
        (AsksTooMuch, "the strategy asks for 2 × Simulate; 1 slots are free"),
        (PoursTwice, "the strategy asks for 2 × Pour; 1 slots are free"),
        (NeverEnds, "has not finished after 5000 outcomes"),
        (Stalls, "asks for nothing, waits for nothing and has not finished"),
        (EndsEarly, r"reports that it has finished while \d requests are open, as Simulate"),
        (Arbitrary, "simulation 1 is .* but .* if the simulations return in another order"),
        (FollowsTheFirst, "with 3 slots simulation 4 is .* if the simulations return in another order"),
    ],
)
def test_a_strategy_that_cannot_be_run_or_resumed_is_found(cls: type[Simulates], message: str) -> None:
    with pytest.raises(AssertionError, match=message):
        check_strategy(cls, narrow_cup)


class ReportsNumbers(Simulates):
    """Its result is a number."""

    def result(self) -> Any:
        return 0.25


class Unnamed(StageResult):
    """A result whose kind is replaced after its declaration, so that no journal can be read back."""

    kind: Literal["harness-unnamed", "harness-other"] = "harness-unnamed"


class ReportsAnUnknownKind(Simulates):
    """Its result names a kind that is not declared."""

    def result(self) -> Any:
        return Unnamed(kind="harness-other")


@pytest.mark.parametrize(("cls", "name"), [(ReportsNumbers, "float"), (ReportsAnUnknownKind, "Unnamed")])
def test_a_result_that_no_journal_can_keep_is_found(cls: type[Simulates], name: str) -> None:
    with pytest.raises(AssertionError, match=f"the strategy's result, {name}, cannot be kept in a journal"):
        check_strategy(cls, narrow_cup)


def test_our_strategy_passes() -> None:
    check_strategy(lambda: RealOnly(deployment_plan(strategy="D2", pours=3), SCENE, THETA, 1), narrow_cup)


def test_a_harness_answers_with_the_functions_that_it_was_given() -> None:
    run = StrategyHarness(lambda action, theta, rng: 0.25).run(Simulates())
    assert [type(outcome).__name__ for _, outcome in run.told] == 5 * ["Simulated"]
    assert len(run.simulations) == 5
    assert run.pours == []


def test_a_replay_that_asks_for_something_else_names_both_requests() -> None:
    class Other(Simulates):
        def request(self, number: int) -> Simulate:
            return replace(super().request(number), seed=100 + number)

    run = StrategyHarness(narrow_cup).run(Simulates())
    with pytest.raises(AssertionError, match=r"asks for .*seed=1\d\d.*it asked for .*seed=5"):
        replay(
            type("Other", (Simulates,), {"request": lambda self, n: Simulate(SCENE.name, CENTRE, THETA, 100 + n)})(),
            run,
        )
