"""`path_checks`: each way in which a pour can be impossible or forbidden is said in words, before anything moves."""

from __future__ import annotations

import numpy as np
import pytest

from actors.arm.planned_pour import JointPath
from actors.arm.planning.path_checks import recheck
from actors.arm.planning.pour_planner import plan_path
from actors.arm.ur_settings import UrArmSettings
from actors.arm_geometry import Box, JointAngles, Plane, Point, Pose
from actors.interfaces import InvalidActionError
from sim_engine.action import DEG, Action
from sim_engine.scene import Pivot
from tests.support.planning_cell import ACTION, LIMITS, SPEC, limited, motion, placed, vessel, waiting_at


def refusal(spec: UrArmSettings = SPEC, action: Action = ACTION, pivot: Pivot | None = None) -> str:
    with pytest.raises(InvalidActionError) as caught:
        plan_path(motion(action, pivot=pivot), spec, vessel("beaker"), vessel("tumbler"))
    return str(caught.value)


WIDE = {"box": Box(low=Point.of(-2.0, -2.0, -1.0), high=Point.of(2.0, 2.0, 2.0))}


def open_cell(**cell: object) -> UrArmSettings:
    """No box in the way."""
    return placed(**cell).with_values(limits=LIMITS.with_values(**WIDE))


def test_a_pour_out_of_reach_says_by_how_much():
    text = refusal(open_cell(receiver=Point.of(1.12, 0.0, 0.06)), ACTION.with_values(x_offset=0.4, y_offset=-0.3))
    assert "out of the arm's reach by" in text
    assert "move the receiver nearer" in text


def test_a_tilt_that_leads_out_of_reach_is_told_with_its_moment():
    # upright it is still in reach; the tilt lifts what is gripped
    text = refusal(open_cell(receiver=Point.of(0.75, 0.0, 0.92)))
    assert "at the tilt's end, 1.93 s into the pour: out of the arm's reach by 14 mm" in text
    assert "approach" not in text


def test_a_receiver_too_near_to_the_base():
    assert "the wrist 77 mm from above the base's axis, 118 mm" in refusal(
        open_cell(receiver=Point.of(0.45, 0.0, 0.06))
    )
    text = refusal(open_cell(receiver=Point.of(0.4, 0.0, 0.06)))
    assert "mm too near to the arm's base; move the receiver away from it" in text


def test_an_almost_straight_elbow_is_told_in_degrees():
    spec = open_cell(receiver=Point.of(1.44, 0.0, 0.06))
    text = refusal(spec.with_values(limits=spec.limits.with_values(singularity=0.32)))
    assert "elbow 16.7 deg from straight, 18.7 deg are asked for; move the receiver nearer or lower" in text


def test_a_wrist_that_loses_a_direction():
    text = refusal(open_cell(direction=40 * DEG))
    assert "at the tilt's end, 1.93 s into the pour: wrist 2 2.5 deg from where joints 4 and 6 turn about" in text
    assert "5.7 deg are asked for; turn 'direction'" in text


def test_a_way_through_a_singularity_is_told_as_that_and_not_by_the_speeds_it_would_need():
    text = refusal(open_cell(direction=35 * DEG))
    assert "home holds the pourer as for a direction of 90 deg, and cell.direction is 35 deg" in text
    assert "turned by 55 deg on its way, through a place where two joints turn about one axis" in text
    assert "joint 6 (wrist 3) would have to race; set cell.direction nearer to 90 deg" in text
    assert "would turn at" not in text
    assert "into the approach" not in text


def test_a_joint_that_would_turn_too_fast_is_named_with_its_speed():
    text = refusal(limited(joint_speed=50 * DEG))
    assert "joint 6 (wrist 3) would turn at 90 deg/s" in text
    assert "s into the return; 50 deg/s are allowed" in text


def test_the_robot_s_own_joint_speeds_hold_besides():
    text = refusal(limited(joint_speed=350 * DEG, tilt_speed=350 * DEG), ACTION.with_values(angular_velocity=200 * DEG))
    assert "joint 6 (wrist 3) would turn at 200 deg/s" in text
    assert "180 deg/s are allowed" in text


def test_a_joint_beyond_its_range():
    home = JointAngles.of(*SPEC.home.angles[:5], -300 * DEG)
    # the same pose of the pourer, tool turned to match, so that wrist 3 starts near the end of its range
    grip = SPEC.grip
    turned = SPEC.with_values(home=home, tool=Pose(z=0.17, rz=300 * DEG), grip=grip)
    assert "joint 6 (wrist 3) would turn to -4" in refusal(turned)
    assert "its range is ±363 deg" in refusal(turned)


def test_a_pourer_that_would_turn_too_fast():
    text = refusal(limited(tilt_speed=80 * DEG))
    assert "the pourer would turn at 90 deg/s" in text
    assert "80 deg/s are allowed" in text


def test_a_point_of_the_pourer_that_would_move_too_fast():
    assert "tool or pourer would move at 0." in refusal(limited(tool_speed=0.1))


def test_a_tilt_beyond_the_limit():
    text = refusal(limited(tilt=100 * DEG))
    assert "the pourer would lean 110.0 deg, at the tilt's end, 1.93 s into the pour; 100.0 deg are allowed" in text


def test_a_rim_that_would_leave_the_box():
    text = refusal(limited(box=LIMITS.box.with_values(high=Point.of(1.0, -0.03, 0.9))))
    assert "cell.receiver: (0.750, 0.000) m lies outside limits.box" in text
    text = refusal(limited(box=LIMITS.box.with_values(high=Point.of(1.0, 0.4, 0.35))))
    assert "home: the tool is outside the box, at z = 0.4" in text
    low = waiting_at(-0.3, 0.0, 0.12).with_values(
        limits=LIMITS.with_values(box=LIMITS.box.with_values(high=Point.of(1.0, 0.4, 0.26))),
    )
    text = refusal(low)
    assert "the pourer's rim would leave the box at z = 0.2" in text
    assert "at most 0.260 m are allowed" in text
    assert "0.00 s into the approach" in text


def test_an_underside_that_would_rise_out_of_the_box():
    spec = waiting_at(-0.3, 0.0, 0.12).with_values(
        limits=LIMITS.with_values(box=LIMITS.box.with_values(high=Point.of(1.0, 0.4, 0.32))),
    )
    text = refusal(spec, ACTION.with_values(max_angle=130 * DEG))
    assert "the pourer's underside would leave the box at z = 0.3" in text
    assert "s into the pour" in text or "into the tilt" in text


def test_a_plane_that_would_be_crossed():
    plane = Plane(normal=(0.0, -1.0, 0.0), offset=0.0)
    text = refusal(limited(planes=(plane,), clearance=0.0), ACTION.with_values(x_offset=0.085, max_angle=130 * DEG))
    assert "the pourer's underside would go" in text or "the pourer's rim would go" in text
    assert "mm beyond plane 1" in text


def test_a_pourer_that_would_go_below_the_table():
    text = refusal(
        placed(receiver=Point.of(0.75, 0.0, 0.0), table=0.0), ACTION.with_values(height=-0.15, x_offset=0.25)
    )
    assert "the pourer's underside would go" in text
    assert "mm below the table, at the approach's end" in text


def test_vessels_that_would_touch_or_come_too_near():
    near = refusal(action=ACTION.with_values(x_offset=0.082))
    assert "the pourer would come within 2.0 mm of the receiver at a tilt of 0 deg, at the approach's end" in near
    assert "a larger x_offset or height clears it" in near
    assert near.count("come within") == 1
    assert "the pourer would touch the receiver at a tilt of 0 deg" in refusal(action=ACTION.with_values(x_offset=0.08))
    through = refusal(action=ACTION.with_values(height=0.01), pivot=Pivot("point", 0.0, 0.05))
    assert "mm into the receiver at a tilt of" in through
    assert "into the tilt" in through


def test_a_gripper_that_would_reach_into_the_receiver():
    # held far from the fingers, the pourer stands beside the receiver and the gripper in it
    spec = SPEC.with_values(grip=Pose(x=-0.1, y=-0.06, rx=-90 * DEG))
    text = refusal(spec.with_values(limits=LIMITS.with_values(**WIDE)), ACTION.with_values(height=-0.02))
    assert "the gripper would come within" in text
    assert "mm of the receiver, " in text
    assert "3 mm have to stay free" in text


def test_a_clearance_that_nobody_can_measure():
    assert "limits.clearance: 20 mm is more than the 12 mm" in refusal(limited(clearance=0.02))


def test_a_wrist_that_would_touch_the_table():
    low = placed(receiver=Point.of(0.75, 0.0, 0.0))
    text = refusal(low, ACTION.with_values(x_offset=0.2, height=-0.13, max_angle=30 * DEG))
    assert "the wrist would come 130 mm" in text
    assert "mm too near to the table, at the approach's end" in text


def test_a_pourer_that_would_touch_the_arm_itself():
    text = refusal(open_cell().with_values(tool=Pose(x=-0.2, z=-0.3)))  # a tool that reaches back along the forearm
    assert "the carried vessel would run 39 mm into the arm's forearm, 1.86 s into the tilt" in text
    assert "3 mm have to stay free: turn 'direction', or wait at another 'home'" in text


def test_a_home_that_leans():
    assert "home: the pourer leans 10.0 deg there" in refusal(
        SPEC.with_values(home=JointAngles.of(*SPEC.home.angles[:5], 10 * DEG))
    )


def test_a_pour_that_only_another_posture_reaches():
    text = refusal(open_cell(receiver=Point.of(0.75, 0.0, 1.0)))
    assert "out of the arm's reach by" in text
    assert "another posture of the arm would reach it" in text


def test_all_that_is_wrong_comes_at_once():
    spec = limited(tilt=100 * DEG, tilt_speed=80 * DEG, joint_speed=50 * DEG, tool_speed=0.1)
    text = refusal(spec, ACTION.with_values(x_offset=0.08))
    assert text.startswith("the arm can't make this pour:\n  - ")
    for said in ("lean 110", "turn at 90 deg/s", "joint 6", "would move at", "the receiver at a tilt"):
        assert said in text


def test_what_can_be_said_of_a_pour_out_of_reach_is_said_too():
    far = open_cell(receiver=Point.of(1.12, 0.0, 0.06))
    spec = far.with_values(limits=LIMITS.with_values(**WIDE, tilt=100 * DEG))
    text = refusal(spec, ACTION.with_values(x_offset=0.4, y_offset=-0.3))
    assert "out of the arm's reach" in text
    assert "the pourer would lean 110.0 deg" in text


PATH = plan_path(motion(), SPEC, vessel("beaker"), vessel("tumbler")).pour


def rechecked(path: JointPath = PATH, spec: UrArmSettings = SPEC) -> str:
    with pytest.raises(InvalidActionError) as caught:
        recheck(path, spec)
    return str(caught.value)


def test_a_planned_path_passes_the_second_look():
    recheck(PATH, SPEC)


def test_a_path_is_looked_at_again_with_the_limits_of_the_moment():
    assert "joint 6 (wrist 3) would turn at" in rechecked(spec=limited(joint_speed=50 * DEG))
    assert "the tool would leave the box at z" in rechecked(
        spec=limited(box=LIMITS.box.with_values(high=Point.of(1.0, 0.4, 0.2)))
    )
    assert "mm beyond plane 1" in rechecked(spec=limited(planes=(Plane(normal=(0.0, 0.0, -1.0), offset=-0.2),)))
    assert "below the table" in rechecked(spec=placed(table=0.25))


def test_a_path_that_jumps_or_leaves_a_joint_s_range():
    jumping = PATH.joints.copy()
    jumping[100:, 5] += 2 * np.pi
    assert "joint 6 (wrist 3) would jump by 359 deg, 1.60 s into the path" in rechecked(JointPath(PATH.times, jumping))
    assert "its range is ±363 deg" in rechecked(JointPath(PATH.times, PATH.joints + np.array([0, 0, 0, 0, 0, -5.5])))


@pytest.mark.parametrize("broken", ["nan", "back", "late", "five", "one"])
def test_a_path_of_nonsense(broken):
    times, joints = PATH.times.copy(), PATH.joints.copy()
    if broken == "nan":
        joints[7, 2] = np.nan
    elif broken == "back":
        times[7] = times[6]
    elif broken == "late":
        times += 1.0
    elif broken == "five":
        joints = joints[:, :5]
    else:
        times, joints = times[:1], joints[:1]
    assert "path" in rechecked(JointPath(times, joints))
