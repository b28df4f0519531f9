"""Measure the benefit of planning for execution errors: plain D1 and D1 under risk, evaluated under unseen errors.

Real simulations, few particles, one process:

    python benchmarks/risk.py [--plans 3] [--evaluations 40] [--iterations 12] [--per-iteration 4] [--particles 500]
                              [--receiver configs/vessels/narrow.yaml] [--json]

Each method plans `--plans` times with the same number of simulations. Each planned action is then simulated
`--evaluations` times with new seeds and new errors, which are the same for all methods. Intervals are 95 %, from
resampling the plans and the evaluations of each plan.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
from machine import describe, pin, say, show
from numpy.typing import NDArray

from actors.optimizer.suggest import propose
from orchestrator.config.file_loading import load_campaign, load_vessel
from orchestrator.requests import Failed, Outcome, Request, Simulate, Simulated, Slots, Suggest, Suggested
from orchestrator.strategies.campaign_plan import DeploymentPlan
from orchestrator.strategies.deployment.costing import Costing
from orchestrator.strategies.deployment.d1 import D1Settings, OneShotPlanning
from orchestrator.strategies.deployment.deployment_result import Recommended
from orchestrator.strategies.deployment.disturbances import RiskSettings
from sim_engine.action import DEG, described
from sim_engine.liquids import SimulationParameters
from sim_engine.scene import PoseError, PoseNoise, PourTask, Scene
from sim_engine.simulator import InvalidSceneError, PourSimulator

Floats = NDArray[np.float64]

ROOT = Path(__file__).resolve().parents[1]
ERRORS = PoseError(x=3e-3, y=3e-3, tilt=0.5 * DEG, speed_factor=0.02)
DEVIATIONS = PoseNoise(**asdict(ERRORS))
WAYS: dict[str, RiskSettings | None] = {
    "D1 as planned": None,
    "D1, expected": RiskSettings(pose_error=DEVIATIONS),
    "D1, CVaR 90 %": RiskSettings(measure="cvar", level=0.9, pose_error=DEVIATIONS),
}
RESAMPLED = 4000


class Bench:
    """One scene, evaluated by the simulator of this process."""

    def __init__(self, scene: Scene) -> None:
        self._scene, self._simulator = scene, PourSimulator()
        self.simulations = self.touched = 0
        self.seconds = 0.0

    def answer(self, request: Request) -> Outcome:
        """Return the outcome of a suggestion query or a simulation."""
        if isinstance(request, Suggest):
            suggestion = propose(request.query)
            self.seconds += suggestion.seconds
            return Suggested(suggestion)
        assert isinstance(request, Simulate)
        task = PourTask(self._scene, request.action, request.parameters, request.seed, pose_error=request.pose_error)
        self.simulations += 1
        try:
            outcome = self._simulator.simulate(task).outcome
        except InvalidSceneError as error:
            self.touched += 1
            return Failed("invalid_action", str(error))
        self.seconds += outcome.cpu_s
        if outcome.invalid is not None:
            return Failed("simulation", outcome.invalid)
        return Simulated(outcome)

    def plan(self, strategy: OneShotPlanning) -> Recommended:
        """Run a strategy until it finishes; return its recommendation."""
        waiting: list[Request] = []
        while not strategy.finished:
            waiting += strategy.ask(Slots(1 - sum(isinstance(one, Simulate) for one in waiting), 0))
            request = waiting.pop(0)
            strategy.tell(request, self.answer(request))
        recommended = strategy.result().recommended
        assert recommended is not None, "nothing was learnt"
        return recommended


def fresh_errors(count: int, seed: int) -> list[tuple[int, PoseError]]:
    """Return seeds and errors of the evaluations."""
    rng = np.random.default_rng([seed, 77])
    found = []
    for _ in range(count):
        x, y, tilt, speed = rng.standard_normal(4)
        error = PoseError(
            float(ERRORS.x * x), float(ERRORS.y * y), float(ERRORS.tilt * tilt), float(1 + ERRORS.speed_factor * speed)
        )
        found.append((int(rng.integers(2**31)), error))
    return found


def evaluated(
    bench: Bench, costing: Costing, values: dict[str, float], errors: Sequence[tuple[int, PoseError]]
) -> Floats:
    """Return losses of an action under errors, (count,), without failed simulations."""
    action, losses = costing.scene.action(dict(values)), []
    for seed, error in errors:
        outcome = bench.answer(Simulate(costing.scene.name, action, costing.parameters, seed, "judge", error))
        vector = costing.simulated(outcome, action)
        if vector is not None:
            losses.append(costing.total(vector))
    return np.array(losses)


def resampled(losses: Sequence[Floats], quantile: float | None, rng: np.random.Generator) -> Floats:
    """Return the mean or quantile of resampled plans and evaluations, (RESAMPLED,)."""
    found = []
    for _ in range(RESAMPLED):
        plans = rng.integers(0, len(losses), len(losses))
        drawn = np.concatenate([rng.choice(losses[i], len(losses[i])) for i in plans])
        found.append(drawn.mean() if quantile is None else np.quantile(drawn, quantile))
    return np.array(found)


def row_of(way: str, losses: Sequence[Floats]) -> dict[str, Any]:
    """Return mean, 90 % quantile and CVaR of all evaluations, in per cent, with intervals."""
    row: dict[str, Any] = {"way": way}
    every = np.concatenate(losses)
    for name, quantile in (("mean", None), ("q90", 0.9)):
        value = every.mean() if quantile is None else np.quantile(every, quantile)
        low, high = np.quantile(resampled(losses, quantile, np.random.default_rng(1)), [0.025, 0.975])
        row[name] = round(100 * float(value), 2)
        row[f"{name}_low"], row[f"{name}_high"] = round(100 * float(low), 2), round(100 * float(high), 2)
    row["evaluations"] = len(every)
    return row


def deployment(receiver: Path, particles: int) -> tuple[DeploymentPlan, Scene, SimulationParameters]:
    """Return the quickstart's deployment, with another receiver if given, as D1 without pours."""
    plan = load_campaign(ROOT / "configs/campaigns/quickstart.yaml")
    assert plan.deployment is not None
    vessel = load_vessel(receiver)
    scene = replace(plan.deployment.scenes[0], receiver=vessel, name=vessel.name)
    theta = plan.parameters.model_copy(update={"particles": particles})
    settings = D1Settings.like(plan.deployment.settings, pours=0)
    return replace(plan.deployment, settings=settings, scenes=(scene,)), scene, theta


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--plans", type=int, default=3)
    parser.add_argument("--evaluations", type=int, default=40)
    parser.add_argument("--iterations", type=int, default=12)
    parser.add_argument("--per-iteration", type=int, default=4)
    parser.add_argument("--particles", type=int, default=500)
    parser.add_argument("--receiver", type=Path, default=ROOT / "configs/vessels/narrow.yaml")
    parser.add_argument("--json", action="store_true")
    asked = parser.parse_args()
    pin(None)
    base, scene, theta = deployment(asked.receiver, asked.particles)
    base = base.with_settings(iterations=asked.iterations, simulations_per_iteration=asked.per_iteration)
    bench, costing = Bench(scene), Costing.of(base, scene, theta)
    rows, actions, every = [], [], {}
    for way, risk in WAYS.items():
        plan = base.with_settings(risk=risk)
        losses = []
        for seed in range(asked.plans):
            result = bench.plan(OneShotPlanning(plan, scene, theta, seed))
            losses.append(evaluated(bench, costing, result.action_si, fresh_errors(asked.evaluations, seed)))
            said = f"promised {100 * result.predicted_loss:.2f} %, came to {100 * losses[-1].mean():.2f} %"
            actions.append({"way": way, "seed": seed, "action": result.action, "promised": result.predicted_loss})
            say(f"{way}, plan {seed + 1}: {described(result.action_si)}; {said}")
        rows.append(row_of(way, losses))
        every[way] = [list(map(float, one)) for one in losses]
    totals = {"simulations": bench.simulations, "touched": bench.touched, "cpu_s": round(bench.seconds)}
    show({"rows": rows, "actions": actions, "losses": every, **totals, "machine": describe()}, asked.json)


if __name__ == "__main__":
    main()
