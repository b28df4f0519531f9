"""Test on toy benches whether actively chosen calibration pours are worth twice as many stratified ones.

    python benchmarks/active_design.py [--seeds 20] [--first 1000] [--json]

The score is transfer to a new cup. A bench is a jet that lands in a receiver:

- its reach rises with speed and height and falls with friction;
- its width rises with speed;
- walls that repel liquid make the opening smaller;
- the receiver is offset from its nominal position.

Each seed draws a hidden θ, hidden nuisances, and a wave in the reach that no simulator θ can reproduce. Pours scatter.
Calibration pours into two receivers. Deployment pours into a third one and searches other dimensions.

Fixed before the first run and not changed since (seeds from 1000 on; lower seeds were used to develop the program):

    Primary question: is the transfer error of 4 active pours at most that of 8 stratified ones? The transfer error is
    the mean |r − r̂| over 64 evenly spread actions into the third receiver, without scatter; r̂ is the mean spillage of
    the toy simulator over the posterior's draws (C4, 40 simulations). The answer is yes if the mean over the seeds of
    the paired difference (active minus stratified) is not above 0; 95 % interval by bootstrap over seeds.
    Secondary question: the same comparison of 4 active with 4 stratified pours.

An active design spends 48 simulations on choosing pours; C4 reuses those in calibration's scenes (24). A stratified
design gives all 48 to C4 as additional simulations.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from machine import describe, pin, say, show
from players import play, simulated
from scipy.special import ndtr

from orchestrator.requests import Outcome, Pour, Poured, Request, Simulate, Simulated
from orchestrator.runs.stages import POURS, known_simulations
from orchestrator.strategies.calibration.action_prior import actions_of_prior
from orchestrator.strategies.calibration.active_design import ActivePours
from orchestrator.strategies.calibration.continuous_calibration import C4Settings, ContinuousBayesianCalibration
from orchestrator.strategies.calibration.pour_design import DesignedPours
from orchestrator.strategies.campaign_plan import CalibrationPlan, DeploymentPlan
from orchestrator.strategies.deployment.d2 import D2Settings
from orchestrator.strategies.strategy import Strategy
from sim_engine.action import DEG, Action
from sim_engine.liquids import Liquid, SimulationParameters
from sim_engine.outcome import Loss, PourMeasurement
from sim_engine.scene import Scene
from sim_engine.search_space import Axis, Space
from sim_engine.vessel.shapes import cylinder

SPEED, OFFSET = Axis("angular_velocity", 15 * DEG, 120 * DEG), Axis("x_offset", 0.09, 0.15)
HEIGHT = Axis("height", 0.05, 0.11)
SEARCHED = Space((Axis("receiver_x", -0.012, 0.012), Axis("friction", 0.0, 0.3), Axis("wall_distance", 0.4, 1.5)))
RADII = {"tumbler": 0.026, "mug": 0.034, "narrow": 0.020}
CHOOSING, CALIBRATING = 48, 40
ACTIVE, STRATIFIED = (4,), (4, 8)


def scene(receiver: str) -> Scene:
    """Return a scene with one of the receivers."""
    glass = cylinder(receiver, inner_radius=RADII[receiver], inner_height=0.1)
    beaker = cylinder("beaker", inner_radius=0.04, inner_height=0.1)
    fixed: dict[str, float | None] = {"max_angle": 120 * DEG, "height": 0.08}
    return Scene(f"to-{receiver}", beaker, glass, Liquid(mass=0.2), fixed={} if receiver != "narrow" else fixed)


CALIBRATED = tuple(replace(scene(name), fixed={"max_angle": 120 * DEG}) for name in ("tumbler", "mug"))
DEPLOYED = scene("narrow")


def spilled(scene: Scene, action: Action, theta: SimulationParameters, wave: tuple[float, float] = (0.0, 0.0)) -> float:
    """Return the share of a jet that lands outside the opening."""
    speed = (action.angular_velocity / DEG - 15) / 105
    fall = action.height / 0.08
    reach = 0.095 + (0.035 - 0.06 * theta.friction) * speed * np.sqrt(fall) + wave[0] * np.sin(4.0 * speed + wave[1])
    width = 0.006 * (1.0 + 0.8 * speed) * np.sqrt(fall)
    opening = RADII[scene.receiver.name] - 0.005 * (theta.wall_distance - 0.4)
    past = action.x_offset + theta.receiver_x - reach
    return float(1.0 - (ndtr((opening - past) / width) - ndtr((-opening - past) / width)))


class Bench:
    """A bench with hidden ground truth, and its simulator."""

    def __init__(self, seed: int) -> None:
        rng = np.random.default_rng([seed, 15])
        self.truth = SimulationParameters.from_values(SEARCHED.decode(rng.uniform(0.1, 0.9, SEARCHED.dimension)))
        self.wave = (0.002, float(rng.uniform(0.0, 2.0 * np.pi)))
        self._scenes = {one.name: one for one in (*CALIBRATED, DEPLOYED)}

    def real(self, name: str, action: Action) -> float:
        """Return the bench's mean spillage."""
        return spilled(self._scenes[name], action, self.truth, self.wave)

    def play(self, strategy: Strategy) -> None:
        """Run a strategy until it finishes."""
        play(strategy, self._answer, pours_last=False)

    def _answer(self, request: Request) -> Outcome:
        assert isinstance(request, Simulate | Pour)
        chance = float(np.random.default_rng(request.seed).standard_normal())
        if isinstance(request, Pour):
            mean = self.real(request.scene, request.action)
            weighed = min(max(mean + (0.005 + 0.06 * mean * (1.0 - mean)) * chance, 0.0), 1.0)
            return Poured(PourMeasurement(0.2, 0.2 * weighed, 0.0))
        mean = spilled(self._scenes[request.scene], request.action, request.parameters)
        return Simulated(simulated(mean + 0.01 * chance, request.seed))


def plan_of(pours: int, simulations: int) -> CalibrationPlan:
    """Return a calibration plan with this number of pours."""
    return CalibrationPlan(
        settings=C4Settings(simulations=simulations),
        scene=CALIBRATED[0],
        further=CALIBRATED[1:],
        actions=Space((SPEED, OFFSET, HEIGHT)),
        parameters=SEARCHED,
        fixed_parameters={},
        pour_count=pours,
        design="active",
        design_simulations=CHOOSING,
    )


def transfer_error(bench: Bench, design: DesignedPours, simulations: int, seed: int) -> float:
    """Calibrate on a design's pours; return mean |r − r̂| over the deployed actions."""
    plan = plan_of(len(design.measured), simulations)
    plan = replace(plan, known=known_simulations(plan, {POURS: design.result()}))
    strategy = ContinuousBayesianCalibration(plan, design.measured, seed)
    bench.play(strategy)
    found = strategy.result().found
    assert found is not None
    assert found.posterior is not None
    thetas = [SimulationParameters.from_values(row) for row in found.posterior.thetas]
    errors = []
    for point in actions_of_prior(DEPLOYMENT.actions, 64, 5):
        action = DEPLOYED.action(DEPLOYMENT.actions.decode(point))
        expected = float(np.mean([spilled(DEPLOYED, action, theta) for theta in thetas]))
        errors.append(abs(bench.real(DEPLOYED.name, action) - expected))
    return float(np.mean(errors))


DEPLOYMENT = DeploymentPlan(D2Settings(pours=1), (DEPLOYED,), Space((SPEED, OFFSET)), Loss())


def seed_of_all(seed: int) -> dict[str, float]:
    """Return the transfer errors of all designs on one bench."""
    bench, found = Bench(seed), {}
    for count in ACTIVE:
        active = ActivePours(plan_of(count, CALIBRATING), DEPLOYMENT, seed)
        bench.play(active)
        found[f"active {count}"] = transfer_error(bench, active, CALIBRATING, seed)
    for count in STRATIFIED:
        plan = plan_of(count, CALIBRATING)
        even = DesignedPours(plan.scenes, plan.actions, count, 0, seed)
        bench.play(even)
        found[f"stratified {count}"] = transfer_error(bench, even, CALIBRATING + CHOOSING, seed)
    return found


def interval(values: Sequence[float]) -> tuple[float, float, float]:
    """Return the mean and a 95 % interval by bootstrap."""
    rng, given = np.random.default_rng(0), np.array(values)
    means = given[rng.integers(0, len(given), (4000, len(given)))].mean(axis=1)
    low, high = np.quantile(means, [0.025, 0.975])
    return float(given.mean()), float(low), float(high)


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--first", type=int, default=1000)
    parser.add_argument("--json", action="store_true")
    asked = parser.parse_args()
    pin(None)
    rows: list[dict[str, float]] = []
    for seed in range(asked.first, asked.first + asked.seeds):
        rows.append(seed_of_all(seed))
        say(f"seed {seed}: " + ", ".join(f"{name} {value:.4f}" for name, value in rows[-1].items()))
    results: dict[str, Any] = {name: interval([row[name] for row in rows]) for name in rows[0]}
    for other in STRATIFIED:
        differences = [row[f"active {ACTIVE[0]}"] - row[f"stratified {other}"] for row in rows]
        results[f"active {ACTIVE[0]} less stratified {other}"] = interval(differences)
    if asked.json:
        show({"machine": describe(), "rows": rows, "results": results}, as_json=True)
        return
    for name, (mean, low, high) in results.items():
        print(f"{name:32} {mean:+.4f} ({low:+.4f} … {high:+.4f})")


if __name__ == "__main__":
    main()
