"""Compare risk estimates from few simulations: a surrogate over executed actions, or raw measures of m1 draws.

Toy losses, cheap and with known exact risk, at the same number of simulations:

    python benchmarks/risk_measures.py [--seeds 5] [--simulations 48] [--toys cup cliff valleys] [--json]

`joint` is `orchestrator.strategies.deployment.d1`. `raw` computes the mean or CVaR of the m1 losses of each action,
under the same m1 draws for all actions, and regresses it over actions. `plain` is D1, which has no model of errors.
Regret: the true measure of the recommended action, minus the smallest possible value.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import asdict
from typing import Any
from unittest.mock import patch

import numpy as np
from machine import describe, pin, say, show
from numpy.typing import NDArray
from scipy.special import ndtri
from scipy.stats import qmc

from actors.optimizer.questions import Data, MinimumQuery, RegressionQuery, RiskQuery
from actors.optimizer.risk_measures import conditional_value_at_risk, tail_weights
from actors.optimizer.suggest import propose
from orchestrator.requests import Outcome, Request, Simulate, Simulated, Slots, Suggest, Suggested
from orchestrator.strategies.campaign_plan import DeploymentPlan
from orchestrator.strategies.deployment import d1
from orchestrator.strategies.deployment.action_evaluation import RiskMeasure, SeedMean
from orchestrator.strategies.deployment.d1 import D1Settings, OneShotPlanning
from orchestrator.strategies.deployment.deployment_result import Recommended
from orchestrator.strategies.deployment.disturbances import RiskSettings
from sim_engine.action import DEG, Action
from sim_engine.liquids import Liquid, SimulationParameters
from sim_engine.outcome import Loss, PourOutcome
from sim_engine.scene import PoseError, PoseNoise, Scene
from sim_engine.search_space import Axis, Space
from sim_engine.vessel.shapes import cylinder

Floats = NDArray[np.float64]

SPACE = Space((Axis("angular_velocity", 15 * DEG, 120 * DEG), Axis("x_offset", 0.08, 0.15)))
BEAKER, CUP = (cylinder(name, inner_radius=0.04, inner_height=0.1) for name in ("beaker", "cup"))
SCENE = Scene("toy", BEAKER, CUP, Liquid(mass=0.2), fixed={"height": 0.05})
ERRORS = PoseError(x=3e-3, y=2e-3, tilt=1 * DEG, speed_factor=0.05)
DEVIATIONS = PoseNoise(**asdict(ERRORS))


def cup(v: Floats, x: Floats, y: Floats, tilt: Floats) -> Floats:
    """A valley in which lateral errors and additional tilt only increase the loss."""
    depth = ((x - 0.62 - 0.15 * (v - 0.3)) / 0.16) ** 2 + ((v - 0.3) / 0.35) ** 2 + (y / 8e-3) ** 2
    return np.clip(1.0 - np.exp(-0.5 * depth) + 2.0 * np.maximum(tilt, 0.0), 0.0, 1.0)


def cliff(v: Floats, x: Floats, y: Floats, tilt: Floats) -> Floats:
    """A loss with its optimum directly next to a wall."""
    d = x - 0.45 - 0.2 * (v - 0.5)
    far = 0.02 + 0.25 * d + 0.3 * (v - 0.5) ** 2
    return np.clip(np.where(d < 0.0, 0.9, far) + np.abs(tilt) + 4.0 * np.abs(y), 0.0, 1.0)


def valleys(v: Floats, x: Floats, y: Floats, tilt: Floats) -> Floats:
    """A narrow valley without spillage, and a broad one that always spills a little."""
    speed = ((v - 0.5) / 0.8) ** 2
    narrow = 1.0 - np.exp(-0.5 * (((x - 0.25) / 0.06) ** 2 + speed))
    broad = 1.0 - 0.95 * np.exp(-0.5 * (((x - 0.7) / 0.2) ** 2 + speed))
    return np.clip(np.minimum(narrow, broad) + np.abs(tilt) + 4.0 * np.abs(y), 0.0, 1.0)


TOYS: dict[str, Callable[[Floats, Floats, Floats, Floats], Floats]] = {"cup": cup, "cliff": cliff, "valleys": valleys}


class RawMeasure(RiskMeasure):
    """Observes, for each action, the measure of its m1 losses."""

    def simulations(self, action: Action, purpose: str) -> tuple[Simulate, ...]:
        return self._under(action, purpose, self._disturbances.draws(self._repeats))

    def _data(self, *, everything: bool = False) -> Data:
        data = Data()
        for trial in self._ledger.trials.counting(everything=everything):
            losses = [cost for cost in trial.costs.values() if cost is not None]
            data = data.added(trial.point, conditional_value_at_risk(losses, self._disturbances.settings.tail))
        return data

    def search(self, *, everything: bool = False, **parts: Any) -> MinimumQuery | RiskQuery:
        return SeedMean.search(self, everything=everything, **parts)

    def regression(self, **parts: Any) -> RegressionQuery | RiskQuery:
        return SeedMean.regression(self, **parts)


WAYS: dict[str, tuple[type[RiskMeasure] | None, int]] = {
    "joint, 2 each": (RiskMeasure, 2),
    "joint, 4 each": (RiskMeasure, 4),
    "raw, 4 each": (RawMeasure, 4),
    "plain, 2 each": (None, 2),
}
"""Evaluation under errors (None: without errors), and simulations per action."""


def answer(request: Request, toy: Callable[..., Floats]) -> Outcome:
    """Return the outcome of a request; simulations scatter by 1 % of the load and 5 % of the loss."""
    if isinstance(request, Suggest):
        return Suggested(propose(request.query))
    assert isinstance(request, Simulate)
    error, rng = request.pose_error or PoseError(), np.random.default_rng(request.seed)
    executed = {
        "angular_velocity": request.action.angular_velocity * error.speed_factor,
        "x_offset": request.action.x_offset + error.x,
    }
    v, x = (np.array([u]) for u in SPACE.encode(executed))
    loss = float(toy(v, x, np.array([error.y]), np.array([error.tilt]))[0])
    spilled = min(max(loss * (1.0 + 0.05 * rng.standard_normal()) + 0.01 * rng.standard_normal(), 0.0), 1.0)
    return Simulated(PourOutcome(1.0 - spilled, spilled, 0.0, 0.0, 0.0, 500, 0.007, 0.0, 1.0, 1, 0.0, request.seed))


def play(strategy: OneShotPlanning, toy: Callable[..., Floats]) -> Recommended:
    """Run a campaign until it finishes; return its recommendation."""
    waiting: list[Request] = []
    while not strategy.finished:
        waiting += strategy.ask(Slots(1 - sum(isinstance(one, Simulate) for one in waiting), 0))
        request = waiting.pop(0)
        strategy.tell(request, answer(request, toy))
    recommended = strategy.result().recommended
    assert recommended is not None, "nothing was learnt"
    return recommended


def truth(toy: Callable[..., Floats], level: float, places: Floats) -> Floats:
    """Return the measure at points (m, 2) of the unit cube, over 2048 draws: (m,)."""
    x, y, tilt, speed = np.clip(ndtri(qmc.Sobol(4, rng=np.random.default_rng(0)).random(2048)), -3.5, 3.5).T
    velocity = (15.0 + 105.0 * places[:, :1]) * (1.0 + ERRORS.speed_factor * speed)
    offset = places[:, 1:] + ERRORS.x * x / 0.07
    losses = toy((velocity - 15.0) / 105.0, offset, ERRORS.y * y, ERRORS.tilt * tilt)
    return np.asarray((tail_weights(losses, level) * losses).sum(axis=1))


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--simulations", type=int, default=48)
    parser.add_argument("--toys", nargs="+", choices=list(TOYS), default=list(TOYS))
    parser.add_argument("--json", action="store_true")
    asked = parser.parse_args()
    pin(None)
    grid = np.stack(np.meshgrid(np.linspace(0, 1, 61), np.linspace(0, 1, 61)), axis=-1).reshape(-1, 2)
    rows = []
    for name in asked.toys:
        for level in (0.0, 0.9):
            least = float(truth(TOYS[name], level, grid).min())
            risk = RiskSettings(measure="cvar" if level else "expected", level=level or None, pose_error=DEVIATIONS)
            for way, (measure, each) in WAYS.items():
                iterations = asked.simulations // each
                settings = D1Settings(pours=0, iterations=iterations, simulations_per_iteration=each)
                if measure is not None:
                    settings = settings.model_copy(update={"risk": risk})
                plan = DeploymentPlan(settings, (SCENE,), SPACE, Loss())
                with patch.object(d1, "RiskMeasure", measure):
                    strategies = [OneShotPlanning(plan, SCENE, SimulationParameters(), i) for i in range(asked.seeds)]
                chosen = [SPACE.encode(play(strategy, TOYS[name]).action_si) for strategy in strategies]
                regrets = truth(TOYS[name], level, np.array(chosen)) - least
                mean, error = float(regrets.mean()), float(regrets.std(ddof=1) / len(regrets) ** 0.5)
                rows.append({"toy": name, "measure": risk.measure, "way": way, "least": round(least, 3)})
                rows[-1] |= {"regret": round(mean, 3), "error": round(error, 3)}
                say(f"{name}, {risk.measure}, {way}: {mean:.3f} ± {error:.3f} above {least:.3f}")
    show({"seeds": asked.seeds, "rows": rows, "machine": describe()}, asked.json)


if __name__ == "__main__":
    main()
