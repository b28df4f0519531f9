"""An action that the laboratory's arm can't make is an invalid action, simulated or poured: no plan recommends it."""

from __future__ import annotations

import asyncio
import math
from types import SimpleNamespace
from typing import Any

import pytest

import decant
from orchestrator.learning.requests import Failed, Pour, Simulate, Simulated
from orchestrator.runs.request_executor import Deadlines, RequestExecutor
from sim_engine.outcome import SimulatedPour
from sim_engine.scene import PoseError, PourTask
from tests.support.fake_simulator import FakeSimulator


class Pool:
    """A pool that simulates anything."""

    size = 1

    async def simulate(self, task: PourTask) -> SimulatedPour:
        return FakeSimulator().simulate(task)


@pytest.mark.parametrize(
    ("speed", "of_the_deployment", "purpose", "error", "outcome"),
    [
        (149.0, True, "plan", None, Simulated),
        (151.0, True, "plan", None, Failed),
        (151.0, False, "plan", None, Simulated),  # of pours that another arm has made
        (151.0, False, "design", None, Failed),  # of a calibration's pours, which this arm will make
        # an error of execution around an action that was refused as such
        (151.0, True, "plan", PoseError(x=0.001), Simulated),
    ],
)
def test_an_action_beyond_the_arm_is_refused_in_simulation_too(
    speed: float, of_the_deployment: bool, purpose: str, error: PoseError | None, outcome: type[Any]
) -> None:
    plan = decant.load_campaign(decant.shipped("campaigns/quickstart.yaml"))
    (scene,) = plan.deployment.scenes  # type: ignore[union-attr]
    made = [scene.name] if of_the_deployment else []
    laboratory: Any = SimpleNamespace(simulators=Pool())
    executor = RequestExecutor(
        laboratory, {scene.name: scene}, Deadlines(), 0.0, arm=plan.laboratory.arm, made_by_arm=made
    )
    action = scene.action({"angular_velocity": math.radians(speed), "x_offset": 0.1})
    request = Simulate(scene.name, action, plan.parameters, 0, purpose, error)
    answer, _ = asyncio.run(executor.simulate(request, record=False, started=lambda: None))
    assert isinstance(answer, outcome)
    if isinstance(answer, Failed):
        assert answer.kind == "invalid_action"
        assert "joint 6 (wrist 3) would turn at 151 deg/s" in answer.reason


def test_a_proposed_pour_that_the_arm_cannot_make_never_starts() -> None:
    """D2 proposes pours without simulating them."""
    plan = decant.load_campaign(decant.shipped("campaigns/quickstart.yaml"))
    (scene,) = plan.deployment.scenes  # type: ignore[union-attr]
    laboratory: Any = SimpleNamespace(simulators=Pool(), bench=None)
    laboratory.bench = SimpleNamespace(pour=lambda *_, **__: pytest.fail("the bench is asked to pour"))
    executor = RequestExecutor(laboratory, {scene.name: scene}, Deadlines(), 0.0, arm=plan.laboratory.arm)
    action = scene.action({"angular_velocity": math.radians(151.0), "x_offset": 0.1})
    started = lambda: pytest.fail("a refused pour is recorded as begun")  # noqa: E731
    outcome = asyncio.run(
        executor.pour(Pour(scene.name, action, 1, 0), started=started, progress=lambda _: None)  # type: ignore[arg-type]
    )
    assert isinstance(outcome, Failed)
    assert outcome.kind == "invalid_action"
    assert "joint 6 (wrist 3) would turn at 151 deg/s" in outcome.reason
