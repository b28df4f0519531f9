"""Measure the benefit of simulations during pours, the pool's load, and the arm's waiting time for decisions.

    python benchmarks/dyna.py [--worlds right half ...] [--problem spill2] [--arms fixed priced ...] [--seeds 30]
                              [--first 0] [--simulation 1.5] [--slots 2] [--pour 90] [--pours 15] [--prior 37]
                              [--model adaptive] [--json]

Toy worlds (`optimiser_problems.py`, with simulators of varying accuracy as in `hybrid_models.py`) run with the real
strategy, scheduler, journal and optimiser, in one process, on a clock that skips waits (`skipping_clock.py`). A
simulation takes `--simulation` seconds ± 20 %, one at a time on each of `--slots` simulators. A pour takes `--pour`
seconds. An optimiser query takes its CPU time.

    D2      pours only
    fixed   D3 with 37 simulations and 2 during each pour (the paper's form)
    priced  D3 with `simulations_per_pour: free`: simulations by their value; at most 37 before the first pour
    longer  as priced, with at most 200 before the first pour
    tireless  as priced, but the pool never rests
"""

from __future__ import annotations

import argparse
import asyncio
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from hybrid_models import SCATTER, WORLDS
from machine import describe, pin, say, show
from optimiser_problems import BY_NAME, Floats, Instance, Problem
from players import AXES, SCENE, interval, simulated, unit
from skipping_clock import SkippingLoop, run

from actors.interfaces import DoseTarget, ProgressCallback
from actors.laboratory_settings import LaboratorySettings
from actors.optimizer.questions import Suggestion, SuggestionQuery
from actors.optimizer.suggest import propose
from orchestrator.journal.events import DecisionMade, Event
from orchestrator.journal.run_record import POOL_RESTS, Occupancy
from orchestrator.runs.run_engine import run_campaign
from orchestrator.strategies.campaign_plan import CampaignPlan, DeploymentPlan, OutputSettings
from orchestrator.strategies.deployment.costing import CostSettings
from orchestrator.strategies.deployment.d2 import D2Settings
from orchestrator.strategies.deployment.d3 import D3Settings
from orchestrator.strategies.deployment.deployment_result import Deployed
from sim_engine.liquids import SimulationParameters
from sim_engine.outcome import Loss, PourMeasurement, SimulatedPour
from sim_engine.scene import PourTask, Scene
from sim_engine.search_space import Space

AFTER = (1, 3, 5, 10, 15)
SIMULATORS: dict[str, Callable[[Instance, Floats, Floats], float]] = {
    **WORLDS,
    "shifted by 0.04": lambda world, u, sign: world.true(u + 0.04 * sign),
}


def arms(asked: argparse.Namespace, space: Space) -> dict[str, DeploymentPlan]:
    """Return the compared deployments by name."""
    settings = D3Settings(
        pours=asked.pours,
        prior_simulations=asked.prior,
        simulations_per_pour="free",
        model=asked.model,
    )
    free, costs = DeploymentPlan(settings, (SCENE,), space, Loss()), CostSettings(pour=asked.pour)
    return {
        "D2": replace(free, settings=D2Settings(pours=asked.pours)),
        "fixed": free.with_settings(simulations_per_pour=2),
        "priced": free.with_settings(costs=costs),
        "longer": free.with_settings(costs=costs, prior_simulations=200),
        "tireless": free.with_settings(costs=CostSettings(pour=asked.pour, worth=0.0)),
    }


class Bench:
    """A simulated laboratory: simulators, arm and optimiser with costs, and a record of their occupancy."""

    mode = "virtual"

    def __init__(self, problem: Problem, world: str, seed: int, space: Space, asked: argparse.Namespace) -> None:
        self._world, self._space, self._asked = Instance(problem, seed), space, asked
        self._simulated = SIMULATORS[world]
        self._sign = np.random.default_rng([seed, 999]).choice([-1.0, 1.0], problem.dimension)
        self._free = asyncio.Semaphore(asked.slots)
        self.size = asked.slots
        self.separate = False
        self.simulators = self.bench = self.optimizer = self
        self.occupancy = Occupancy(asked.slots)
        self.poured: list[float] = []
        self.before_first = 0
        self.simulations = 0
        self.answers: list[float] = []

    async def __aenter__(self) -> Bench:
        return self

    async def __aexit__(self, *exc: object) -> None:
        return None

    @property
    def _clock(self) -> SkippingLoop:
        loop = asyncio.get_running_loop()
        assert isinstance(loop, SkippingLoop)
        return loop

    def watch(self, event: Event) -> None:
        """Record when the strategy lets the pool rest."""
        if isinstance(event, DecisionMade) and POOL_RESTS in event.decision.values:
            self.occupancy.rests(self._clock.time())

    async def simulate(self, task: PourTask) -> SimulatedPour:
        """Simulate on a free worker for the set time."""
        rng = np.random.default_rng(task.seed)
        cost = self._simulated(self._world, unit(self._space, task.action), self._sign)
        cost, seconds = cost + SCATTER * float(rng.standard_normal()), self._asked.simulation * rng.uniform(0.8, 1.2)
        async with self._free:
            self.occupancy.simulation_started(self._clock.time())
            await asyncio.sleep(seconds)
            self.occupancy.simulation_finished(self._clock.time())
        self.simulations += 1
        return SimulatedPour(simulated(cost, task.seed, seconds))

    async def pour(
        self,
        scene: Scene,
        action: Any,
        *,
        seed: int,
        progress: ProgressCallback | None = None,
        dose: DoseTarget | None = None,
    ) -> PourMeasurement:
        """Pour for the set time, including the operator's cleaning."""
        self.before_first = self.before_first if self.poured else self.simulations
        self.occupancy.pour_started(self._clock.time())
        await asyncio.sleep(self._asked.pour)
        cost = self._world.true(unit(self._space, action))
        self.poured.append(cost)
        noise = (0.01 + 0.12 * cost) * float(np.random.default_rng(seed).standard_normal())
        self.occupancy.pour_finished(self._clock.time())
        return PourMeasurement(scene.liquid.mass, scene.liquid.mass * min(max(cost + noise, 0.0), 1.0), 0.0)

    async def suggest(self, query: SuggestionQuery) -> Suggestion:
        """Query the real optimiser; in a laboratory it has its own process."""
        begun = time.thread_time()
        suggestion = propose(query)
        seconds = time.thread_time() - begun
        self.answers.append(seconds)
        await self._clock.spend(seconds, seconds)
        return suggestion

    def true(self, values: dict[str, float]) -> float:
        """Return the spillage of an action without noise."""
        return self._world.true(self._space.encode(values))


def campaign(arm: DeploymentPlan, world: str, seed: int, asked: argparse.Namespace) -> dict[str, Any]:
    """Run one campaign and return its figures."""
    problem = BY_NAME[asked.problem]
    bench = Bench(problem, world, seed, arm.actions, asked)
    with tempfile.TemporaryDirectory() as folder:
        plan = CampaignPlan(
            name="dyna",
            seed=seed,
            source=Path(folder) / "dyna.yaml",
            laboratory=LaboratorySettings(name="numbers"),
            parameters=SimulationParameters(particles=500),
            calibration=None,
            deployment=arm,
            outputs=OutputSettings(directory=folder, frame_rate=0.0),
            parallel_simulations=asked.slots,
        )
        begun = time.thread_time()
        result = run(run_campaign(plan, bench, Path(folder) / "run", subscribers=[bench.watch]))
    bench.occupancy.finish()
    (stage,) = result.results.values()
    assert isinstance(stage, Deployed)
    assert stage.recommended is not None
    values: dict[str, Any] = {
        "before first": bench.before_first,
        "simulations": bench.simulations,
        "busy": bench.occupancy.fraction if bench.simulations else None,
        "useful": bench.occupancy.useful / bench.occupancy.total if bench.simulations else None,
        "longest wait, ms": 1e3 * max(bench.occupancy.waits, default=0.0),
        "mean wait, ms": 1e3 * float(np.mean(bench.occupancy.waits)),
        "longest answer, ms": 1e3 * max(bench.answers),
        "CPU, s": time.thread_time() - begun,
        "alarm": float(stage.model_check.alarm),
        "reported": bench.true(stage.recommended.action_si),
    }
    for pours in (n for n in AFTER if n <= asked.pours):
        values[f"least of {pours}"] = min(bench.poured[:pours])
        values[f"mean of {pours}"] = float(np.mean(bench.poured[:pours]))
    return values


def rounded(values: list[float]) -> list[float]:
    """Return mean and interval, rounded for printing."""
    return [round(v, 4) for v in interval(values)]


def rows_of(asked: argparse.Namespace) -> list[dict[str, Any]]:
    """Run all worlds with all arms."""
    space = Space(AXES[: BY_NAME[asked.problem].dimension])
    rows = []
    for world in asked.worlds:
        for name in asked.arms:
            plan = arms(asked, space)[name]
            runs = []
            for seed in range(asked.first, asked.first + asked.seeds):
                runs.append(campaign(plan, world, seed, asked))
                say(f"{world}, {name}, seed {seed}: {runs[-1]}")
            row: dict[str, Any] = {"world": world, "arm": name}
            for key in runs[0]:
                known = [run[key] for run in runs if run[key] is not None]
                if key.startswith("longest"):
                    row[key] = round(max(known), 1)
                elif known:
                    row[key] = rounded(known)
            rows.append(row)
    return rows


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    names = ["D2", "fixed", "priced", "longer", "tireless"]
    parser.add_argument("--worlds", nargs="+", choices=list(SIMULATORS), default=["right", "shifted by 0.08"])
    parser.add_argument("--problem", choices=["spill2", "narrow2", "spill4"], default="spill2")
    parser.add_argument("--arms", nargs="+", choices=names, default=["D2", "fixed", "priced"])
    parser.add_argument("--seeds", type=int, default=30)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--simulation", type=float, default=1.5)
    parser.add_argument("--slots", type=int, default=2)
    parser.add_argument("--pour", type=float, default=90.0)
    parser.add_argument("--pours", type=int, default=15)
    parser.add_argument("--prior", type=int, default=37)
    parser.add_argument("--model", choices=["adaptive", "residual"], default="adaptive")
    parser.add_argument("--json", action="store_true")
    asked = parser.parse_args()
    pin(None)
    rows = rows_of(asked)
    show({"settings": vars(asked), "rows": rows, "machine": describe()}, asked.json)


if __name__ == "__main__":
    main()
