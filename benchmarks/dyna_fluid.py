"""Run the Dyna loop with simulated liquid: real simulations during pours of the virtual bench, at 90 s per pour.

    python benchmarks/dyna_fluid.py [--level moderate] [--receiver narrow] [--arms D2 fixed priced tireless]
                                    [--seeds 3] [--particles 500] [--slots 2] [--pour 90] [--pours 15] [--json]

Simulator, strategy, scheduler, journal and optimiser are the real ones, in one process, on a clock that skips waits
(`skipping_clock.py`). A simulation takes its own CPU time on one of `--slots` simulators; a pour takes `--pour`
seconds. The bench's own liquid is counted separately and takes no time on that clock. Bench, scenes and actions are
those of `configs/studies/paper.yaml`; θ is not calibrated. Arms are those of `dyna.py`; `tireless` simulates
throughout each pour, about 900 times.
"""

from __future__ import annotations

import argparse
import asyncio
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from dyna import AFTER, Bench, rounded
from machine import describe, pin, say, show
from skipping_clock import run

from actors.bench.ground_truth import hidden_spill
from actors.interfaces import DoseTarget, InvalidActionError, ProgressCallback
from orchestrator.journal.run_record import Occupancy
from orchestrator.runs.run_engine import run_campaign
from orchestrator.strategies.campaign_plan import DeploymentPlan, OutputSettings
from orchestrator.strategies.deployment.costing import CostSettings
from orchestrator.strategies.deployment.d2 import D2Settings
from orchestrator.strategies.deployment.d3 import D3Settings
from orchestrator.strategies.deployment.deployment_result import Deployed
from orchestrator.study.study_file import load_study
from orchestrator.study.study_plan import StudyPlan
from sim_engine.errors import InvalidSceneError
from sim_engine.liquids import SimulationParameters
from sim_engine.outcome import PourMeasurement, SimulatedPour
from sim_engine.scene import PourTask, Scene
from sim_engine.simulator import PourSimulator

ROOT = Path(__file__).resolve().parents[1]
Row = dict[str, Any]


class Fluid(Bench):
    """A laboratory with simulated liquid: the pool uses the strategy's θ, the bench the hidden ground truth."""

    def __init__(self, study: StudyPlan, level: str, simulator: PourSimulator, asked: argparse.Namespace) -> None:
        self._asked, self._simulator = asked, simulator
        self._free = asyncio.Semaphore(asked.slots)
        self.size = asked.slots
        self.separate = False
        self.simulators = self.bench = self.optimizer = self
        self.occupancy = Occupancy(asked.slots)
        self.poured: list[float] = []
        self.before_first = self.simulations = 0
        self.answers: list[float] = []
        self.priced: list[float] = []
        self.apart = 0.0
        self._hidden, self._beside = study.level(level).bench, _Apart(self)

    def _run(self, task: PourTask) -> tuple[SimulatedPour, float]:
        """Run a simulation; return it with the CPU time that this thread spent on it."""
        begun = time.thread_time()
        try:
            found = self._simulator.simulate(task)
        except InvalidSceneError as error:
            raise InvalidActionError(str(error)) from None
        return SimulatedPour(found.outcome), time.thread_time() - begun

    async def simulate(self, task: PourTask) -> SimulatedPour:
        """Simulate on a free worker for the CPU time of the simulation."""
        async with self._free:
            self.occupancy.simulation_started(self._clock.time())
            try:
                result, used = self._run(task)
                self.priced.append(result.outcome.cpu_s)
                await self._clock.spend(result.outcome.cpu_s, used)
            finally:
                self.occupancy.simulation_finished(self._clock.time())
        self.simulations += 1
        return result

    async def simulate_apart(self, task: PourTask) -> SimulatedPour:
        """Simulate the bench's own liquid, which takes none of the campaign's time."""
        result, used = self._run(task)
        self.apart += result.outcome.cpu_s
        await self._clock.spend(0.0, used)
        return result

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
        try:
            spill = await hidden_spill(self._hidden, self._beside, scene, action, seed)
            await asyncio.sleep(self._asked.pour)
        finally:
            self.occupancy.pour_finished(self._clock.time())
        mass = scene.liquid.mass
        self.poured.append((spill.spilled + spill.retained) / mass)
        return PourMeasurement(mass, spill.spilled, spill.retained)


class _Apart:
    """The simulator of the bench."""

    size = 1
    separate = False

    def __init__(self, fluid: Fluid) -> None:
        self._fluid = fluid

    async def simulate(self, task: PourTask) -> SimulatedPour:
        return await self._fluid.simulate_apart(task)


def arms(asked: argparse.Namespace, base: DeploymentPlan) -> dict[str, DeploymentPlan]:
    """Return the compared deployments by name; see `dyna.py`."""
    free = replace(base, settings=D3Settings.like(base.settings, pours=asked.pours, simulations_per_pour="free"))
    costs = CostSettings(pour=asked.pour)
    return {
        "D2": replace(free, settings=D2Settings.like(free.settings)),
        "fixed": free.with_settings(simulations_per_pour=2),
        "priced": free.with_settings(costs=costs),
        "tireless": free.with_settings(costs=CostSettings(pour=asked.pour, worth=0.0)),
    }


def campaign(study: StudyPlan, arm: DeploymentPlan, seed: int, fluid: Fluid, asked: argparse.Namespace) -> Row:
    """Run one campaign and return its figures."""
    with tempfile.TemporaryDirectory() as folder:
        plan = replace(
            study.base,
            name="dyna",
            seed=seed,
            parameters=replace_particles(study, asked.particles),
            calibration=None,
            deployment=arm,
            outputs=OutputSettings(directory=folder, recording=False, figures=False, frame_rate=0.0),
            parallel_simulations=asked.slots,
        )
        result = run(run_campaign(plan, fluid, Path(folder) / "run", subscribers=[fluid.watch]))
    fluid.occupancy.finish()
    (stage,) = result.results.values()
    assert isinstance(stage, Deployed)
    simulated = bool(fluid.simulations)
    values: Row = {
        "before first": fluid.before_first,
        "simulations": fluid.simulations,
        "a simulation, s": float(np.mean(fluid.priced)) if simulated else None,
        "busy": fluid.occupancy.fraction if simulated else None,
        "useful": fluid.occupancy.useful / fluid.occupancy.total if simulated else None,
        "longest wait, ms": 1e3 * max(fluid.occupancy.waits, default=0.0),
        "mean wait, ms": 1e3 * float(np.mean(fluid.occupancy.waits)),
        "longest answer, ms": 1e3 * max(fluid.answers),
        "alarm": float(stage.model_check.alarm),
        "apart, s": fluid.apart,
    }
    for pours in (n for n in AFTER if n <= asked.pours):
        values[f"least of {pours}"] = min(fluid.poured[:pours])
        values[f"mean of {pours}"] = float(np.mean(fluid.poured[:pours]))
    return values


def replace_particles(study: StudyPlan, particles: int) -> SimulationParameters:
    """Return the study's θ at another resolution."""
    return study.base.parameters.model_copy(update={"particles": particles})


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    names = ["D2", "fixed", "priced", "tireless"]
    parser.add_argument("--level", default="moderate")
    parser.add_argument("--receiver", choices=["narrow", "cone", "bowl"], default="narrow")
    parser.add_argument("--arms", nargs="+", choices=names, default=names[:3])
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--particles", type=int, default=500)
    parser.add_argument("--slots", type=int, default=2)
    parser.add_argument("--pour", type=float, default=90.0)
    parser.add_argument("--pours", type=int, default=15)
    parser.add_argument("--json", action="store_true")
    asked = parser.parse_args()
    pin(None)
    study = load_study(ROOT / "configs/studies/paper.yaml")
    base = study.deployment("D3").plan
    scene = next(s for s in base.scenes if s.name == f"deployment-{asked.receiver}")
    simulator, rows = PourSimulator(), []
    for name in asked.arms:
        arm = arms(asked, replace(base, scenes=(scene,)))[name]
        runs = []
        for seed in range(asked.seeds):
            runs.append(campaign(study, arm, seed, Fluid(study, asked.level, simulator, asked), asked))
            say(f"{name}, seed {seed}: {runs[-1]}")
        row: Row = {"arm": name}
        for key in runs[0]:
            known = [run[key] for run in runs if run[key] is not None]
            row[key] = max(known) if key.startswith("longest") else rounded(known) if known else None
        rows.append(row)
    show({"settings": vars(asked), "rows": rows, "machine": describe()}, asked.json)


if __name__ == "__main__":
    main()
