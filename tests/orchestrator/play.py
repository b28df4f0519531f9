"""Plays whole campaigns of a strategy against plain functions, in milliseconds: no clock, no actors."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from actors.optimizer.core.propose import propose
from orchestrator.plan import CalibrationPlan, DeploymentPlan
from orchestrator.requests import (
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
from orchestrator.strategies.protocol import Strategy
from sim_engine.action import DEG, Action
from sim_engine.liquid import Liquid, SimulationParameters
from sim_engine.losses import Loss
from sim_engine.outcome import PourMeasurement, PourOutcome
from sim_engine.space import Axis, Space
from sim_engine.task import PoseError, Scene
from sim_engine.vessel.spec import cylinder
from tests.orchestrator import plans

Spill = Callable[[Action, SimulationParameters, np.random.Generator], float]
"""Fraction spilled of everything poured; raising ValueError makes the action invalid, NaN makes the trial fail."""

ACTIONS = Space((Axis("angular_velocity", 15 * DEG, 120 * DEG), Axis("x_offset", 0.08, 0.15)))
CALIBRATION_ACTIONS = Space((Axis("angular_velocity", 15 * DEG, 120 * DEG), Axis("max_angle", 70 * DEG, 125 * DEG)))
PARAMETERS = Space((Axis("particles", 500, 4000, "log", integer=True), Axis("cohesion", 0.0, 0.1)))
SCENE = Scene(
    "cup",
    cylinder("beaker", inner_radius=0.04, inner_height=0.1),
    cylinder("cup", inner_radius=0.035, inner_height=0.1),
    Liquid(mass=0.2),
    fixed={"height": 0.05, "x_offset": 0.1},
)
THETA = SimulationParameters()


def calibration_plan(**changes: Any) -> CalibrationPlan:
    values: dict[str, Any] = {
        "scene": SCENE,
        "actions": CALIBRATION_ACTIONS,
        "parameters": PARAMETERS,
        "fixed_parameters": {"friction": 0.1},
        "pour_count": 32,
        "holdout": 4,
    }
    if changes.get("strategy", "C4") == "C4":
        values["simulations"] = 60
    return plans.calibration(**values | changes)


def deployment_plan(**changes: Any) -> DeploymentPlan:
    values: dict[str, Any] = {"scenes": (SCENE,), "actions": ACTIONS, "loss": Loss(), "pours": 8}
    if changes.get("strategy", "D3") == "D3":
        values["prior_simulations"] = 20
    return plans.deployment(**values | changes)


def executed(action: Action, error: PoseError | None) -> Action:
    """What comes of an action where nothing but distance, side and speed can be off."""
    if error is None:
        return action
    return action.with_values(
        x_offset=action.x_offset + error.x,
        y_offset=action.y_offset - error.y,
        angular_velocity=action.angular_velocity * error.speed_factor,
    )


def unit(action: Action, space: Space = ACTIONS) -> np.ndarray:
    return space.encode({name: getattr(action, name) for name in space.names})


def outcome_of(spilled: float, *, retained: float = 0.0, seed: int = 0, invalid: str | None = None) -> PourOutcome:
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


class Play:
    """Asks, answers and tells until the strategy has finished; keeps everything that was said.

    Args:
        simulated: spillage of a simulated pour.
        real: of a weighed one.
        slots: logical slots of the simulation lane.
        order: which of the open simulations is answered next: 'first' or 'last'.
        answer: overrides the answer to a request; None leaves it to the functions.
        beside: simulations answered while a pour is under way; None: all there are.
    """

    def __init__(
        self,
        simulated: Spill,
        real: Spill | None = None,
        *,
        slots: int = 2,
        order: str = "first",
        answer: Callable[[Request], Outcome | None] = lambda request: None,
        limit: int = 5000,
        beside: int | None = None,
    ) -> None:
        self.simulated, self.real = simulated, real or simulated
        self.slots, self.order, self.answer, self.limit = slots, order, answer, limit
        self.beside, self._since_pour = beside, 0
        self.asked: list[Request] = []
        self.told: list[tuple[Request, Outcome]] = []

    def __call__(self, strategy: Strategy) -> Play:
        waiting: list[Request] = []
        for _ in range(self.limit):
            if strategy.finished:
                assert not waiting, "finished while an answer was out"
                return self
            free = self.slots - sum(isinstance(r, Simulate) for r in waiting)
            arm = 1 - sum(isinstance(r, Pour) for r in waiting)
            requests = strategy.ask(Slots(free, arm))
            assert sum(isinstance(r, Simulate) for r in requests) <= free
            assert sum(isinstance(r, Pour) for r in requests) <= arm
            self.asked += requests
            waiting += requests
            if not waiting:
                assert strategy.finished, "asks for nothing, waits for nothing, is not finished"
                continue
            request = self._next(waiting)
            waiting.remove(request)
            outcome = self.answer(request) or self._outcome(request)
            self.told.append((request, outcome))
            strategy.tell(request, outcome)
        raise AssertionError(f"not finished after {self.limit} steps")

    def _next(self, waiting: list[Request]) -> Request:
        """Questions first; a pour takes longer than the simulations beside it."""
        rank: dict[type, int] = {Suggest: 0, Ask: 0, Simulate: 1, Pour: 2}
        if self.beside is not None and any(isinstance(r, Pour) for r in waiting):
            self._since_pour += 1
            if self._since_pour > self.beside:
                rank[Pour], self._since_pour = -1, 0
        lowest = min(rank[type(r)] for r in waiting)
        candidates = [r for r in waiting if rank[type(r)] == lowest]
        return candidates[0 if self.order == "first" else -1]

    def _outcome(self, request: Request) -> Outcome:
        if isinstance(request, Suggest):
            return Suggested(replace(propose(request.problem), seconds=0.0))
        parameters = request.parameters if isinstance(request, Simulate) else THETA
        spill = self.simulated if isinstance(request, Simulate) else self.real
        error = request.pose_error if isinstance(request, Simulate) else None
        try:
            spilled = spill(executed(request.action, error), parameters, np.random.default_rng(request.seed))
        except ValueError as error:
            return Failed("invalid_action", str(error))
        if math.isnan(spilled):
            return Failed("simulation" if isinstance(request, Simulate) else "pour_failed", "toy failure")
        spilled = min(max(spilled, 0.0), 1.0)
        if isinstance(request, Simulate):
            return Simulated(outcome_of(spilled, seed=request.seed))
        return Poured(PourMeasurement(loaded=0.2, spilled=0.2 * spilled, retained=0.0))

    @property
    def simulations(self) -> list[Simulate]:
        return [r for r in self.asked if isinstance(r, Simulate)]

    @property
    def pours(self) -> list[Pour]:
        return [r for r in self.asked if isinstance(r, Pour)]

    @property
    def real_spills(self) -> list[float]:
        return [o.measurement.fractions.spilled for _, o in self.told if isinstance(o, Poured)]


def replay(strategy: Strategy, played: Play) -> list[Request]:
    """Ask a fresh strategy the same way and tell it the same outcomes; what it asks for."""
    again = Play(played.simulated, played.real, slots=played.slots, order=played.order)
    journal = iter(played.told)

    def from_journal(request: Request) -> Outcome:
        expected, outcome = next(journal)
        assert request == expected, "the replay asks for something else"
        return outcome

    again.answer = from_journal
    return again(strategy).asked
