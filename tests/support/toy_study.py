"""A study in a toy laboratory: a process for its cells, and a command that tests kill.

`python toy_study.py STUDY.yaml [cells]`.
"""

from __future__ import annotations

import asyncio
import os
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

from actors.laboratory_settings import LaboratorySettings
from actors.optimizer.suggest import propose
from orchestrator.runs.run_service import RunResources
from orchestrator.study.study_file import load_study
from orchestrator.study.study_folder import opened
from orchestrator.study.study_plan import StudyPlan
from orchestrator.study.study_runner import CellStatus, LocalCells, run_cells, work
from sim_engine.action import DEG, Action
from sim_engine.liquids import SimulationParameters
from sim_engine.outcome import PourMeasurement, PourOutcome, SimulatedPour
from sim_engine.scene import PourTask, Scene

ROOT = Path(__file__).parents[2]
PAUSE = "TOY_PAUSE"
"""Environment variable: seconds that a toy simulation or pour takes."""


def spilled(action: Action, theta: SimulationParameters, seed: int) -> float:
    """A share that depends on action and θ, with some scatter from seed to seed."""
    speed = action.angular_velocity / (200 * DEG)
    scatter = 0.01 * np.random.default_rng(seed).random()
    return float(min(0.1 + 0.5 * speed * (1.0 - 4.0 * theta.cohesion) + abs(action.x_offset - 0.1) + scatter, 0.9))


class _Simulators:
    size = 1
    separate = False

    async def simulate(self, task: PourTask) -> SimulatedPour:
        await asyncio.sleep(float(os.environ.get(PAUSE, "0")))  # how long this takes
        share = spilled(task.action, task.parameters, task.seed)
        return SimulatedPour(PourOutcome(1 - share, share, 0, 0, 0, 500, 0.007, 0.01, 2.0, 400, 0.0, task.seed))


class _Bench:
    mode = "virtual"

    def __init__(self, hidden: SimulationParameters) -> None:
        self._hidden = hidden

    async def pour(
        self, scene: Scene, action: Action, *, seed: int, progress: Any = None, dose: Any = None
    ) -> PourMeasurement:
        await asyncio.sleep(float(os.environ.get(PAUSE, "0")))  # how long this takes
        share = spilled(action, self._hidden, seed)
        return PourMeasurement(scene.liquid.mass, share * scene.liquid.mass, 0.0)


class _Optimizer:
    async def suggest(self, problem: Any) -> Any:
        return propose(problem)


class ToyLaboratory:
    """In this process, without physics."""

    def __init__(self, spec: LaboratorySettings, pours: bool) -> None:
        assert spec.bench is not None
        self.simulators, self.optimizer = _Simulators(), _Optimizer()
        self.bench = _Bench(spec.bench.theta) if pours else None

    async def __aenter__(self) -> ToyLaboratory:
        return self

    async def __aexit__(self, *exc: object) -> None:
        pass


TOYS = RunResources(laboratory=ToyLaboratory)  # type: ignore[arg-type]
"""Runs every cell in a toy laboratory of its own."""


def toy_command(study: StudyPlan) -> list[str]:
    """A process for cells with a toy laboratory."""
    return [sys.executable, str(Path(__file__)), str(study.source), "cells"]


def run_toy_study(study: StudyPlan, **arguments: Any) -> CellStatus:
    """As the command does."""
    with opened(study) as folder:
        return run_cells(study, folder, LocalCells(study, folder, 2, toy_command), **arguments)


def main() -> int:
    if len(sys.argv) > 2:
        work(Path(sys.argv[1]), TOYS)
        return 0
    begun = time.monotonic()
    status = run_toy_study(load_study(Path(sys.argv[1])))
    print(f"{time.monotonic() - begun:.1f} s")
    return 1 if status.failed else 0


if __name__ == "__main__":
    sys.exit(main())
