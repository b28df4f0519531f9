"""`strategy`: what holds for every strategy in two, four and six dimensions, with integer and logarithmic axes
among them.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest

from actors.optimizer.questions import Data, SpaceFillingQuery
from orchestrator.learning.calibration.continuous_calibration import ContinuousBayesianCalibration
from orchestrator.learning.calibration.pointwise_calibration import (
    BayesianCalibration,
    StratifiedSampling,
    UniformGrid,
)
from orchestrator.learning.calibration.pour_design import StratifiedDesign
from orchestrator.learning.campaign_plan import CalibrationPlan, DeploymentPlan, MeasuredPour
from orchestrator.learning.deployment.d1 import OneShotPlanning
from orchestrator.learning.deployment.d2 import RealOnly
from orchestrator.learning.deployment.d3 import Hybrid
from orchestrator.learning.requests import Failed, Outcome, Pour, Poured, Request, Simulate, Simulated, Suggest
from orchestrator.runs.strategy_harness import SCENE, THETA, StrategyHarness, outcome_of, replay
from sim_engine.action import DEG, Action
from sim_engine.liquids import SimulationParameters
from sim_engine.outcome import PourMeasurement
from sim_engine.search_space import Axis, Space
from tests.orchestrator.learning.test_strategy_properties import Shuffled
from tests.support.plans import calibration_plan, deployment_plan

ACTIONS = (
    Axis("angular_velocity", 15 * DEG, 120 * DEG, "log"),
    Axis("x_offset", 0.08, 0.15),
    Axis("max_angle", 70 * DEG, 125 * DEG),
    Axis("y_offset", -0.02, 0.02),
    Axis("angular_acceleration", 100 * DEG, 900 * DEG, "log"),
    Axis("hold_time", 0.2, 3.0),
)
PARAMETERS = (
    Axis("particles", 300, 4000, "log", integer=True),
    Axis("cohesion", 0.0, 0.1),
    Axis("xsph_rate", 0.5, 10.0, "log"),
    Axis("friction", 0.0, 0.5),
    Axis("wall_distance", 0.4, 1.5),
    Axis("rim_correction", 0.0, 1.0),
)
NAMES = ("C1", "C2", "C3", "C4", "D1", "D2", "D3")
KINDS: dict[str, Any] = {
    "C1": UniformGrid,
    "C2": StratifiedSampling,
    "C3": BayesianCalibration,
    "C4": ContinuousBayesianCalibration,
    "D1": OneShotPlanning,
    "D2": RealOnly,
    "D3": Hybrid,
}
NAN = math.nan
NEAREST = 0.105
"""x_offset [m] below which the cups touch: a third of the box."""


def spill(action: Action, theta: SimulationParameters, rng: np.random.Generator) -> float:
    """Least in the middle of the box of actions, and rising with friction and particles; noisy."""
    unit = Space(ACTIONS).encode({axis.name: _value(action, axis) for axis in ACTIONS})
    away = float(np.sqrt(np.mean((unit - 0.5) ** 2)))
    liquid = 0.3 * theta.friction + 0.1 * math.log(theta.particles / 300)
    return 0.05 + 1.2 * away + liquid + 0.01 * float(rng.standard_normal())


def _value(action: Action, axis: Axis) -> float:
    value = getattr(action, axis.name)
    return axis.decode(0.5) if value is None else float(value)


def bad_luck(request: Request) -> Outcome | None:
    """What comes of a request that is refused or fails: by its action and its seed, whenever it is answered."""
    if isinstance(request, Suggest):
        return None
    assert isinstance(request, Simulate | Pour)
    if request.purpose != "calibrate" and _touches(request.action):
        return Failed("invalid_action", "cups touch")
    theta = request.parameters if isinstance(request, Simulate) else THETA
    luck = int(np.random.default_rng([request.seed, theta.particles]).integers(12))
    if isinstance(request, Pour):
        if luck == 0:
            return Poured(PourMeasurement(0.2, NAN, 0.0))
        return Failed("pour_failed", "spilled by hand") if luck == 1 else None
    fates: list[Outcome] = [
        Failed("simulation", "diverged"),
        Simulated(outcome_of(NAN)),
        Simulated(replace(outcome_of(0.9), invalid="escaped 1.2 %")),
        Simulated(outcome_of(0.3, retained=NAN)),
    ]
    return fates[luck] if luck < len(fates) else None


def _touches(action: Action) -> bool:
    assert action.x_offset is not None
    return action.x_offset < NEAREST


@cache
def measured(dimension: int) -> tuple[MeasuredPour, ...]:
    design = StratifiedDesign((SCENE,), Space(ACTIONS[:dimension]), 6, 1, 0)
    StrategyHarness(spill).run(design)
    return design.measured


def make(name: str, dimension: int) -> Any:
    actions, parameters = Space(ACTIONS[:dimension]), Space(PARAMETERS[:dimension])
    if name[0] == "D":
        deployment: DeploymentPlan = deployment_plan(
            strategy=name,
            actions=actions,
            pours=4,
            iterations=6,
            prior_simulations=7,
            simulations_per_pour=1,
            model="residual",
        )
        return KINDS[name](deployment, SCENE, THETA, 5)
    grid = {parameter: 2 if i < 3 else 1 for i, parameter in enumerate(parameters.names)}
    budgets = {"C1": {"grid": grid}, "C2": {"samples": 6}, "C3": {"iterations": 6}, "C4": {"simulations": 12}}
    calibration: CalibrationPlan = calibration_plan(
        strategy=name, actions=actions, parameters=parameters, fixed_parameters={}, initial_samples=4, **budgets[name]
    )
    return KINDS[name](calibration, measured(dimension), 5)


def played(
    name: str, dimension: int, play: Callable[..., StrategyHarness] = StrategyHarness, **options: Any
) -> StrategyHarness:
    return play(spill, answer=bad_luck, slots=3, **options).run(make(name, dimension))


def questions(play: StrategyHarness) -> list[Any]:
    return [request.query for request in play.asked if isinstance(request, Suggest)]


CASES = [
    pytest.param(name, dimension, id=f"{name}-{dimension}", marks=[pytest.mark.slow] if dimension == 4 else [])
    for name in NAMES
    for dimension in (2, 4, 6)
]


@pytest.mark.slow
@pytest.mark.parametrize(("name", "dimension"), CASES)
def test_proposals_keep_to_the_box_and_fits_see_only_what_was_measured(name: str, dimension: int) -> None:
    play = played(name, dimension)
    actions, parameters = Space(ACTIONS[:dimension]), Space(PARAMETERS[:dimension])
    assert play.simulations or play.pours
    for request in (*play.simulations, *play.pours):
        assert actions.contains({n: getattr(request.action, n) for n in actions.names})
        if isinstance(request, Simulate) and name[0] == "C":
            values = {n: float(getattr(request.parameters, n)) for n in parameters.names}
            assert parameters.contains(values)
            assert values["particles"] == round(values["particles"])
    measured_costs = {round(cost, 9) for cost in _costs(name, play)}
    for question in questions(play):
        if isinstance(question, SpaceFillingQuery):
            continue
        data, simulated = question.data, getattr(question, "simulated", Data())
        assert all(math.isfinite(cost) for cost in (*data.costs, *simulated.costs))
        if name[0] == "D":
            assert {round(cost, 9) for cost in (*data.costs, *simulated.costs)} <= measured_costs
            near = [actions.decode(point)["x_offset"] for point in (*data.points, *simulated.points)]
            assert all(x >= NEAREST for x in near)
    if name[0] == "D":
        refused = sum(isinstance(o, Failed) and o.kind == "invalid_action" for _, o in play.told)
        told = max(len(question.infeasible) + len(question.refused) for question in questions(play))
        assert told > 0 if refused else told == 0
        assert refused <= 14


def _costs(name: str, play: StrategyHarness) -> list[float]:
    """Losses that may enter a fit: of what went well, and the worst for pours that failed."""
    known = [1.0]
    waiting: dict[Any, list[float]] = {}
    for request, outcome in play.told:
        if isinstance(outcome, Poured) and math.isfinite(outcome.measurement.spilled):
            known.append(outcome.measurement.fractions.spilled)
        if isinstance(outcome, Simulated) and outcome.outcome.invalid is None and isinstance(request, Simulate):
            fractions = outcome.outcome.fractions
            if math.isfinite(fractions.spilled) and fractions.spillage is not None:
                waiting.setdefault(request.action, []).append(fractions.spilled)
    known += [float(np.mean(costs)) for costs in waiting.values()]
    return [*known, *(cost for costs in waiting.values() for cost in costs)]


@pytest.mark.slow
@pytest.mark.parametrize(("name", "dimension"), CASES)
def test_whoever_returns_first_and_when_replayed_the_requests_are_the_same(name: str, dimension: int) -> None:
    first = played(name, dimension)
    other = played(name, dimension, Shuffled, shuffle=dimension)
    assert (other.simulations, other.pours) == (first.simulations, first.pours)
    assert questions(other) == questions(first)
    assert replay(make(name, dimension), first) == first.asked
