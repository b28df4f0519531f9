"""`deployment_ledger`: actions that can't be made: vessels that touch, places out of the arm's reach."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from actors.optimizer.questions import Data
from orchestrator.campaigns.campaign_checks import touch
from orchestrator.learning.deployment.d1 import OneShotPlanning
from orchestrator.learning.deployment.d2 import RealOnly
from orchestrator.learning.deployment.d3 import Hybrid
from orchestrator.learning.deployment.deployment_ledger import MAX_REFUSED
from orchestrator.learning.requests import Failed, Outcome, Pour, Request, Simulate, Suggest
from orchestrator.records.codec import encode_result
from orchestrator.runs.strategy_harness import ACTIONS, SCENE, THETA, StrategyHarness
from sim_engine.action import Action
from sim_engine.liquids import SimulationParameters
from sim_engine.vessel.vessel import build_vessel
from tests.support.plans import deployment_plan, unit
from tests.support.toy_spillage import narrow_cup

STRATEGIES: dict[str, Any] = {"D1": OneShotPlanning, "D2": RealOnly, "D3": Hybrid}
NEAREST = 0.122
"""x_offset [m] below which the toy cups touch: just short of where the narrow cup spills least (0.123 m)."""


def make(name: str, seed: int = 0, **changes: Any) -> Any:
    plan = deployment_plan(strategy=name, **changes)
    return STRATEGIES[name](plan, SCENE, THETA, seed)


def touching(action: Action, theta: SimulationParameters, rng: np.random.Generator) -> float:
    assert action.x_offset is not None
    if action.x_offset < NEAREST:
        raise ValueError("cups touch")
    return narrow_cup(action, theta, rng)


def questions(played: StrategyHarness) -> list[Any]:
    return [request.query for request in played.asked if isinstance(request, Suggest)]


@pytest.mark.parametrize("name", STRATEGIES)
def test_a_refusal_has_no_cost_takes_no_budget_and_its_place_is_told(name: str) -> None:
    strategy = make(name, 1, pours=5, prior_simulations=12, iterations=8)
    played = StrategyHarness(touching).run(strategy)
    result = strategy.result()
    refused = [unit(r.action) for r, o in played.told if isinstance(o, Failed) and not isinstance(r, Suggest)]
    assert refused
    last = questions(played)[-1]
    told = np.array([*last.infeasible, *last.refused])
    assert len({tuple(np.round(place, 9)) for place in refused}) == len({tuple(np.round(place, 9)) for place in told})
    data = [getattr(q, name, Data()) for q in questions(played) for name in ("data", "simulated")]
    entered = [ACTIONS.decode(point)["x_offset"] for one in data for point in one.points]
    assert not [x for x in entered if x < NEAREST]
    made = [r for r, o in played.told if isinstance(r, Simulate) and not isinstance(o, Failed)]
    assert sum(r.purpose != "refine" for r in made) == {"D1": 16, "D2": 0, "D3": 12}[name]
    assert len(played.real_spills) == {"D1": 1, "D2": 5, "D3": 5}[name]
    assert (strategy.progress().simulations_left, strategy.progress().pours_left) == (0, 0)
    assert result.simulations_lost == 0
    assert {row.loss for row in result.pours if row.status == "refused"} <= {None}
    json.dumps(encode_result(result), allow_nan=False)


def out_of_reach(request: Request) -> Outcome | None:
    """The arm can't come as near as simulated vessels may."""
    if isinstance(request, Pour) and request.action.x_offset is not None and request.action.x_offset < NEAREST:
        return Failed("invalid_action", "the arm can't reach")
    return None


def test_what_only_the_arm_refuses_is_learnt_though_simulations_go_well_there() -> None:
    refused = []
    for seed in range(2):
        strategy = make("D3", seed, pours=4, prior_simulations=10, simulations_per_pour=1)
        played = StrategyHarness(narrow_cup, answer=out_of_reach).run(strategy)
        assert len(played.real_spills) == 4
        assert not questions(played)[-1].infeasible
        assert strategy.best_values["x_offset"] >= NEAREST
        refused.append(strategy.result().refused_pours)
    assert 0 < sum(refused) <= 12


def test_a_plan_that_the_arm_refuses_is_replaced_by_the_next_best_one() -> None:
    def refused_twice(request: Request) -> Outcome | None:
        nonlocal refused
        if not isinstance(request, Pour) or refused == 2:
            return None
        refused += 1
        return Failed("invalid_action", "the arm can't reach")

    refused, strategy = 0, make("D1", 2, pours=1, iterations=8)
    played = StrategyHarness(narrow_cup, answer=refused_twice).run(strategy)
    assert [row.status for row in strategy.result().pours] == ["refused", "refused", "weighed"]
    assert len({pour.action for pour in played.pours}) == 3
    assert [row.number for row in strategy.result().pours] == [pour.number for pour in played.pours] == [1, 2, 3]
    assert [d.text.split("  ")[0] for d in strategy.decisions if d.text.startswith("pour ")] == [
        *("pour 1/1", "pour 2 (1 of 1)", "pour 3 (1 of 1)"),
        *(d.text for d in strategy.decisions if d.text.startswith("pour 3: loss")),
    ]
    assert strategy.best_values == {
        name: pytest.approx(value) for name, value in strategy.result().pours[-1].action_si.items()
    }


@pytest.mark.parametrize("name", STRATEGIES)
def test_where_nothing_can_be_made_it_ends(name: str) -> None:
    def never(action: Action, theta: SimulationParameters, rng: np.random.Generator) -> float:
        raise ValueError("cups touch")

    strategy = make(name, pours=2, prior_simulations=5, iterations=4)
    played = StrategyHarness(never).run(strategy)
    assert strategy.finished
    assert strategy.best_values is None
    assert len(played.pours) <= MAX_REFUSED
    assert len(played.simulations) <= 2 * (MAX_REFUSED + 5)


@pytest.mark.slow
def test_real_vessels_that_touch_are_learnt_in_a_few_refusals() -> None:
    scene = replace(SCENE, fixed={"height": 0.0})
    vessels = build_vessel(scene.pourer), build_vessel(scene.receiver)
    spaces = deployment_plan(strategy="D2", pours=8)

    def spill(action: Action, theta: SimulationParameters, rng: np.random.Generator) -> float:
        if (contact := touch(scene, action, *vessels)) is not None:
            raise ValueError(contact)
        assert action.x_offset is not None
        return 8.0 * (action.x_offset - 0.08)  # the nearer the better, up to the boundary

    refusals = []
    for seed in range(2):
        strategy = RealOnly(spaces, scene, THETA, seed)
        played = StrategyHarness(spill).run(strategy)
        refusals.append(strategy.result().refused_pours)
        assert len(played.real_spills) == 8
    assert 0 < sum(refusals) <= 16  # type: ignore[operator]
