"""`mover`: the arm's targets, cycle by cycle: how long, how fast, how straight, and that they never jump."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from actors.emulators.ur_controller.controller import RuntimeState
from actors.emulators.ur_controller.robot import HOME
from actors.emulators.ur_controller.rtde_fields import OutputRecipe, output_fields
from actors.emulators.ur_controller.safety_system import SafetyConfiguration, SafetyMode, SafetyPlane
from tests.actors.emulators.ur_controller.conftest import Bench
from tests.support.hypothesis_examples import examples

DT = 0.002


def moved(q: tuple[float, ...], **by: float) -> list[float]:
    """Joint positions with some changed: j0=0.5, say."""
    return [a + by.get(f"j{i}", 0.0) for i, a in enumerate(q)]


def test_a_joint_move_takes_as_long_as_its_trapezoid(bench: Bench) -> None:
    # 1 rad at 1.05 rad/s and 1.4 rad/s²: 1/1.05 + 1.05/1.4 = 1.702 s
    took = bench.run(f"movej({moved(HOME, j0=1.0)}, a=1.4, v=1.05)")
    assert took == pytest.approx(1 / 1.05 + 1.05 / 1.4, abs=3 * DT)
    assert bench.joints[-1] == pytest.approx(moved(HOME, j0=1.0))
    assert np.abs(bench.speeds).max() == pytest.approx(1.05, rel=1e-3)


def test_a_joint_move_with_a_time_takes_that_time(bench: Bench) -> None:
    assert bench.run(f"movej({moved(HOME, j0=1.0)}, t=3.0)") == pytest.approx(3.0, abs=3 * DT)


def test_all_joints_arrive_together(bench: Bench) -> None:
    bench.run(f"movej({moved(HOME, j0=0.5, j5=-1.0)})")
    path = np.array(bench.joints) - HOME
    assert path[:, 0] == pytest.approx(-0.5 * path[:, 5], abs=1e-9)


def test_no_joint_exceeds_its_limit_whatever_speed_is_asked_for(bench: Bench) -> None:
    bench.run(f"movej({moved(HOME, j0=2.0)}, a=20, v=3.1)")
    assert np.abs(bench.speeds[:, 0]).max() == pytest.approx(math.radians(120), rel=1e-3)
    assert bench.controller.safety.mode is SafetyMode.NORMAL


def test_a_servo_follows_an_even_ramp_late_by_the_lookahead_time(bench: Bench) -> None:
    bench.run(
        f"""
q = {list(HOME)}
i = 0
while i < 1000:
  q[5] = q[5] + 0.001
  servoj(q, t=0.002, lookahead_time=0.05, gain=300)
  i = i + 1
end
"""
    )
    assert bench.speeds[900, 5] == pytest.approx(0.5, rel=1e-3)
    assert (1.0 - bench.joints[-1][5]) / 0.5 == pytest.approx(0.05, rel=0.1)


def test_a_servo_target_too_far_away_is_a_protective_stop_and_no_jump(bench: Bench) -> None:
    bench.start(f"while True:\n  servoj({moved(HOME, j0=2.0)}, t=0.002, lookahead_time=0.03, gain=2000)\nend")
    bench.tick(1.0)
    assert bench.controller.safety.mode is SafetyMode.PROTECTIVE_STOP
    assert "joint 1 (base)" in bench.said("safety")[0]
    assert np.abs(bench.speeds[:, 0]).max() < 1.11 * math.radians(120)


def test_speedj_ramps_up_and_the_arm_stops_when_nobody_asks_any_more(bench: Bench) -> None:
    bench.run("speedj([0, 0, 0, 0, 0, 0.5], a=1, t=1.0)")
    bench.tick(0.5)
    speeds = bench.speeds[:, 5]
    assert speeds[249] == pytest.approx(0.5, rel=0.02)
    assert speeds[300:490] == pytest.approx(0.5)
    assert speeds[-1] == 0.0
    assert np.abs(np.diff(speeds)).max() <= 5.0 * DT + 1e-9


@pytest.mark.parametrize(("stop", "rate"), [("stopj", 2.0), ("stopj", 0.5)])
def test_a_stop_takes_as_long_as_its_deceleration_says(bench: Bench, stop: str, rate: float) -> None:
    took = bench.run(f"speedj([0, 0, 0, 0, 0, 0.5], a=10, t=0.2)\n{stop}({rate})")
    assert took == pytest.approx(0.2 + 0.5 / rate, abs=5 * DT)
    assert bench.speeds[-1, 5] == pytest.approx(0.0, abs=rate * DT)


def test_killing_the_thread_that_moves_stops_the_arm_softly(bench: Bench) -> None:
    bench.run(
        f"""
thread mover():
  movej({moved(HOME, j0=2.0)}, a=1.4, v=1.0)
end
t = run mover()
sleep(1.0)
kill t
sleep(1.0)
"""
    )
    assert 0.3 < bench.joints[-1][0] < 1.0
    assert bench.speeds[-1] == pytest.approx(np.zeros(6))
    assert np.abs(np.diff(bench.speeds[:, 0])).max() <= 5.0 * DT + 1e-9


def test_two_threads_can_not_move_the_arm_at_once(bench: Bench) -> None:
    bench.run(f"thread other():\n  movej({moved(HOME, j0=1.0)})\nend\nt = run other()\nsync()\nmovej({list(HOME)})")
    assert bench.said("exception") == ["another thread is already controlling the robot"]


def test_the_speed_slider_slows_a_move_down(bench: Bench) -> None:
    bench.robot.mover.slider = 0.5
    took = bench.run(f"movej({moved(HOME, j0=1.0)}, a=1.4, v=1.05)")
    assert took == pytest.approx(2 * (1 / 1.05 + 1.05 / 1.4), rel=0.01)


def test_moving_the_slider_during_a_move_makes_no_jump_in_speed(bench: Bench) -> None:
    bench.start(f"movej({moved(HOME, j0=1.5)}, a=1.4, v=1.0)")
    bench.tick(1.0)
    bench.robot.mover.slider = 0.1
    bench.tick(20.0)
    assert bench.joints[-1] == pytest.approx(moved(HOME, j0=1.5))
    assert np.abs(np.diff(bench.speeds[:, 0])).max() < 2.5 * DT


def servo_along(turn: float, seconds: float) -> str:
    """A program that turns joint 0 at a constant speed, a target for every cycle."""
    return f"""
q = {list(HOME)}
t = 0.0
while t < {seconds}:
  t = t + get_steptime()
  q[0] = {HOME[0]} + {turn} * t / {seconds}
  servoj(q, 0, 0, get_steptime(), 0.03, 300)
end
t = 0.0
while t < 0.3:
  t = t + get_steptime()
  servoj(q, 0, 0, get_steptime(), 0.03, 300)
end
stopj(6)
"""


@pytest.mark.parametrize("slider", [1.0, 0.5, 0.25])
def test_the_speed_slider_stretches_a_path_of_servo_commands(bench: Bench, slider: float) -> None:
    """A controller at 0.5 covers half of the way to a target in the target's time (ros2_controllers, speed scaling)."""
    bench.robot.mover.slider = slider
    assert bench.run(servo_along(0.6, 2.0)) == pytest.approx(2.3 / slider, rel=0.01)
    assert bench.joints[-1][0] == pytest.approx(HOME[0] + 0.6, abs=1e-4)
    assert np.abs(bench.speeds[:, 0]).max() == pytest.approx(0.3 * slider, rel=0.05)


@pytest.mark.parametrize("slider", [1.0, 0.5])
def test_a_spline_of_speed_commands_reaches_its_end_at_any_slider(bench: Bench, slider: float) -> None:
    """As the manufacturer's own program does, which reads no slider (external_control.urscript, issue 194)."""
    bench.robot.mover.slider = slider
    bench.run("""
t = 0.0
last = 0.0
while t < 2.0:
  t = t + get_steptime()
  v = 0.6 * 3.0 * t / 2.0 * (1.0 - t / 2.0)
  speedj([v, 0, 0, 0, 0, 0], norm(v - last) / get_steptime(), get_steptime())
  last = v
end
""")
    assert bench.joints[-1][0] == pytest.approx(HOME[0] + 0.6, abs=2e-3)


def test_with_the_slider_at_0_the_arm_stands_while_its_program_plays(bench: Bench) -> None:
    """Reported of a real controller: Universal_Robots_ROS_Driver, issue 737."""
    bench.start(servo_along(0.6, 2.0))
    bench.tick(1.0)
    bench.robot.mover.slider = 0.0
    bench.tick(1.0)
    stands = bench.joints[-1]
    bench.tick(30.0)
    assert bench.joints[-1] == stands
    assert bench.controller.runtime is RuntimeState.PLAYING
    assert bench.robot.mover.scaling * bench.robot.mover.slider == 0.0
    bench.robot.mover.slider = 1.0
    bench.tick(3.0)
    assert bench.controller.runtime is RuntimeState.STOPPED
    assert bench.joints[-1][0] == pytest.approx(HOME[0] + 0.6, abs=1e-4)
    assert np.abs(np.diff(bench.speeds[:, 0])).max() < 0.02  # neither stop nor start is a jump


def test_a_safety_plane_ends_the_move_before_it_is_far_beyond(bench: Bench) -> None:
    own = SafetyConfiguration.of(bench.controller.model)
    # the tool may go 0.1 m in y
    y = bench.robot.pose[1]
    wall = SafetyPlane((0.0, -1.0, 0.0), -(y + 0.1))
    bench.controller.configure_safety(SafetyConfiguration(own.joint_ranges, own.joint_speeds, planes=(wall,)))
    bench.start(f"movej({moved(HOME, j0=-1.0)}, a=1.2, v=0.2)")
    bench.tick(3.0)
    assert bench.controller.safety.mode is SafetyMode.PROTECTIVE_STOP
    assert "safety plane 0" in bench.said("safety")[0]
    assert 0.1 < bench.points[-1][1] - y < 0.12


def test_after_a_plane_stopped_it_the_tool_may_move_back(bench: Bench) -> None:
    test_a_safety_plane_ends_the_move_before_it_is_far_beyond(bench)
    bench.tick(6.0)
    assert bench.controller.unlock_protective_stop() is None
    bench.controller.stop()
    bench.tick()
    bench.run(f"movej({list(HOME)})")
    assert bench.controller.safety.mode is SafetyMode.NORMAL
    assert bench.joints[-1] == pytest.approx(HOME)


def test_a_tool_too_fast_is_a_protective_stop(bench: Bench) -> None:
    own = SafetyConfiguration.of(bench.controller.model)
    bench.controller.configure_safety(SafetyConfiguration(own.joint_ranges, own.joint_speeds, tool_speed=0.5))
    bench.start(f"movej({moved(HOME, j0=3.0)}, a=10, v=1.5)")
    bench.tick(3.0)
    assert bench.tool_speeds.max() < 1.15 * 0.5
    assert bench.controller.safety.mode is SafetyMode.PROTECTIVE_STOP
    assert "m/s" in bench.said("safety")[0]


def test_a_move_beyond_a_joint_s_range_is_refused(bench: Bench) -> None:
    bench.start(f"movej({moved(HOME, j5=7.0)})")
    bench.tick(0.1)
    assert bench.controller.safety.mode is SafetyMode.PROTECTIVE_STOP
    assert bench.joints[-1] == pytest.approx(HOME)


@pytest.mark.parametrize(
    "move",
    ["movel(p[0.3, 0.3, 0.3, 0, 0, 0])", "movej(p[0.3, 0.3, 0.3, 0, 0, 0])", "movej([0, 0, 0, 0, 0, 0], r=0.1)"],
)
def test_a_move_that_is_not_emulated_ends_the_program_with_its_line(bench: Bench, move: str) -> None:
    bench.run(f"x = 1\n{move}")
    assert "not supported by this virtual controller" in bench.said("exception")[0]
    assert [m.line for m in bench.messages if m.kind == "exception"] == [3]
    assert bench.controller.runtime is RuntimeState.STOPPED
    assert bench.robot.mover.q == HOME


_numbers = st.floats(-3.0, 3.0, allow_nan=False)
_rates = st.floats(0.05, 3.0)
_joints = st.lists(_numbers, min_size=6, max_size=6)
_commands = st.one_of(
    st.builds(lambda q, a, v: f"movej({q}, a={a}, v={v})", _joints, _rates, _rates),
    st.builds(lambda q, a, t: f"speedj({q}, a={a}, t={t})", _joints, _rates, st.floats(0.0, 0.5)),
    st.builds(lambda q: f"servoj({q}, t=0.1)", _joints),
    st.builds(lambda a: f"stopj({a})", _rates),
    st.builds(lambda p: f"set_tcp(p{[0.1 * k for k in p]})", _joints),
    st.just("sync()"),
)


@settings(max_examples=examples(40), deadline=None)
@given(commands=st.lists(_commands, min_size=1, max_size=6), cut=st.floats(0.1, 4.0), what=st.integers(0, 4))
def test_whatever_a_program_commands_no_joint_s_target_ever_jumps(commands: list[str], cut: float, what: int) -> None:
    bench = Bench(frequency=125)
    bench.start("\n".join(commands))
    bench.tick(cut)
    controller = bench.controller
    interruptions = [
        controller.stop,
        lambda: controller.protective_stop("test"),
        controller.emergency_stop,
        lambda: controller.set_safeguard(True),
        lambda: None,
    ]
    interruptions[what]()
    bench.tick(4.0)
    limits = 1.11 * np.array(controller.model.joint_speed)
    assert (np.abs(bench.speeds) <= limits).all()
    if what < 4:
        assert np.abs(bench.speeds[-1]).max() == 0.0


_extremes = st.sampled_from([0, 1, -1, 1e-300, -1e-300, 1e-9, 1e9, 1e300, -1e300, 6.3, -6.3, 3.1415926535897931, 1e16])
_six = st.lists(_extremes, min_size=6, max_size=6)
_wild = st.one_of(
    st.builds(lambda q, a, v, t, r: f"movej({q}, a={a}, v={v}, t={t}, r={r})", _six, *[_extremes] * 4),
    st.builds(
        lambda q, t, look, gain: f"servoj({q}, t={t}, lookahead_time={look}, gain={gain})", _six, *[_extremes] * 3
    ),
    st.builds(lambda q, a, t: f"speedj({q}, a={a}, t={t})", _six, _extremes, _extremes),
    st.builds(lambda name, a: f"{name}({a})", st.sampled_from(["stopj", "sleep"]), _extremes),
    st.builds(lambda p: f"set_tcp(p{p})", _six),
    st.builds(lambda m, c: f"set_payload({m}, {c[:3]})", _extremes, _six),
    st.builds(lambda d: f"set_gravity({d[:3]})", _six),
)


@settings(max_examples=examples(150), deadline=None)
@given(commands=st.lists(_wild, min_size=1, max_size=4), slider=st.sampled_from([0.0, 1e-9, 1.0]))
def test_the_wildest_numbers_neither_move_an_arm_wildly_nor_stop_the_controller(
    commands: list[str], slider: float
) -> None:
    bench = Bench(frequency=125)
    bench.robot.mover.slider = slider
    for command in commands:
        bench.start(command)
        bench.tick(0.2)
        bench.controller.protective_stop("the next one, please")
        bench.tick(5.1)
        assert bench.controller.unlock_protective_stop() is None
        bench.controller.stop()
        bench.tick(0.1)
    assert np.isfinite(np.array(bench.joints)).all()
    assert (np.abs(bench.speeds) <= 1.11 * np.array(bench.controller.model.joint_speed)).all()
    fields = output_fields(bench.controller)
    OutputRecipe(1, list(fields.values())).package()
    bench.robot.mover.slider = 1.0
    bench.run("set_tcp(p[0, 0, 0, 0, 0, 0])\nset_gravity([0, 0, 9.82])")
    bench.run(f"movej({list(HOME)})", limit=100.0)
    assert bench.joints[-1] == pytest.approx(HOME)
