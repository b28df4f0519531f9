"""`strategy`: what holds for every strategy, C1 to C4 and D1 to D3: whoever finishes first, whatever fails,
wherever it stops.
"""

from __future__ import annotations

import asyncio
import json
import math
import random
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from actors.optimizer.questions import Data, Suggestion, SuggestionQuery
from actors.optimizer.suggest import propose
from orchestrator.learning.calibration.continuous_calibration import ContinuousBayesianCalibration
from orchestrator.learning.calibration.pointwise_calibration import (
    BayesianCalibration,
    StratifiedSampling,
    UniformGrid,
)
from orchestrator.learning.calibration.pour_design import StratifiedDesign
from orchestrator.learning.campaign_plan import CampaignPlan
from orchestrator.learning.deployment.d1 import OneShotPlanning
from orchestrator.learning.deployment.d2 import RealOnly
from orchestrator.learning.deployment.d3 import Hybrid
from orchestrator.learning.deployment.objectives import Spilled
from orchestrator.learning.requests import Failed, Outcome, Pour, Poured, Request, Suggest
from orchestrator.learning.run_errors import LearningError
from orchestrator.records.codec import encode_result
from orchestrator.records.events import Event, RequestFinished
from orchestrator.runs.strategy_harness import CALIBRATION_ACTIONS, SCENE, THETA, StrategyHarness, failures, replay
from sim_engine.outcome import Loss, PourMeasurement
from sim_engine.search_space import Axis, Space
from tests.support import plans
from tests.support.hypothesis_examples import examples
from tests.support.plans import calibration_plan, deployment_plan
from tests.support.toy_campaign import SCENE as TOY
from tests.support.toy_campaign import SPACE, ToyLaboratory, logical_record, run_toy, slow_laboratory, toy_plan
from tests.support.toy_spillage import calibration_spill, narrow_cup, weighed

CALIBRATIONS: dict[str, tuple[Any, dict[str, Any]]] = {
    "C1": (UniformGrid, {"grid": {"particles": 2, "cohesion": 3}}),
    "C2": (StratifiedSampling, {"samples": 6}),
    "C3": (BayesianCalibration, {"iterations": 6, "initial_samples": 4}),
    "C4": (ContinuousBayesianCalibration, {"simulations": 12, "initial_samples": 6}),
}
DEPLOYMENTS: dict[str, tuple[Any, dict[str, Any]]] = {
    "D1": (OneShotPlanning, {"iterations": 6}),
    "D2": (RealOnly, {"pours": 5}),
    "D3": (Hybrid, {"pours": 3, "prior_simulations": 6, "simulations_per_pour": 2}),
    "D3, objective": (Hybrid, {"pours": 3, "prior_simulations": 6, "simulations_per_pour": 2, "objective": Spilled()}),
}
ALL = [*CALIBRATIONS, *DEPLOYMENTS]
"""Whose requests depend on outcomes alone."""


@cache
def measured() -> tuple[Any, ...]:
    design = StratifiedDesign((SCENE,), CALIBRATION_ACTIONS, 6, 1, 0)
    StrategyHarness(weighed).run(design)
    return design.measured


def make(name: str, seed: int) -> Any:
    if name in CALIBRATIONS:
        kind, changes = CALIBRATIONS[name]
        return kind(calibration_plan(strategy=name, **changes), measured(), seed)
    kind, changes = DEPLOYMENTS[name]
    return kind(deployment_plan(strategy=name[:2], **changes), SCENE, THETA, seed)


class Shuffled(StrategyHarness):
    """Simulations come back in any order."""

    def __init__(self, *arguments: Any, shuffle: int, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self._rng = random.Random(shuffle)

    def _next(self, waiting: list[Request]) -> Request:
        first = super()._next(waiting)
        return self._rng.choice([request for request in waiting if type(request) is type(first)])


def spill(name: str) -> Callable[..., float]:
    return calibration_spill if name in CALIBRATIONS else narrow_cup


@pytest.mark.parametrize("name", [pytest.param(name, marks=pytest.mark.slow if name == "C4" else ()) for name in ALL])
@settings(max_examples=examples(4), deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(seed=st.integers(0, 2**31), slots=st.integers(1, 7), shuffle=st.integers(0, 1000))
def test_the_order_in_which_simulations_return_changes_no_request(
    name: str, seed: int, slots: int, shuffle: int
) -> None:
    first = StrategyHarness(spill(name), slots=slots).run(make(name, seed))
    other = Shuffled(spill(name), slots=slots, shuffle=shuffle).run(make(name, seed))
    assert (other.simulations, other.pours) == (first.simulations, first.pours)
    assert [r.query for r in other.asked if isinstance(r, Suggest)] == [
        r.query for r in first.asked if isinstance(r, Suggest)
    ]
    assert replay(make(name, seed), first) == first.asked


@pytest.mark.parametrize("share", [0.0, 0.5])
@pytest.mark.parametrize("name", ["C3", *DEPLOYMENTS])
def test_no_more_requests_are_counted_than_in_total_and_a_limit_is_no_total(name: str, share: float) -> None:
    strategy, counts = make(name, 3), []

    class Counting(StrategyHarness):
        def _next(self, waiting: list[Request]) -> Request:
            counts.append(strategy.progress())
            return super()._next(waiting)

    refused = failures(share, 3)
    Counting(spill(name), slots=2, answer=refused).run(strategy)
    counts.append(strategy.progress())
    assert all(one.simulations <= one.of_simulations and one.pours <= one.of_pours for one in counts)
    if "D3" in name:
        assert all(one.limited for one in counts)
        assert str(counts[0]) == "0 of ≤3 pours · 0 of ≤12 simulations"
    elif share == 0.0:
        assert len({one.total for one in counts}) == 1


NAN = math.nan


@pytest.mark.slow
@pytest.mark.parametrize("name", ALL)
@settings(max_examples=examples(5), deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(seed=st.integers(0, 2**31), share=st.sampled_from([0.1, 0.5, 0.9, 1.0]))
def test_whatever_fails_every_question_has_numbers_and_the_end_is_an_answer_or_a_reason(
    name: str, seed: int, share: float
) -> None:
    strategy = make(name, seed)
    played, reason = StrategyHarness(spill(name), slots=3, answer=failures(share, seed), beside=20), ""
    try:
        played.run(strategy)
    except LearningError as error:
        reason = str(error)
    assert strategy.finished or (name in CALIBRATIONS and "gave no discrepancy" in reason)
    queries = [request.query for request in played.asked if isinstance(request, Suggest)]
    entered = [getattr(query, part, Data()) for query in queries for part in ("data", "simulated")]
    assert all(math.isfinite(cost) for data in entered for cost in data.costs)
    assert all(math.isfinite(u) for data in entered for point in data.points for u in point)
    assert all(0.0 <= u <= 1.0 for data in entered for point in data.points for u in point)
    json.dumps(encode_result(strategy.result()), allow_nan=False)


def test_designed_pours_and_scores_leave_out_what_is_no_number() -> None:
    def lost(request: Request) -> Outcome | None:
        return Poured(PourMeasurement(0.2, NAN, 0.0)) if isinstance(request, Pour) and request.number == 2 else None

    design = StratifiedDesign((SCENE,), CALIBRATION_ACTIONS, 4, 1, 0)
    StrategyHarness(weighed, answer=lost).run(design)
    assert len(design.measured) == 3
    assert "no numbers" in str(design.result().pours[1].given_up)


@pytest.mark.parametrize("wrong", [Poured(PourMeasurement(0.2, 0.15, 0.01)), Failed("pour_unknown", "declared lost")])
@pytest.mark.parametrize("name", ["D1", "D2", "D3", "D3, objective", "designed pours"])
def test_a_corrected_pour_leads_to_the_requests_of_one_that_was_told_rightly(name: str, wrong: Outcome) -> None:
    def played(*, corrected: bool) -> tuple[list[Request], dict[str, Any]]:
        designed = name == "designed pours"
        strategy = StratifiedDesign((SCENE,), CALIBRATION_ACTIONS, 4, 1, 0) if designed else make(name, 1)
        tell = strategy.tell

        def told_wrongly(request: Request, outcome: Outcome) -> None:
            tell(request, wrong if isinstance(request, Pour) else outcome)
            if isinstance(request, Pour):
                strategy.correct(request, outcome)
                with pytest.raises(ValueError, match="no outcome of this pour"):
                    strategy.correct(replace(request, number=request.number + 1), outcome)

        if corrected:
            strategy.tell = told_wrongly
        harness = StrategyHarness(weighed if designed else narrow_cup).run(strategy)
        return harness.asked, encode_result(strategy.result())

    assert played(corrected=True) == played(corrected=False)


# -- through scheduler and journal ---------------------------------------------------------------------------------

TOY_PARAMETERS = Space((Axis("cohesion", 0.0, 0.1), Axis("friction", 0.0, 0.5)))
GRID = {"grid": {"cohesion": 2, "friction": 2}}


class Optimizer:
    async def suggest(self, query: SuggestionQuery) -> Suggestion:
        return propose(query)


def campaign(directory: Path, name: str) -> CampaignPlan:
    if name in CALIBRATIONS:
        changes = GRID if name == "C1" else CALIBRATIONS[name][1]
        calibration = plans.calibration(
            name,
            scene=TOY,
            actions=SPACE,
            parameters=TOY_PARAMETERS,
            fixed_parameters={"particles": 700},
            pour_count=4,
            holdout=1,
            **changes,
        )
        return toy_plan(directory, calibration=calibration, deployment=None, on_unknown="repeat")
    values = {"pours": 3} | DEPLOYMENTS[name][1]
    deployment = plans.deployment(name[:2], scenes=(TOY,), actions=SPACE, loss=Loss(), **values)
    return toy_plan(directory, deployment=deployment, on_unknown="repeat")


class Stopper:
    """Pauses the run that it watches after so many outcomes."""

    def __init__(self, outcomes: int) -> None:
        self._left = outcomes

    def __call__(self, event: Event) -> None:
        if isinstance(event, RequestFinished) and not event.replayed:
            self._left -= 1
            if self._left == 0:
                next(t for t in asyncio.all_tasks() if t.get_coro().__name__ == "run_toy").cancel()  # type: ignore[union-attr]


@pytest.mark.slow
@pytest.mark.parametrize("name", ALL)
def test_an_interrupted_run_on_a_slow_laboratory_asks_for_what_an_undisturbed_one_does(
    name: str, tmp_path: Path
) -> None:
    def run(folder: str, laboratory: ToyLaboratory, **arguments: Any) -> None:
        laboratory.optimizer = Optimizer()  # type: ignore[assignment]
        plan = campaign(tmp_path, name)
        asyncio.run(run_toy(tmp_path / folder, laboratory, plan=plan, stages=None, **arguments))

    run("undisturbed", ToyLaboratory())
    expected = logical_record(tmp_path / "undisturbed")
    clock, resume = random.Random(1), False
    for outcomes in (3, 7):
        with pytest.raises(asyncio.CancelledError):
            run("run", slow_laboratory(0.004, clock), resume=resume, subscribers=[Stopper(outcomes)])
        resume = True
        assert logical_record(tmp_path / "run") == expected[: len(logical_record(tmp_path / "run"))]
    run("run", slow_laboratory(0.004, clock), resume=True)
    assert logical_record(tmp_path / "run") == expected
