"""`ur_controller`: the unmodified client library against the controller: moves, streams, questions, signals,
programs, dashboard.

Each scenario runs once (in a process of its own) and is judged by several tests. A test that is tried again has all of
them run again, on other controllers: fixtures of a module are renewed for it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from typing import Any

import numpy as np
import pytest

from actors.emulators.ur_controller import VirtualController
from actors.emulators.ur_controller.robot import MODELS
from actors.emulators.ur_controller.robot_kinematics import Kinematics, compose, pose_of, transform_of
from tests.actors.emulators.ur_controller.conftest import observe
from tests.support.loopback import free_address

pytestmark = pytest.mark.ur_rtde

Seen = Callable[[str], dict[str, Any]]

GENERATIONS = ["ur10", "ur10e"]
"""One model of each; the others differ in numbers only."""

SCALE = 8.0
"""Controller seconds per wall second, where a test doesn't need real time."""

HOME = [0.0, -1.5707963, 1.5707963, -1.5707963, -1.5707963, 0.0]


class Robot:
    """A controller, and what clients have seen of it; each scenario runs when a test asks for it first."""

    def __init__(self, model: str, controller: VirtualController) -> None:
        self.model = model
        self.controller = controller
        self._sightings: dict[str, dict[str, Any]] = {}

    def seen(self, scenario: str) -> dict[str, Any]:
        if scenario not in self._sightings:
            asked = {"model": self.model} if scenario == "questions" else {}
            self._sightings[scenario] = observe(scenario, self.controller.address, **asked)
        return self._sightings[scenario]


@pytest.fixture(scope="module")
def robots() -> Iterator[dict[str, Robot]]:
    """One of each generation."""
    with ExitStack() as stack:
        found = {}
        for model in GENERATIONS:
            controller = stack.enter_context(
                VirtualController.start(address=free_address(), model=model, time_scale=SCALE)
            )
            controller.fault("inputs", digital={"3": True, "4": False}, analog=[3.3])
            found[model] = Robot(model, controller)
        yield found


@pytest.fixture(params=[pytest.param("ur10", marks=pytest.mark.slow), "ur10e"])
def robot(request: pytest.FixtureRequest, robots: dict[str, Robot]) -> Robot:
    return robots[request.param]


@pytest.fixture
def seen(robot: Robot) -> Seen:
    return robot.seen


def near(values: list[float], tolerance: float = 2e-5) -> Any:
    return pytest.approx(values, abs=tolerance)


# ---- moves


@pytest.mark.realtime
def test_a_move_returns_true_and_ends_at_its_target(seen: Seen) -> None:
    moves = seen("moves")
    assert moves["moveJ"] is True
    assert moves["moveJ reached"] == near(moves["moveJ target"])


@pytest.mark.realtime
def test_a_move_takes_as_long_as_its_trapezoid_says(robot: Robot, seen: Seen) -> None:
    history = robot.controller.fault("history", since=seen("moves")["moveJ time"])
    times, joints = np.array(history["times"]), np.array(history["joints"])
    # Joints follow their targets with a lag, so that the last micrometres take a moment longer.
    moving = times[1:][np.abs(np.diff(joints, axis=0)).max(axis=1) > 1e-5]
    pauses = np.flatnonzero(np.diff(moving) > 0.02)
    end = moving[pauses[0]] if len(pauses) else moving[-1]
    # 0.5 rad at 1.05 rad/s and 1.4 rad/s² never reaches full speed
    assert end - moving[0] == pytest.approx(2 * (0.5 / 1.4) ** 0.5, abs=0.05)


# ---- streams


@pytest.mark.realtime
def test_a_stream_of_targets_is_followed_to_its_end(seen: Seen) -> None:
    streams = seen("streams")
    assert streams["servoJ reached"] == near(streams["servoJ target"], 2e-4)


@pytest.mark.realtime
def test_speeds_are_reached_and_stopped(seen: Seen) -> None:
    streams = seen("streams")
    assert streams["speedJ"] == near([0.0, 0.0, 0.0, 0.0, 0.0, -0.4], 2e-3)
    assert streams["speedJ after"] == near([0.0] * 6)


# ---- questions


@pytest.mark.realtime
def test_kinematics_agree_with_the_lengths_of_the_model(robot: Robot, seen: Seen) -> None:
    asked = seen("questions")
    flange = Kinematics(MODELS[robot.model]).flange(asked["q"])
    assert asked["pose"] == near(pose_of(flange), 1e-9)


@pytest.mark.realtime
def test_tool_and_payload_are_read_back_as_set(seen: Seen) -> None:
    asked = seen("questions")
    assert asked["tcp before"] == near([0.0] * 6)
    assert asked["tcp"] == near([0.0, 0.02, 0.15, 0.0, 0.0, 0.4])
    expected = compose(transform_of(asked["pose"]), transform_of(asked["tcp"]))
    assert asked["pose with tcp"] == near(pose_of(expected), 1e-6)
    assert asked["payload"] == near([0.75, 0.0, 0.0, 0.06])


@pytest.mark.realtime
def test_state_is_told_as_a_real_controller_does(robot: Robot, seen: Seen) -> None:
    asked = seen("questions")
    assert asked["robot"] == [7, 1, 2]  # running, normal, playing
    assert asked["status"] == [3, 1]  # power on and program running; normal
    assert asked["joint modes"] == [253] * 6
    assert asked["steady"] is True
    if robot.model == "ur10e":  # the library's script does not ask CB3 controllers for it
        assert asked["step time"] == pytest.approx(0.002)


# ---- asynchronous moves


@pytest.mark.realtime
def test_an_asynchronous_move_runs_and_can_be_stopped(seen: Seen) -> None:
    asynchronous = seen("asynchronous")
    assert asynchronous["started"] is True
    assert asynchronous["new operation"] is True
    assert asynchronous["running"] is True
    assert asynchronous["not steady"] is False
    assert asynchronous["stands after stopJ"] is True
    assert 0.5 < asynchronous["stopped at"] < 1.95  # short of 2; how far depends on when a busy client comes to it
    assert asynchronous["finished"] is True


# ---- signals and programs


@pytest.mark.realtime
def test_outputs_and_registers_are_set_and_read_back(seen: Seen) -> None:
    signals = seen("signals")
    assert signals["sent"] == [True] * 8
    assert signals["bits"] == 1 << 1 | 1 << 10 | 1 << 16
    assert signals["state"] == [False, True, True, True]
    assert signals["analog"] == near([2.5, 0.012])
    assert signals["slider"] == 0.6
    assert signals["echo"] == [43, 5.0]
    assert signals["off"] is True


@pytest.mark.realtime
def test_inputs_that_are_wired_are_seen(seen: Seen) -> None:
    assert seen("signals")["inputs"] == [True, False, 3.3]


@pytest.mark.realtime
def test_custom_programs_run_and_the_library_s_own_comes_back(seen: Seen) -> None:
    scripts = seen("scripts")
    assert (scripts["function"], scripts["script"], scripts["still works"]) == (True, True, True)
    assert scripts["reached"] == near([*HOME[:5], 0.3])
    assert scripts["output"] is True
    assert scripts["script reached"] == near([0.0, -1.5, 1.5, -1.5, -1.5, 0.2])


@pytest.mark.realtime
def test_the_dashboard_answers_in_the_manual_s_words(robot: Robot, seen: Seen) -> None:
    dashboard = seen("dashboards")
    assert dashboard["robotmode"] == "Robotmode: RUNNING"
    assert dashboard["safetymode"] == "Safetymode: NORMAL"
    assert dashboard["safetystatus"] == "Safetystatus: NORMAL"
    assert dashboard["model"] == "UR10"
    assert dashboard["loaded"] == "No program loaded"
    assert dashboard["play"] == "RuntimeError: Failed to execute: play"
    assert dashboard["load"] == "RuntimeError: File not found: pour.urp"
    assert [dashboard[k] for k in ("popup", "close popup", "close safety popup", "log", "unlock")] == [None] * 5
    assert (dashboard["off"], dashboard["idle"], dashboard["on"]) == ("Robotmode: POWER_OFF", True, True)
    if robot.model == "ur10e":
        assert dashboard["version"].startswith("5.12")
        assert dashboard["serial"].isdigit()
        assert dashboard["remote"] is True
    else:
        assert dashboard["version"].startswith("3.15")


# ---- several at once


@pytest.mark.realtime
def test_a_second_control_interface_is_told_that_the_registers_are_in_use(seen: Seen) -> None:
    second = seen("second")
    assert "already in use" in second["second"]
    assert second["first still moves"] is True


@pytest.mark.slow
@pytest.mark.realtime
def test_a_move_that_is_not_emulated_ends_the_program_and_a_new_upload_helps(seen: Seen) -> None:
    unsupported = seen("unsupported")
    assert (unsupported["moveL"], unsupported["program runs"]) == (False, False)
    assert unsupported["moves again"] is True
    assert unsupported["force mode ends program"] is True


@pytest.mark.slow
@pytest.mark.realtime
def test_two_robots_side_by_side_keep_out_of_each_other_s_way(robots: dict[str, Robot]) -> None:
    with ThreadPoolExecutor(len(robots)) as pool:
        seen = list(pool.map(lambda robot: observe("moves", robot.controller.address), robots.values()))
    assert all(moves["moveJ reached"] == near(moves["moveJ target"]) for moves in seen)
    poses = [robot.seen("questions")["pose"] for robot in robots.values()]
    assert poses[0] != near(poses[1], 1e-3)
    assert len({robot.controller.address for robot in robots.values()}) == 2


# ---- time


@pytest.mark.slow
@pytest.mark.realtime
@pytest.mark.parametrize(("model_name", "rate"), [("ur10e", 500), ("ur10", 125)])
def test_in_real_time_the_clock_is_right_and_packages_come_at_the_controller_s_rate(model_name: str, rate: int) -> None:
    with VirtualController.start(address=free_address(), model=model_name) as controller:
        seen = observe("receiving", controller.address, seconds=1.5, frequency=rate)
        timing = controller.fault("state")["timing"]
    assert seen["clock"] == pytest.approx(1.0, abs=0.2)
    assert seen["step"] == pytest.approx(1.0 / rate, rel=1e-3)
    assert timing["cpu"] < 0.25
