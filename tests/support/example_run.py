"""A small campaign to watch: its plan, its events, and a pour with frames, made up without any simulator."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from actors.interfaces import PourProgress
from actors.laboratory_settings import LaboratorySettings
from actors.optimizer.questions import Data, MinimumQuery, Suggestion, SuggestionQuery, SurrogateMap
from actors.optimizer.suggest import propose
from orchestrator.learning.campaign_plan import CampaignPlan, OutputSettings
from orchestrator.learning.requests import (
    Decision,
    Failed,
    Outcome,
    Pour,
    Poured,
    Prediction,
    Request,
    Simulate,
    Simulated,
    Slots,
    Suggest,
    Suggested,
)
from orchestrator.learning.single_action import ActionPrediction
from orchestrator.learning.strategy import Progress, Strategy
from orchestrator.records.events import (
    CampaignClosed,
    CampaignOpened,
    DecisionMade,
    Event,
    LogLine,
    PourProgressed,
    RequestFinished,
    RequestStarted,
    StageClosed,
    StageOpened,
    StrategyProgressed,
)
from sim_engine.action import DEG, Action
from sim_engine.liquids import Liquid, SimulationParameters
from sim_engine.outcome import Loss, PourMeasurement, PourOutcome, RecordedFrames, SimulatedPour
from sim_engine.scene import PourTask, Scene
from sim_engine.search_space import Axis, Space
from sim_engine.vessel.shapes import cylinder
from tests.support import plans

BEAKER = cylinder("beaker", inner_radius=0.035, inner_height=0.09)
TUMBLER = Scene("tumbler", BEAKER, cylinder("tumbler", inner_radius=0.05, inner_height=0.09), Liquid(mass=0.2))
NARROW = Scene(
    "narrow cup",
    BEAKER,
    cylinder("narrow", inner_radius=0.03, inner_height=0.08),
    Liquid(mass=0.2),
    fixed={"height": 0.05},
)
ACTIONS = Space((Axis("angular_velocity", 15 * DEG, 120 * DEG), Axis("x_offset", 0.06, 0.15)))
THETA = Space((Axis("particles", 500, 4000, "log", integer=True), Axis("cohesion", 0.0, 0.1)))
ACTION = Action(angular_velocity=40 * DEG, x_offset=0.09, height=0.05)
PARTICLES = 300
LEARNT = ActionPrediction(scene="narrow cup", simulations=0, simulations_lost=0, thetas=0, touching=0, over_seeds={})
"""For events whose result nobody looks at."""


def campaign(*, pours: int = 3) -> CampaignPlan:
    """Calibration in the tumbler, D3 into the narrow cup."""
    calibration = plans.calibration(
        scene=TUMBLER,
        actions=ACTIONS,
        parameters=THETA,
        fixed_parameters={},
        pour_count=8,
        holdout=2,
        simulations=8,
        initial_samples=4,
    )
    deployment = plans.deployment(
        scenes=(NARROW,), actions=ACTIONS, loss=Loss(), pours=pours, prior_simulations=6, simulations_per_pour=0
    )
    return CampaignPlan(
        "narrow-cup",
        7,
        Path("narrow-cup.yaml"),
        LaboratorySettings(name="virtual", simulators=2),
        SimulationParameters(),
        calibration,
        deployment,
        OutputSettings(),
    )


def outcome(*, spilled: float = 0.05, retained: float = 0.02, seed: int = 1) -> PourOutcome:
    """A valid simulation."""
    received = 1.0 - spilled - retained
    return PourOutcome(received, spilled, retained, 0.0, 0.0, PARTICLES, 0.005, 0.01, 3.0, 900, 0.9, seed)


def frames(*, duration: float = 3.0, rate: float = 10.0) -> RecordedFrames:
    """A pourer that tilts by 90° while its liquid moves into the receiver, every tenth particle beside it."""
    times = np.arange(0.0, duration + 0.5 / rate, 1.0 / rate)
    rng = np.random.default_rng(0)
    positions, states, poses = [], [], []
    for t in times:
        tilt = 0.5 * math.pi * t / duration
        left = round(PARTICLES * t / duration)
        state = np.zeros(PARTICLES, np.uint8)
        state[:left] = 2
        state[:left:10] = 3
        place = rng.uniform(-0.02, 0.02, (PARTICLES, 3)).astype(np.float32)
        place[:, 2] += np.where(state == 0, 0.15, 0.03)
        place[:, 0] += np.select([state == 0, state == 3], [-0.09, 0.08], 0.0)
        positions.append(place)
        states.append(state)
        poses.append([-0.09, 0.0, 0.13, math.cos(tilt / 2), 0.0, math.sin(tilt / 2), 0.0])
    return RecordedFrames(times, positions, states, np.array(poses))


def simulation() -> tuple[PourTask, SimulatedPour]:
    """One simulated pour with frames."""
    task = PourTask(NARROW, ACTION, SimulationParameters(particles=PARTICLES), seed=1, frame_rate=10.0)
    return task, SimulatedPour(outcome(), frames())


def surrogate(size: int = 9) -> SurrogateMap:
    """A bowl."""
    x, y = np.meshgrid(np.linspace(0, 1, size), np.linspace(0, 1, size))
    mean = 0.02 + (x - 0.7) ** 2 + 0.5 * (y - 0.3) ** 2
    return SurrogateMap(tuple(map(tuple, mean.tolist())), tuple(map(tuple, (0.01 + 0.02 * x).tolist())))


def events(plan: CampaignPlan, *, directory: Path = Path("runs/narrow-cup-1")) -> Iterator[Event]:
    """What a run of `campaign` tells: two calibrating simulations, then pours that get better."""
    now = 1_000_000.0
    yield CampaignOpened(
        time=now,
        name=plan.name,
        run_directory=directory,
        stages=("calibration", "narrow cup"),
        mode="virtual",
        simulators=2,
    )
    yield StageOpened(time=now, stage="calibration", index=1, count=2)
    for number in (1, 2):
        request = Simulate("tumbler", ACTION, SimulationParameters(), number, "calibrate")
        yield RequestStarted(time=now, stage="calibration", id=number, request=request)
        now += 2.0
        yield RequestFinished(
            time=now,
            stage="calibration",
            id=number,
            request=request,
            outcome=Simulated(outcome()),
            seconds=2.0,
            frames=frames(),
        )
        yield StrategyProgressed(time=now, stage="calibration", progress=Progress(number, 2), result=LEARNT)
    # As C4 does it: observations carry the action behind θ.
    question = MinimumQuery(THETA, Data(((0.2, 0.3, 0.5, 0.5), (0.7, 0.3, 0.1, 0.9)), (0.2, 0.05)), map_resolution=9)
    yield _answered("calibration", 3, question, now)
    yield StageClosed(time=now, stage="calibration", result=LEARNT)
    yield StageOpened(time=now, stage="narrow cup", index=2, count=2)
    pours = plan.deployment.pours if plan.deployment is not None else 0
    for number in range(1, pours + 1):
        pour = Pour("narrow cup", ACTION, number, number, Prediction(0.2 / number, 0.02))
        yield DecisionMade(time=now, stage="narrow cup", decision=Decision(f"pour {number}: least lower bound"))
        yield RequestStarted(time=now, stage="narrow cup", id=10 * number, request=pour)
        tilting = PourProgress("tilt", 0.4, 30 * DEG, 0.0003)
        yield PourProgressed(time=now + 30, stage="narrow cup", id=10 * number, number=number, progress=tilting)
        now += 90.0
        measured = PourMeasurement(loaded=0.2, spilled=0.03 / number, retained=0.002)
        yield RequestFinished(
            time=now, stage="narrow cup", id=10 * number, request=pour, outcome=Poured(measured), seconds=90.0
        )
        points = tuple((0.1 * i, 0.5) for i in range(1, number + 1))
        question = MinimumQuery(ACTIONS, Data(points, tuple(0.1 for _ in points)), map_resolution=9)
        yield _answered("narrow cup", 10 * number + 1, question, now)
        if number == 1:
            alarm = Decision("after pour 1 the simulator is wrong here", urgent=True)
            yield DecisionMade(time=now, stage="narrow cup", decision=alarm)
        yield StrategyProgressed(
            time=now, stage="narrow cup", progress=Progress(pours=number, of_pours=pours), result=LEARNT
        )
    yield LogLine(time=now, level="warning", text="the balance drifts")
    yield StageClosed(time=now, stage="narrow cup", result=LEARNT)
    yield CampaignClosed(time=now, state="finished", results={})


def three_parameters() -> Iterator[Event]:
    """An answer about three parameters, mapped over particles and friction."""
    box = Space((*THETA.axes, Axis("friction", 0.0, 0.5)))
    question = MinimumQuery(box, Data(((0.2, 0.9, 0.3, 0.5, 0.5),), (0.2,)), map_resolution=9)
    cut = replace(surrogate(), axes=("particles", "friction"), at=(0.3, 0.4, 0.7))
    answer = Suggestion(((0.3, 0.4, 0.7),), (0.1,), (0.02,), surrogate=cut)
    yield RequestFinished(time=1e6, stage="calibration", id=1, request=Suggest(question), outcome=Suggested(answer))


def _answered(stage: str, key: int, question: SuggestionQuery, now: float) -> RequestFinished:
    answer = Suggestion(((0.5, 0.5),), (0.1,), (0.02,), surrogate=surrogate())
    return RequestFinished(time=now, stage=stage, id=key, request=Suggest(question), outcome=Suggested(answer))


def played(strategy: Strategy, spilled: Callable[[Action, SimulationParameters], float]) -> Any:
    """The result of a strategy in a world whose spillage is a formula."""
    while not strategy.finished:
        requests = strategy.ask(Slots(simulations=2))
        assert requests, "the strategy stalls"
        for request in requests:
            strategy.tell(request, _reply(request, spilled))
    return strategy.result()


def _reply(request: Request, spilled: Callable[[Action, SimulationParameters], float]) -> Outcome:
    match request:
        case Suggest(problem):
            return Suggested(propose(problem))
        case Simulate():
            return Simulated(replace(outcome(spilled=spilled(request.action, request.parameters)), seed=request.seed))
        case Pour():
            amount = spilled(request.action, SimulationParameters())
            return Poured(PourMeasurement(loaded=0.2, spilled=0.2 * amount, retained=0.004))
    return Failed("simulation", "nobody knows")
