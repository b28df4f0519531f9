"""Runs a strategy against plain functions, in milliseconds and without actors: for the tests of its author::

    from decant.plugins.testing import StrategyHarness, check_strategy

    run = StrategyHarness(narrow_cup).run(MyStrategy(plan, SCENE, THETA, seed=1))
    assert len(run.pours) == 8
    check_strategy(lambda: MyStrategy(plan, SCENE, THETA, seed=1), narrow_cup)

`StrategyHarness` answers every request at once: simulations and pours with functions of the action, questions to the
optimiser with the optimiser itself. `check_strategy` is to a strategy what `ArmContract` is to an arm. There are no
processes, clocks or files here: those belong to `orchestrator.runs.stage_scheduler`. Every failure is an
AssertionError.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import replace
from typing import Literal

import numpy as np

from actors.optimizer.suggest import propose
from orchestrator.learning.requests import (
    Answered,
    Ask,
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
from orchestrator.learning.run_errors import LearningError, RunError
from orchestrator.learning.strategy import Strategy
from orchestrator.records.codec import decode_result, encode_result
from sim_engine.action import DEG, Action
from sim_engine.liquids import Liquid, SimulationParameters
from sim_engine.outcome import PourMeasurement, PourOutcome
from sim_engine.scene import PoseError, Scene
from sim_engine.search_space import Axis, Space
from sim_engine.vessel.shapes import cylinder

SpillModel = Callable[[Action, SimulationParameters, np.random.Generator], float]
"""Share of the poured liquid that is spilled, 0 … 1. ValueError: the action is invalid; NaN: the trial fails."""

ACTIONS = Space((Axis("angular_velocity", 15 * DEG, 120 * DEG), Axis("x_offset", 0.08, 0.15)))
"""Of an example deployment [rad/s], [m]."""

CALIBRATION_ACTIONS = Space((Axis("angular_velocity", 15 * DEG, 120 * DEG), Axis("max_angle", 70 * DEG, 125 * DEG)))
"""Of an example calibration [rad/s], [rad]."""

PARAMETERS = Space((Axis("particles", 500, 4000, "log", integer=True), Axis("cohesion", 0.0, 0.1)))
"""Parameters θ that an example calibration searches."""

SCENE = Scene(
    "cup",
    cylinder("beaker", inner_radius=0.04, inner_height=0.1),
    cylinder("cup", inner_radius=0.035, inner_height=0.1),
    Liquid(mass=0.2),
    fixed={"height": 0.05, "x_offset": 0.1},
)
"""Vessels and liquid of an example."""

THETA = SimulationParameters()
"""Parameters θ that real pours are made with."""

LOADED = 0.2
"""Mass in the pourer before every pour [kg]."""


class StrategyHarness:
    """Asks a strategy, answers its requests and tells it the outcomes, until it has finished.

    Args:
        simulated: spillage of a simulated pour.
        real: spillage of a weighed pour; that of a simulated one by default.
        slots: simulations that may be open at a time.
        order: which of the open simulations is answered next. A simulation is answered before the pour next to it.
        answer: overrides the outcome of a request; None leaves it to the functions.
        limit: outcomes after which a strategy that has not finished is an error.
        beside: simulations answered while a pour is open; None: all of them.

    Attributes:
        asked: all requests, in their order.
        told: all requests with their outcomes, in the order of the answers.
    """

    def __init__(
        self,
        simulated: SpillModel,
        real: SpillModel | None = None,
        *,
        slots: int = 2,
        order: Literal["first", "last"] = "first",
        answer: Callable[[Request], Outcome | None] = lambda request: None,
        limit: int = 5000,
        beside: int | None = None,
    ) -> None:
        self.simulated, self.real = simulated, real or simulated
        self.slots, self.order, self.answer, self.limit = slots, order, answer, limit
        self.beside, self._since_pour = beside, 0
        self.asked: list[Request] = []
        self.told: list[tuple[Request, Outcome]] = []

    def run(self, strategy: Strategy) -> StrategyHarness:
        """Run a fresh strategy to its end; this harness, with what was asked and told.

        Raises:
            AssertionError: it asked for more than there are slots, waits for nothing, or does not finish.
            LearningError: the strategy cannot go on with the outcomes that it has.
        """
        waiting: list[Request] = []
        for _ in range(self.limit):
            finished = strategy.finished
            if finished:
                if waiting:
                    raise AssertionError(
                        f"the strategy reports that it has finished while {len(waiting)} requests are open, "
                        f"as {type(waiting[0]).__name__}; it finishes after their outcomes"
                    )
                return self
            self._ask(strategy, waiting)
            if not waiting:
                if not strategy.finished:
                    raise AssertionError(
                        "the strategy asks for nothing, waits for nothing and has not finished; it would wait forever"
                    )
                continue
            request = self._next(waiting)
            waiting.remove(request)
            outcome = self.answer(request) or self._outcome(request)
            self.told.append((request, outcome))
            strategy.tell(request, outcome)
        raise AssertionError(f"the strategy has not finished after {self.limit} outcomes")

    def _ask(self, strategy: Strategy, waiting: list[Request]) -> None:
        free = Slots(
            self.slots - sum(isinstance(r, Simulate) for r in waiting), 1 - sum(isinstance(r, Pour) for r in waiting)
        )
        requests = strategy.ask(free)
        for kind, most in ((Simulate, free.simulations), (Pour, free.pours)):
            count = sum(isinstance(r, kind) for r in requests)
            if count > most:
                raise AssertionError(f"the strategy asks for {count} × {kind.__name__}; {most} slots are free")
        self.asked += requests
        waiting += requests

    def _next(self, waiting: list[Request]) -> Request:
        """Questions first; a pour takes longer than the simulations next to it."""
        rank: dict[type, int] = {Suggest: 0, Simulate: 1, Pour: 2, Ask: 3}
        if self.beside is not None and any(isinstance(r, Pour) for r in waiting):
            self._since_pour += 1
            if self._since_pour > self.beside:
                rank[Pour], self._since_pour = -1, 0
        lowest = min(rank[type(r)] for r in waiting)
        candidates = [r for r in waiting if rank[type(r)] == lowest]
        return candidates[0 if self.order == "first" else -1]

    def _outcome(self, request: Request) -> Outcome:
        if isinstance(request, Ask):
            return Answered(request.options[0])
        if isinstance(request, Suggest):
            return Suggested(replace(propose(request.query), seconds=0.0))
        parameters = request.parameters if isinstance(request, Simulate) else THETA
        spill = self.simulated if isinstance(request, Simulate) else self.real
        error = request.pose_error if isinstance(request, Simulate) else None
        try:
            spilled = spill(executed(request.action, error), parameters, np.random.default_rng(request.seed))
        except ValueError as invalid:
            return Failed("invalid_action", str(invalid))
        if math.isnan(spilled):
            return Failed("simulation" if isinstance(request, Simulate) else "pour_failed", "toy failure")
        spilled = min(max(spilled, 0.0), 1.0)
        if isinstance(request, Simulate):
            return Simulated(outcome_of(spilled, seed=request.seed))
        return Poured(PourMeasurement(loaded=LOADED, spilled=LOADED * spilled, retained=0.0))

    @property
    def simulations(self) -> list[Simulate]:
        """All simulations that were asked for."""
        return [r for r in self.asked if isinstance(r, Simulate)]

    @property
    def pours(self) -> list[Pour]:
        """All pours that were asked for."""
        return [r for r in self.asked if isinstance(r, Pour)]

    @property
    def real_spills(self) -> list[float]:
        """Share spilled in every weighed pour, 0 … 1."""
        return [o.measurement.fractions.spilled for _, o in self.told if isinstance(o, Poured)]


def replay(strategy: Strategy, run: StrategyHarness) -> list[Request]:
    """Tell a fresh strategy the outcomes of an earlier run, as a resumed campaign does.

    Args:
        strategy: made as the one of that run.
        run: the earlier run.

    Returns:
        All requests of the fresh strategy.

    Raises:
        AssertionError: it asks for something else than the first one did.
    """
    outcomes = iter(run.told)

    def recorded(request: Request) -> Outcome:
        expected, outcome = next(outcomes)
        if request != expected:
            raise AssertionError(
                f"the replayed strategy asks for {request!r}; it asked for {expected!r} before. The same seed and "
                "outcomes give the same requests, or no run can be resumed"
            )
        return outcome

    again = StrategyHarness(
        run.simulated, run.real, slots=run.slots, order=run.order, beside=run.beside, answer=recorded
    )
    return again.run(strategy).asked


def check_strategy(make: Callable[[], Strategy], simulated: SpillModel, real: SpillModel | None = None) -> None:
    """Check what holds for every strategy whose requests depend on outcomes alone.

    It finishes with one slot and with many; the order in which simulations return changes no request; a replay asks
    for the same; whatever fails, it ends with a result or a LearningError; its result can be written
    to a journal and read back.

    Args:
        make: makes the strategy, every time with the same seed.
        simulated, real: as of `StrategyHarness`.

    Raises:
        AssertionError: one of these does not hold, with the request that shows it.
    """
    for slots in (1, 3):
        strategy = make()
        first = StrategyHarness(simulated, real, slots=slots).run(strategy)
        _kept(strategy, "without a failure")
        last = StrategyHarness(simulated, real, slots=slots, order="last").run(make())
        for name, a, b in (("simulation", first.simulations, last.simulations), ("pour", first.pours, last.pours)):
            for number, (request, other) in enumerate(zip(a, b, strict=False), 1):
                if request != other:
                    raise AssertionError(
                        f"with {slots} slots {name} {number} is {request!r}, but {other!r} if the simulations return "
                        "in another order; requests depend on outcomes alone"
                    )
            if len(a) != len(b):
                raise AssertionError(
                    f"with {slots} slots there are {len(a)} requests of kind {name}, but {len(b)} if the simulations "
                    "return in another order; requests depend on outcomes alone"
                )
        replay(make(), first)
    for seed, share in enumerate((0.1, 0.5, 1.0)):
        strategy = make()
        try:
            StrategyHarness(simulated, real, slots=3, answer=failures(share, seed)).run(strategy)
        except LearningError:
            continue
        _kept(strategy, f"if {100 * share:.0f} % of the trials fail")


def _kept(strategy: Strategy, when: str) -> None:
    """Its result survives a journal."""
    result = strategy.result()
    try:
        written = json.dumps(encode_result(result), allow_nan=False)
        read = json.dumps(encode_result(decode_result(json.loads(written))), allow_nan=False)
    except (AttributeError, TypeError, ValueError, RunError) as error:
        raise AssertionError(
            f"{when} the strategy's result, {type(result).__name__}, cannot be kept in a journal: {error}; "
            "a result is a class of its own that derives from StageResult and declares its kind"
        ) from error
    if read != written:
        raise AssertionError(f"{when} the strategy's result is read back as {read}; it was written as {written}")


def failures(share: float, seed: int) -> Callable[[Request], Outcome | None]:
    """Failures of every kind, in a share of the trials; for `StrategyHarness(answer=…)`.

    Args:
        share: of simulations and pours, 0 … 1.
        seed: of the choice.
    """
    rng, lost = np.random.default_rng(seed), math.nan

    def fail(request: Request) -> Outcome | None:
        if isinstance(request, Suggest | Ask) or rng.random() >= share:
            return None
        if isinstance(request, Pour):
            return (
                Failed("pour_failed", "spilled by hand"),
                Failed("invalid_action", "touch"),
                Poured(PourMeasurement(LOADED, lost, 0.0)),
            )[int(rng.integers(3))]
        return (
            Failed("simulation", "diverged"),
            Failed("invalid_action", "cups touch"),
            Simulated(outcome_of(lost)),
            Simulated(replace(outcome_of(0.9), invalid="escaped 1.2 %")),
            Simulated(outcome_of(0.0, retained=1.0)),
            Simulated(outcome_of(0.3, retained=lost)),
        )[int(rng.integers(6))]

    return fail


def executed(action: Action, error: PoseError | None) -> Action:
    """The action that is executed if only distance, side and speed can be wrong."""
    if error is None:
        return action
    return action.with_values(
        x_offset=action.x_offset + error.x,
        y_offset=action.y_offset - error.y,
        angular_velocity=action.angular_velocity * error.speed_factor,
    )


def outcome_of(spilled: float, *, retained: float = 0.0, seed: int = 0, invalid: str | None = None) -> PourOutcome:
    """The outcome of a simulated pour.

    Args:
        spilled: share of the poured liquid that fell outside the receiver, 0 … 1.
        retained: share of the load that stayed in the pourer, 0 … 1.
        seed: of the simulation.
        invalid: why it does not count; None if it counts.
    """
    poured = 1.0 - retained
    return PourOutcome(
        received=poured * (1 - spilled),
        spilled=poured * spilled,
        retained=retained,
        in_flight=0.0,
        escaped=0.0,
        particles=2000,
        spacing=0.0046,
        density_error=0.01,
        simulated_time=3.0,
        steps=1000,
        cpu_s=1.0,
        seed=seed,
        invalid=invalid,
    )
