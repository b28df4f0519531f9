"""`urdf_chain`: any arm from its URDF, compared with a UR's closed forms; and what is no arm is refused."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import trimesh

pytest.importorskip("pinocchio")

from actors.arm.joint_arm import UnreachedError
from actors.arm.planned_pour import JointPath
from actors.arm.planning.kinematics import flange_poses
from actors.arm.planning.path_checks import check_limits
from actors.arm.ur.robot_models import MODELS
from actors.arm.ur.ur_kinematics import kinematics_of
from actors.arm.urdf_chain import ChainError, ChainModel
from actors.arm_geometry import Point
from actors.interfaces import InvalidActionError
from decant.plugins import plan_pour
from tests.plugins.decant_example.seven_joints import SevenJointKind
from tests.plugins.test_seven_joints import CELL, SETTINGS
from tests.plugins.test_stand import ACTION, SCENE

_LIMIT = '<limit lower="-6.3" upper="6.3" velocity="3.1" effort="1"/>'


UR_ORIGINS = {
    "ur3": (0.1519, -0.24365, -0.21325, 0.11235, -0.08535, 0.0819),
    "ur5": (0.089159, -0.425, -0.39225, 0.10915, -0.09465, 0.0823),
    "ur10": (0.1273, -0.612, -0.5723, 0.163941, -0.1157, 0.0922),
    "ur3e": (0.15185, -0.24355, -0.2132, 0.13105, -0.08535, 0.0921),
    "ur5e": (0.1625, -0.425, -0.3922, 0.1333, -0.0997, 0.0996),
    "ur10e": (0.1807, -0.6127, -0.57155, 0.17415, -0.11985, 0.11655),
    "ur16e": (0.1807, -0.4784, -0.36, 0.17415, -0.11985, 0.11655),
    "ur20": (0.2363, -0.862, -0.7287, 0.201, -0.1593, 0.1543),
    "ur30": (0.2363, -0.637, -0.5037, 0.201, -0.1593, 0.1543),
}
"""shoulder z, forearm x, wrist 1 x and z, wrist 2 y, wrist 3 y [m] of the manufacturer's URDF.

Source: `config/*/default_kinematics.yaml` of Universal_Robots_ROS2_Description, commit 2221ec0.
"""


def urdf_of(name: str) -> str:
    """The manufacturer's chain of a robot, from 'base' on, with the joints' origins of its `ur_macro.xacro`."""
    shoulder, forearm, wrist, across, second, third = UR_ORIGINS[name]
    origins = [
        f'xyz="0 0 {shoulder}" rpy="0 0 0"',
        'xyz="0 0 0" rpy="1.570796327 0 0"',
        f'xyz="{forearm} 0 0" rpy="0 0 0"',
        f'xyz="{wrist} 0 {across}" rpy="0 0 0"',
        f'xyz="0 {second} 0" rpy="1.570796327 0 0"',
        f'xyz="0 {third} 0" rpy="1.570796326589793 3.141592653589793 3.141592653589793"',
    ]
    frames = ["base", *(f"link{k}" for k in range(5)), "flange"]
    joints = [
        f'<joint name="joint{k}" type="revolute"><origin {origin}/><parent link="{frames[k]}"/>'
        f'<child link="{frames[k + 1]}"/><axis xyz="0 0 1"/>{_LIMIT}</joint>'
        for k, origin in enumerate(origins)
    ]
    links = "".join(f'<link name="{frame}"/>' for frame in frames)
    return f'<robot name="{name}">{links}{"".join(joints)}</robot>'


def written(folder: Path, text: str) -> Path:
    path = folder / "arm.urdf"
    path.write_text(text)
    return path


@pytest.mark.parametrize("name", UR_ORIGINS)
def test_a_ur_from_its_urdf_is_the_ur_in_closed_form(name: str, tmp_path: Path) -> None:
    chain = ChainModel(written(tmp_path, urdf_of(name)), "base", "flange")
    closed = kinematics_of(MODELS[name])
    joints = np.random.default_rng(1).uniform(-3.0, 3.0, (200, 6))
    (turned, there), (rotation, position) = chain.forward(joints), closed.forward(joints)
    assert np.linalg.norm(there - position, axis=-1).max() < 1e-5, "0.01 mm"
    assert np.abs(turned - rotation).max() < 1e-6
    home = np.radians([-14.0, -91.0, -115.0, -154.0, -104.0, 0.0])
    way = home + np.linspace(0.0, 1.0, 60)[:, None] * np.radians([20.0, -10.0, 15.0, 0.0, 5.0, 80.0])
    assert chain.follow(*closed.forward(way), way[0], home) == pytest.approx(way, abs=1e-6)


def test_joints_are_a_function_of_the_pose_and_keep_their_posture() -> None:
    path = SevenJointKind(SETTINGS).plan(SCENE, ACTION)
    steps = np.abs(np.diff(path.pour.joints, axis=0)).max()
    assert steps < math.radians(3.0), "the elbow flips"
    assert path.pour.joints[-1] == pytest.approx(path.pour.joints[0], abs=1e-5), "the pour ends where it began"
    wanted = plan_pour(SCENE, ACTION).sample(path.pour.times)
    poses = SevenJointKind(SETTINGS).figure().pourer(path.pour.joints)
    assert poses[:, :3] == pytest.approx(wanted[:, :3], abs=1e-6)
    assert np.abs(np.sum(poses[:, 3:] * wanted[:, 3:], axis=1)).min() == pytest.approx(1.0, abs=1e-9)


def test_a_change_of_posture_on_the_way_is_refused() -> None:
    """The same poses, begun on the other side of the elbow, are no way from this home."""
    chain, home = SETTINGS.kinematics, np.array(SETTINGS.home)
    rotation, position = chain.forward(np.array([home, home + 1.2 * np.eye(7)[3], home]))
    with pytest.raises(UnreachedError):
        chain.follow(rotation, position, home, home)


def test_a_pour_beyond_its_reach_is_refused_with_the_distance_and_the_remedy() -> None:
    far = SETTINGS.with_values(cell=CELL.with_values(receiver=Point.of(0.97, 0.0, 0.15)))
    with pytest.raises(InvalidActionError, match=r"the arm 0\.08 from a singular pose, 0\.10 are asked for; move the"):
        SevenJointKind(far).plan(SCENE, ACTION)
    chain = SETTINGS.kinematics
    flange = flange_poses(np.array([[0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0], [0.6, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0]]), far)
    index, text = chain.out_of_reach(flange.rotation, flange.position, np.array(SETTINGS.home))
    assert (index, text.partition(" by ")[0]) == (1, "out of the arm's reach")
    farther = SETTINGS.with_values(cell=CELL.with_values(receiver=Point.of(2.0, 0.0, 0.15)))
    assert any("out of reach by" in text for text in check_limits(farther))


def test_a_link_that_meets_the_receiver_is_refused() -> None:
    """The collision geometry of the URDF counts: held behind the flange, the pourer brings the last link down."""
    behind = SETTINGS.with_values(grip=SETTINGS.grip.with_values(z=-0.2))
    with pytest.raises(InvalidActionError, match=r"the link7 would come within -\d mm of the receiver"):
        SevenJointKind(behind).plan(SCENE, ACTION)


ARM = urdf_of("ur10e")


@pytest.mark.parametrize(
    ("text", "flange", "message"),
    [
        (ARM, "tool0", r"has no link 'tool0'; there are base, link0, .*flange"),
        (ARM, "base", r"no joint moves link 'base' against link 'base'"),
        (ARM.replace(_LIMIT, "", 1).replace("revolute", "continuous", 1), "flange", r"'joint0' turns without limits"),
        (ARM.replace("revolute", "prismatic", 1), "flange", r"'joint0' is a PZ; a revolute joint with limits"),
        (ARM.replace('upper="6.3"', 'upper="-6.3"', 1), "flange", r"'joint0' has no limits; add <limit"),
        (ARM[:300], "flange", r"can't be read as a URDF"),
        (
            ARM.replace('<link name="link2"/>', '<link name="link2"><collision><geometry><mesh filename="no.stl"/>'
                        "</geometry></collision></link>"),
            "flange",
            r"collision geometry can't be read .*no.stl.*; meshes are sought in its folder and above",
        ),
    ],
)  # fmt: skip
def test_what_is_no_arm_is_refused_with_the_reason(text: str, flange: str, message: str, tmp_path: Path) -> None:
    with pytest.raises(ChainError, match=message):
        ChainModel(written(tmp_path, text), "base", flange)


def test_meshes_of_a_package_are_read_however_deep_in_it_the_urdf_is(tmp_path: Path) -> None:
    """As in example-robot-data, see issues 1477 and 1639 of Pinocchio; and without a package, see 1747."""
    folder = tmp_path / "package" / "robots" / "arm_description" / "urdf"
    folder.mkdir(parents=True)
    trimesh.creation.box((0.1, 0.1, 0.4)).export(folder.parent / "link.stl")
    for name in (
        "package://package/robots/arm_description/link.stl",
        "package://arm_description/link.stl",
        "../link.stl",
    ):
        link = f'<link name="link2"><collision><geometry><mesh filename="{name}"/></geometry></collision></link>'
        chain = ChainModel(written(folder, ARM.replace('<link name="link2"/>', link)), "base", "flange")
        assert [bar.name for bar in chain.bars] == ["link2", "gripper"]


def test_links_lie_within_their_capsules() -> None:
    chain = SETTINGS.kinematics
    assert [link.name for link in chain.bars] == ["link1", "link3", "link5", "link7", "gripper"]
    joints = np.random.default_rng(2).uniform(-1.5, 1.5, (20, 7))
    points = chain.points(joints)
    first, second = (points[:, [getattr(link, end) for link in chain.bars[1:4]]] for end in ("first", "second"))
    lengths = np.linalg.norm(first - second, axis=-1)
    assert lengths == pytest.approx(np.tile([0.27, 0.29, 0.026], (20, 1)), abs=1e-9)
    assert isinstance(JointPath(np.array([0.0, 1.0]), joints[:2]).duration, float)
