"""`pour_planner`: a planned pour is the pour that was asked for, made gently, inside its limits, without a jump."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from actors.arm.planned_pour import JointPath, PourPath
from actors.arm.planning.kinematics import cell_transforms, pourer_motion, pourer_transforms
from actors.arm.planning.path_checks import recheck
from actors.arm.planning.pour_planner import plan_path
from actors.arm.planning.trajectory import STEEPEST, TOOL_ACCELERATION
from actors.arm.ur.ur_kinematics import MODELS, forward
from actors.arm.ur_settings import UrArmSettings
from actors.arm_geometry import Plane, Point
from actors.interfaces import InvalidActionError
from orchestrator.campaigns.file_loading import load_campaign
from sim_engine.action import DEG
from sim_engine.collision import clearance, first_contact, rotations
from sim_engine.motion import plan_motion
from sim_engine.scene import Pivot
from sim_engine.vessel.vessel import build_vessel
from tests.support.counted_calls import counted_calls
from tests.support.hypothesis_examples import examples
from tests.support.planning_cell import ACTION, CONFIGS, LIMITS, SPEC, limited, motion, turned, vessel, waiting_at

actions = st.builds(
    lambda speed, angle, acceleration, hold, back, x, y, height: ACTION.with_values(
        angular_velocity=speed * DEG,
        max_angle=angle * DEG,
        angular_acceleration=acceleration * DEG,
        hold_time=hold,
        return_velocity=back * DEG,
        x_offset=x,
        y_offset=y,
        height=height,
    ),
    st.floats(10, 150), st.floats(20, 135), st.floats(50, 990), st.floats(0, 2), st.floats(20, 150),
    st.floats(0.09, 0.2), st.floats(-0.05, 0.05), st.floats(0.02, 0.3),
)  # fmt: skip


def planned(
    action=ACTION, spec: UrArmSettings = SPEC, receiver: str = "tumbler", pivot: Pivot | None = None
) -> PourPath:
    return plan_path(motion(action, receiver, pivot), spec, vessel("beaker"), vessel(receiver))


def dense(path: JointPath) -> tuple[np.ndarray, np.ndarray]:
    """Times that no waypoint knows of, and joints there."""
    times = np.linspace(0.0, path.duration, 701)
    return times, path.at(times)


@given(action=actions)
@settings(max_examples=examples(15), deadline=None)
def test_the_encoders_would_see_the_pour_that_was_asked_for(action):
    asked = motion(action)
    pour = plan_path(asked, SPEC, vessel("beaker"), vessel("tumbler")).pour
    assert pour.duration == pytest.approx(asked.duration)
    times, joints = dense(pour)
    seen, wanted = pourer_motion(joints, times, SPEC).poses, asked.sample(times)
    assert np.abs(seen[:, :3] - wanted[:, :3]).max() < 3e-4
    assert turned(rotations(seen), rotations(wanted)).max() < 0.1 * DEG
    assert len(pour.times) <= 1200


@pytest.mark.slow
@given(action=actions, direction=st.sampled_from([75, 90, 100]), tilt=st.floats(60, 140))
@settings(max_examples=examples(12), deadline=None)
def test_what_is_accepted_stays_inside_all_limits(action, direction, tilt):
    limits = LIMITS.with_values(
        tilt=tilt * DEG,
        joint_speed=140 * DEG,
        tool_speed=0.45,
        box=LIMITS.box.with_values(low=Point.of(0.3, -0.4, 0.1)),
        planes=(Plane(normal=(0.0, -1.0, 0.0), offset=-0.02), Plane(normal=(-0.6, 0.0, -0.8), offset=-0.9)),
    )
    spec = SPEC.with_values(limits=limits, cell=SPEC.cell.with_values(direction=direction * DEG))
    try:
        path = planned(action, spec)
    except InvalidActionError:
        assume(False)
    corners = vessel("beaker").solid_vertices
    for part in (path.approach, path.pour, path.retreat):
        times, joints = dense(part)
        step = times[1]
        assert np.abs(np.diff(joints, axis=0)).max() / step <= limits.joint_speed * (1 + 1e-6)
        pourer = pourer_transforms(joints, spec)
        points = pourer.position[:, None] + np.einsum("tij,vj->tvi", pourer.rotation, corners)
        flange = forward(joints, MODELS["ur10e"])
        tool = flange[1] + flange[0] @ cell_transforms(spec).tool.position
        everything = np.concatenate([points, tool[:, None]], axis=1)
        tolerance = 1e-4
        assert (everything >= np.array(limits.box.low.vector) - tolerance).all()
        assert (everything <= np.array(limits.box.high.vector) + tolerance).all()
        assert (everything[..., 2] >= spec.cell.table - tolerance).all()
        for plane in limits.planes:
            assert (everything @ np.array(plane.normal) >= plane.offset - tolerance).all()
        speeds = np.linalg.norm(np.diff(everything, axis=0), axis=-1) / step
        assert speeds.max() <= limits.tool_speed * 1.001
        leaning = np.arccos(np.clip(pourer.rotation[:, 2, 2], -1, 1))
        assert leaning.max() <= limits.tilt + 1e-6
        assert turned(pourer.rotation[1:], pourer.rotation[:-1]).max() / step <= limits.tilt_speed * 1.001
        assert first_contact(vessel("beaker"), vessel("tumbler"), pourer_motion(joints, times, spec).poses) is None


@given(action=actions)
@settings(max_examples=examples(15), deadline=None)
def test_the_three_parts_join_from_home_to_home(action):
    path = planned(action)
    np.testing.assert_allclose(path.approach.joints[0], SPEC.home.angles, atol=1e-9)
    np.testing.assert_allclose(path.approach.joints[-1], path.pour.joints[0], atol=1e-6)
    np.testing.assert_allclose(path.pour.joints[-1], path.retreat.joints[0], atol=1e-6)
    np.testing.assert_allclose(path.retreat.joints[-1], SPEC.home.angles, atol=1e-6)
    for part in (path.approach, path.pour, path.retreat):
        assert np.abs(np.diff(part.joints, axis=0)).max() < 5 * DEG
        recheck(part, SPEC)
    # phases are of the pour, and the tilts those of its waypoints
    assert (path.phases[0][1], path.phases[-1][2]) == (0.0, pytest.approx(path.pour.duration))
    assert path.tilts[-1] == pytest.approx(0.0, abs=1e-9)
    assert path.tilts.max() == pytest.approx(action.max_angle)


@given(action=actions)
@settings(max_examples=examples(15), deadline=None)
def test_a_full_pourer_travels_upright_and_gently(action):
    path = planned(action)
    for part in (path.approach, path.retreat):
        frames = pourer_transforms(part.joints, SPEC)
        assert np.arccos(np.clip(frames.rotation[:, 2, 2], -1, 1)).max() < 3 * DEG
        rates = np.diff(frames.position, axis=0) / np.diff(part.times)[:, None]
        middles = 0.5 * (part.times[1:] + part.times[:-1])
        accelerations = np.linalg.norm(np.diff(rates, axis=0), axis=1) / np.diff(middles)
        assert accelerations.max() < 1.05 * TOOL_ACCELERATION
        assert np.abs(np.diff(part.joints, axis=0) / np.diff(part.times)[:, None]).max() <= SPEC.approach_speed


@pytest.mark.parametrize("campaign", ["quickstart", pytest.param("paper", marks=pytest.mark.slow)])
def test_every_corner_of_the_shipped_campaigns_can_be_poured(campaign):
    plan = load_campaign(CONFIGS / "campaigns" / f"{campaign}.yaml")
    assert plan.calibration is not None
    assert plan.deployment is not None
    scenes = [(plan.calibration.scene, plan.calibration.actions)]
    scenes += [(scene, plan.deployment.actions) for scene in plan.deployment.scenes]
    for scene, actions in scenes:
        pourer, receiver = build_vessel(scene.pourer), build_vessel(scene.receiver)
        for corner in product((0.0, 1.0), repeat=actions.dimension):
            action = scene.action(actions.decode(list(corner)))
            found = plan_path(plan_motion(scene, action, pourer, receiver), SPEC, pourer, receiver).report
            assert found.singularity > 2 * LIMITS.singularity
            assert found.clearance > 2 * LIMITS.clearance


@pytest.mark.parametrize("receiver", ["bowl", "cone", "mug", "narrow", "tumbler"])
def test_pours_into_every_shipped_vessel(receiver):
    assert planned(ACTION.with_values(x_offset=0.125), receiver=receiver).report.tilt == pytest.approx(110 * DEG)


def test_a_pivot_inside_the_vessel_is_turned_about():
    path = planned(ACTION.with_values(x_offset=0.13), pivot=Pivot("point", 0.0, 0.05))
    seen = pourer_motion(path.pour.joints, path.pour.times, SPEC).poses
    middle = rotations(seen) @ np.array([0.0, 0.0, 0.05]) + seen[:, :3]
    assert np.abs(middle - middle[0]).max() < 1e-6


def test_a_pour_that_ends_tilted_is_brought_upright_where_it_is_and_carried_home():
    path = planned(ACTION.with_values(return_velocity=None))
    assert path.tilts[-1] == pytest.approx(ACTION.max_angle)
    assert [name for name, _, _ in path.phases] == ["tilt", "hold"]
    back = pourer_motion(path.retreat.joints, path.retreat.times, SPEC)
    tilts = back.tilt(path.retreat.times)
    lip = rotations(back.poses) @ vessel("beaker").lip_point() + back.poses[:, :3]
    turning = tilts > 1e-6
    assert np.abs(lip[turning] - lip[0]).max() < 3e-4
    rates = np.abs(np.diff(tilts)) / np.diff(path.retreat.times)
    assert rates.max() == pytest.approx(SPEC.upright_speed, rel=1e-3)
    np.testing.assert_allclose(path.retreat.joints[-1], SPEC.home.angles, atol=1e-6)


def test_a_step_in_speed_is_made_as_a_ramp_and_the_report_says_by_how_much_it_is_off():
    step = ACTION.with_values(angular_acceleration=None, angular_velocity=100 * DEG)
    path = planned(step)
    tilts = pourer_motion(path.pour.joints, path.pour.times, SPEC).tilt(path.pour.times)
    rates = np.diff(tilts) / np.diff(path.pour.times)
    middles = 0.5 * (path.pour.times[1:] + path.pour.times[:-1])
    assert np.abs(rates).max() == pytest.approx(100 * DEG, rel=1e-3)
    assert np.abs(np.diff(rates) / np.diff(middles)).max() < 1.01 * STEEPEST
    half_ramp = 0.5 * (100 * DEG) ** 2 / STEEPEST
    # the return starts later by a whole ramp and lags by half of its own
    assert half_ramp <= path.report.deviation < 4 * half_ramp
    assert planned().report.deviation == 0.0


def test_the_report_says_what_the_path_does():
    path = planned(ACTION.with_values(angular_velocity=140 * DEG, angular_acceleration=900 * DEG))
    found = path.report
    assert found.tilt == pytest.approx(110 * DEG, abs=1e-4)
    assert found.tilt_speed == pytest.approx(140 * DEG, rel=1e-2)
    assert (found.joint_speed, found.fastest_joint) == (pytest.approx(140 * DEG, rel=0.05), 5)
    assert found.duration == pytest.approx(path.approach.duration + path.pour.duration + path.retreat.duration)
    assert found.clearance == pytest.approx(0.098 - 0.044 - 0.036, abs=1e-3)  # walls side by side at the start
    lip_starts = 0.06 + 0.104 + 0.1
    assert found.low[2] == pytest.approx(lip_starts - 0.104, abs=1e-3)
    assert found.low[1] < -0.2


def test_where_the_straight_way_would_sweep_through_the_receiver_the_pourer_is_lifted_over_it():
    # waits low on the far side: the receiver stands between
    far = waiting_at(0.2, 0.0, 0.05)
    path = planned(ACTION.with_values(height=0.02), far)
    assert path.report.clearance >= LIMITS.clearance
    heights = pourer_transforms(path.approach.joints, far).position[:, 2]
    assert heights.max() > 0.06 + vessel("tumbler").rim_height


@given(action=actions)
@settings(max_examples=examples(10), deadline=None)
def test_the_nearest_approach_of_the_vessels_is_found_among_few_poses(action):
    spec = limited(clearance=0.0)
    try:
        path = planned(action, spec)
    except InvalidActionError:
        assume(False)
    times = np.linspace(0.0, path.pour.duration, 300)
    joints = path.pour.at(times)
    everywhere = clearance(vessel("beaker"), vessel("tumbler"), pourer_motion(joints, times, spec).poses).min()
    if everywhere < 0.012:  # beyond that it is an estimate
        assert path.report.clearance <= everywhere + 1.5e-3  # half a step, and the grid's own error
    near = [limit for limit in (2e-3, 5e-3, 9e-3) if everywhere < limit - 1.5e-3]
    for limit in near:
        with pytest.raises(InvalidActionError, match="of the receiver"):
            planned(action, limited(clearance=limit))


def test_other_robot_other_lengths():
    spec = SPEC.with_values(model="ur10")
    path = plan_path(motion(), spec, vessel("beaker"), vessel("tumbler"))
    seen = pourer_motion(path.pour.joints, path.pour.times, spec).poses
    np.testing.assert_allclose(seen[:, :3], motion().sample(path.pour.times)[:, :3], atol=1e-6)


def test_a_plan_takes_little_work():
    planned()
    with counted_calls() as calls:
        planned()
    assert calls.count < 25_000


def test_limits_are_looked_at_before_anything_is_planned():
    with pytest.raises(InvalidActionError, match=r"limits\.box: x of 'low'"):
        planned(spec=limited(box=LIMITS.box.with_values(low=Point.of(2.0, -0.6, 0.0))))


@pytest.mark.parametrize("x_offset", [0.108, 0.112])
def test_a_rim_that_swings_past_the_receiver_is_seen_where_it_is_nearest(x_offset):
    # about its middle: the lip comes down beside the receiver's rim and goes away again
    action, pivot = ACTION.with_values(x_offset=x_offset, height=0.01), Pivot("point", 0.0, 0.05)
    asked = motion(action, pivot=pivot)
    poses = asked.sample(np.linspace(0.0, asked.phases[0].end, 400))
    nearest = clearance(vessel("beaker"), vessel("tumbler"), poses).min()
    assert 1e-3 < nearest < 0.012
    with pytest.raises(InvalidActionError, match="of the receiver"):
        planned(action, limited(clearance=nearest + 1e-5), pivot=pivot)
    assert planned(action, limited(clearance=nearest - 2e-4), pivot=pivot).report.clearance < nearest + 2e-5
