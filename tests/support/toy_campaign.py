"""A toy campaign on a toy laboratory, in one process and without physics: for tests of journal, scheduler and resume.

Run as a script it is the process that tests kill: `python toy.py DIRECTORY` with the options of `main`.
"""

from __future__ import annotations

import argparse
import asyncio
import hashlib
import random
from collections.abc import Awaitable, Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np

from actors.interfaces import PourProgress, ProgressCallback
from actors.laboratory_settings import LaboratorySettings
from actors.optimizer.questions import Data, MinimumQuery, Suggestion, SuggestionQuery
from orchestrator.learning.campaign_plan import CampaignPlan, OutputSettings
from orchestrator.learning.requests import (
    Decision,
    Failed,
    Outcome,
    Pour,
    Poured,
    Request,
    Simulate,
    Simulated,
    Slots,
    Suggest,
    Suggested,
)
from orchestrator.learning.stage_result import StageResult
from orchestrator.learning.strategy import Progress
from orchestrator.records.codec import Results, result_of
from orchestrator.records.journal import JOURNAL_NAME, JournalReader
from orchestrator.records.run_record import CampaignResult
from orchestrator.runs.run_engine import run_campaign
from orchestrator.runs.stages import StageDefinition
from sim_engine.action import DEG
from sim_engine.liquids import Liquid, SimulationParameters
from sim_engine.outcome import Loss, PourMeasurement, PourOutcome, SimulatedPour
from sim_engine.scene import PourTask, Scene
from sim_engine.search_space import Axis, Space
from sim_engine.vessel.shapes import cylinder
from tests.support import plans
from tests.support.command_process import logical

SPACE = Space((Axis("angular_velocity", 15 * DEG, 120 * DEG), Axis("x_offset", 0.08, 0.15)))
SCENE = Scene(
    "cup",
    cylinder("beaker", inner_radius=0.04, inner_height=0.1),
    cylinder("cup", inner_radius=0.03, inner_height=0.08),
    Liquid(mass=0.2),
    fixed={"height": 0.03},
)
THETA = SimulationParameters(particles=500)


def toy_plan(directory: Path, **changes: Any) -> CampaignPlan:
    deployment = plans.deployment(scenes=(SCENE,), actions=SPACE, loss=Loss(), pours=3, simulations_per_pour=2)
    values: dict[str, Any] = {
        "name": "toy",
        "seed": 7,
        "source": directory / "toy.yaml",
        "laboratory": LaboratorySettings(name="toy"),
        "parameters": THETA,
        "calibration": None,
        "deployment": deployment,
        "outputs": OutputSettings(directory=str(directory)),
        "parallel_simulations": 2,
    }
    return CampaignPlan(**(values | changes))


def spill(point: Sequence[float], noise: float) -> float:
    return min(abs(point[0] - 0.3) * 0.4 + abs(point[1] - 0.6) * 0.3 + 0.05 * noise, 0.9)


def noise(seed: int) -> float:
    return int.from_bytes(hashlib.sha256(str(seed).encode()).digest()[:6], "big") / 2**48


@dataclass
class ToyBench:
    """A virtual bench; a pour takes `pauses` seconds, and goes on until `until` holds."""

    pauses: Callable[[], float] = lambda: 0.0
    until: Callable[[], bool] = lambda: True
    mode: str = "virtual"
    received: list[int] = field(default_factory=list)
    poured: list[int] = field(default_factory=list)
    aborted: list[int] = field(default_factory=list)
    fails: Callable[[int], Exception | None] = lambda seed: None

    async def pour(
        self, scene: Scene, action: Any, *, seed: int, progress: ProgressCallback | None = None, dose: Any = None
    ) -> PourMeasurement:
        self.received.append(seed)
        if progress is not None:
            progress(PourProgress("tilt", 0.5))
        try:
            await asyncio.sleep(self.pauses())  # how long this takes
            while not self.until():
                await asyncio.sleep(0.001)
        except asyncio.CancelledError:
            self.aborted.append(seed)
            raise
        if (error := self.fails(seed)) is not None:
            raise error
        self.poured.append(seed)
        spilled = spill(list(SPACE.encode(action.values())), noise(seed)) * scene.liquid.mass
        return PourMeasurement(scene.liquid.mass, spilled, 0.001, {"seed": seed})


@dataclass
class ToySimulators:
    pauses: Callable[[], float] = lambda: 0.0
    size: int = 2
    separate: bool = False
    tasks: list[PourTask] = field(default_factory=list)
    cancelled: int = 0
    running: int = 0
    most_running: int = 0
    fails: Callable[[PourTask], Exception | str | None] = lambda task: None

    async def simulate(self, task: PourTask) -> SimulatedPour:
        self.tasks.append(task)
        self.running += 1
        self.most_running = max(self.running, self.most_running)
        try:
            await asyncio.sleep(self.pauses())  # how long this takes
        except asyncio.CancelledError:
            self.cancelled += 1
            raise
        finally:
            self.running -= 1
        problem = self.fails(task)
        if isinstance(problem, Exception):
            raise problem
        spilled = spill(list(SPACE.encode(task.action.values())), noise(task.seed))
        outcome = PourOutcome(
            1 - spilled,
            spilled,
            0.0,
            0.0,
            0.0,
            500,
            0.0073,
            0.01,
            2.0,
            400,
            random.random(),
            task.seed,
            invalid=problem,
        )
        return SimulatedPour(outcome)


@dataclass
class ToyOptimizer:
    """Proposes points from the seed and the best point so far: later requests depend on former outcomes."""

    pauses: Callable[[], float] = lambda: 0.0
    fails: Callable[[], Exception | None] = lambda: None
    asked: int = 0

    async def suggest(self, query: SuggestionQuery) -> Suggestion:
        self.asked += 1
        await asyncio.sleep(self.pauses())  # how long this takes
        if (error := self.fails()) is not None:
            raise error
        rng = np.random.default_rng(query.seed)
        data = getattr(query, "data", Data())
        centre = np.array(data.points[int(np.argmin(data.costs))]) if len(data) else np.full(2, 0.5)
        points = 0.5 * centre + 0.5 * rng.random((getattr(query, "count", 1), 2))
        return Suggestion(tuple(tuple(float(u) for u in p) for p in points), seconds=random.random())


@dataclass
class ToyLaboratory:
    simulators: ToySimulators = field(default_factory=ToySimulators)
    bench: ToyBench | None = field(default_factory=ToyBench)
    optimizer: ToyOptimizer = field(default_factory=ToyOptimizer)
    opened: int = 0

    async def __aenter__(self) -> ToyLaboratory:
        self.opened += 1
        return self

    async def __aexit__(self, *exc: object) -> None:
        self.opened -= 1


def slow_laboratory(longest: float, rng: random.Random | None = None) -> ToyLaboratory:
    """Everything takes a random time up to `longest` seconds, a pour three times as long."""
    clock = rng or random.Random()
    return ToyLaboratory(
        ToySimulators(lambda: clock.uniform(0, longest)),
        ToyBench(lambda: clock.uniform(0, 3 * longest)),
        ToyOptimizer(lambda: clock.uniform(0, longest / 2)),
    )


class Toyed(StageResult):
    """What the toy strategy learnt."""

    kind: Literal["toy"] = "toy"
    spillages: tuple[float, ...]
    simulations: int


class ToyStrategy:
    """Some simulations, then pours with `beside` simulations beside each. All decisions depend on what was told."""

    def __init__(self, seed: int, *, simulations: int = 6, pours: int = 3, beside: int = 3) -> None:
        self._rng = np.random.default_rng(seed)
        self._simulations, self._pours, self._beside = simulations, pours, beside
        self._data = Data()
        self._points: list[tuple[float, ...]] = []
        self._suggesting = False
        self._waiting: dict[Request, tuple[float, ...]] = {}
        self._asked_simulations = self._asked_pours = self._told_pours = 0
        self.spillages: list[float] = []
        self.decisions: list[Decision] = []
        self.asks: list[Slots] = []

    @property
    def _wanted(self) -> int:
        return self._simulations + self._beside * self._asked_pours

    @property
    def finished(self) -> bool:
        return not self._waiting and self._told_pours == self._pours and self._asked_simulations >= self._wanted

    def ask(self, slots: Slots) -> list[Request]:
        self.asks.append(slots)
        if not self._points:
            if self._suggesting:
                return []
            self._suggesting = True
            self.decisions.append(Decision("new ideas are needed", {"data": float(len(self._data))}))
            return [Suggest(MinimumQuery(SPACE, self._data, count=3, seed=self._seed()))]
        requests: list[Request] = []
        prior_done = self._asked_simulations >= self._simulations and (
            self._asked_pours or not any(isinstance(r, Simulate) for r in self._waiting)
        )
        idle = self._told_pours == self._asked_pours and self._asked_simulations >= self._wanted
        if prior_done and idle and self._asked_pours < self._pours and slots.pours and self._points:
            point = self._points.pop()
            self._asked_pours += 1
            requests.append(Pour("cup", SCENE.action(SPACE.decode(point)), self._asked_pours, self._seed()))
            self._waiting[requests[-1]] = point
        for _ in range(slots.simulations):
            if self._asked_simulations < self._wanted and self._points:
                point = self._points.pop()
                self._asked_simulations += 1
                request = Simulate("cup", SCENE.action(SPACE.decode(point)), THETA, self._seed(), "toy")
                requests.append(request)
                self._waiting[request] = point
        return requests

    def tell(self, request: Request, outcome: Outcome) -> None:
        match outcome:
            case Suggested(suggestion):
                self._points = list(suggestion.points)
                self._suggesting = False
                return
            case Simulated(result):
                self._data = self._data.added(self._waiting[request], result.spilled)
            case Poured(measurement):
                self._data = self._data.added(self._waiting[request], measurement.fractions.spilled)
                self.spillages.append(measurement.fractions.spilled)
            case Failed():
                pass
        del self._waiting[request]
        self._told_pours += isinstance(request, Pour)

    def progress(self) -> Progress:
        return Progress(pours=self._told_pours, of_pours=self._pours)

    def result(self) -> Toyed:
        return Toyed(spillages=tuple(self.spillages), simulations=self._asked_simulations)

    def _seed(self) -> int:
        return int(self._rng.integers(2**31))


def toy_stages(**numbers: int) -> tuple[StageDefinition, ...]:
    """Two stages; the second one's seed depends on the first one's result."""

    def second(results: Results, seed: int) -> ToyStrategy:
        return ToyStrategy(seed + int(1e6 * result_of(results, "first", Toyed).spillages[-1]), **numbers)

    return (
        StageDefinition("first", lambda results, seed: ToyStrategy(seed, **numbers), pours=True),
        StageDefinition("second", second, pours=True),
    )


async def run_toy(directory: Path, laboratory: ToyLaboratory | None = None, **arguments: Any) -> CampaignResult:
    plan = arguments.pop("plan", None) or toy_plan(directory)
    arguments.setdefault("stages", toy_stages())
    return await run_campaign(plan, laboratory or ToyLaboratory(), directory, **arguments)


def logical_record(directory: Path) -> list[tuple[Any, ...]]:
    """What a run asked for and was told, in order; times, process ids and attempts aside."""
    with JournalReader(directory / JOURNAL_NAME) as journal:
        return logical(list(journal.entries()))


def answering(answer: str) -> Callable[[str, Sequence[str]], str | Awaitable[str]]:
    return lambda question, options, facts: answer


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("directory", type=Path)
    parser.add_argument("--resume", action="store_true")
    parser.add_argument("--on-unknown", default=None)
    parser.add_argument("--slow", type=float, default=0.0)
    parser.add_argument("--hang-after", type=int, default=None)
    options = parser.parse_args()
    ask = answering(options.on_unknown) if options.on_unknown else None
    laboratory = slow_laboratory(options.slow)
    if options.hang_after is not None:
        pauses = iter([options.slow] * options.hang_after)
        laboratory.simulators.pauses = lambda: next(pauses, 1e6)
    asyncio.run(run_toy(options.directory, laboratory, resume=options.resume, ask_operator=ask))


if __name__ == "__main__":
    main()
