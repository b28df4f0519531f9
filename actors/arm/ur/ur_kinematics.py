"""Kinematics of UR robots in closed form, on arrays of whole paths.

- `forward`, `inverse` and `posture` are the closed forms of `ur_controller.robot_kinematics` on arrays; `refined` adds
  the calibration of one robot.
- `UrKinematics` offers them to planning.

The virtual controller computes one pose every 2 ms. A planner computes a thousand at once, and distinguishes the
postures in which a pose can be reached. Both take the robots' lengths from one table; tests compare their results.

A *posture* is one of eight ways to reach a pose. It is defined by the side of the base's axis on which the shoulder is,
and by the directions in which wrist and elbow are bent. A path that avoids singularities stays in one posture.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from actors.arm.joint_arm import ArmModel, LinkCapsule, UnreachedError
from actors.arm.ur.robot_models import MODELS, SAME_ANGLE, SAME_PLACE, Calibration, RobotModel
from actors.arm_geometry import JOINT_NAMES

__all__ = ["MODELS", "beyond_reach", "forward", "inverse", "link_points", "posture", "refined", "singularities"]

FloatArray = NDArray[np.float64]

POSTURES = 8

_SINGULAR_WRIST = 1e-6
"""Below this |sin q5| joints 4 and 6 rotate about the same axis; joint 6 is then set to 0."""


def forward(q: FloatArray, m: RobotModel) -> tuple[FloatArray, FloatArray]:
    """Pose of the flange.

    Args:
        q: joints, shape (..., 6) [rad].
        m: the robot.

    Returns:
        Rotation matrices (..., 3, 3) and positions (..., 3) [m], base frame.
    """
    if m.calibration is not None:
        return _chain(q, m.calibration)[2:]
    s1, c1, s5, c5, s6, c6 = (f(q[..., k]) for k in (0, 4, 5) for f in (np.sin, np.cos))
    q23 = q[..., 1] + q[..., 2]
    s, c = np.sin(q23 + q[..., 3]), np.cos(q23 + q[..., 3])
    # x and z of the frame after joint 4; its y is (s1, −c1, 0), the axis of joints 2 to 4
    x = np.stack([c1 * c, s1 * c, s], axis=-1)
    z = np.stack([c1 * s, s1 * s, -c], axis=-1)
    across = np.stack([s1, -c1, np.zeros_like(s1)], axis=-1)
    a = x * c5[..., None] + across * s5[..., None]
    tool = -x * s5[..., None] + across * c5[..., None]
    rotation = np.stack([a * c6[..., None] - z * s6[..., None], -a * s6[..., None] - z * c6[..., None], tool], axis=-1)
    reach = m.a2 * np.cos(q[..., 1]) + m.a3 * np.cos(q23)
    height = m.d1 + m.a2 * np.sin(q[..., 1]) + m.a3 * np.sin(q23)
    position = np.stack([c1 * reach, s1 * reach, height], axis=-1) + m.d4 * across + m.d5 * z + m.d6 * tool
    return rotation, position


def _chain(q: FloatArray, dh: Calibration) -> tuple[list[FloatArray], list[FloatArray], FloatArray, FloatArray]:
    """Directions of the joints' axes and a point on each, rotation and position of the flange of a calibrated robot."""
    rotation = np.broadcast_to(np.eye(3), (*q.shape[:-1], 3, 3))
    position = np.zeros((*q.shape[:-1], 3))
    axes, points = [], []
    for k in range(6):
        s, c = np.sin(q[..., k] + dh.theta[k]), np.cos(q[..., k] + dh.theta[k])
        sa, ca = np.sin(dh.alpha[k]), np.cos(dh.alpha[k])
        zero = np.zeros_like(s)
        columns = [(c, s, zero), (-s * ca, c * ca, zero + sa), (s * sa, -c * sa, zero + ca)]
        turned = np.stack([np.stack(column, axis=-1) for column in columns], axis=-1)
        axes.append(rotation[..., 2])
        points.append(position)
        step = np.stack([dh.a[k] * c, dh.a[k] * s, zero + dh.d[k]], axis=-1)
        position = position + (rotation @ step[..., None])[..., 0]
        rotation = rotation @ turned
    return axes, points, rotation, position


NEWTON_STEPS = 6
"""Most steps from the closed form's joints to those of a calibrated robot; two or three are usual."""


def refined(q: FloatArray, rotation: FloatArray, position: FloatArray, m: RobotModel) -> FloatArray:
    """Joints of a calibrated robot, by Newton steps from those of the closed form; the same joints if it is nominal.

    Args:
        q: joints that nearly reach the poses, shape (T, 6) [rad]; NaN if there are none.
        rotation, position: of the flange, shapes (T, 3, 3) and (T, 3) [m].
        m: the robot.

    Returns:
        Shape (T, 6) [rad]; NaN where there are none, as beyond the reach.
    """
    if m.calibration is None:
        return q
    q, solved = q.copy(), np.isfinite(q).all(axis=-1)
    for step in range(NEWTON_STEPS + 1):
        axes, points, flange, place = _chain(q[solved], m.calibration)
        apart = rotation[solved] @ np.swapaxes(flange, -1, -2)
        turn = 0.5 * np.stack([apart[:, 2, 1] - apart[:, 1, 2], apart[:, 0, 2] - apart[:, 2, 0],
                               apart[:, 1, 0] - apart[:, 0, 1]], axis=-1)  # fmt: skip
        error = np.concatenate([position[solved] - place, turn], axis=-1)
        if step == NEWTON_STEPS or not np.any(np.abs(error) > 1e-11):
            break
        columns = [
            np.concatenate([np.cross(axis, place - point), axis], axis=-1)
            for axis, point in zip(axes, points, strict=True)
        ]
        jacobian = np.stack(columns, axis=-1)
        transposed = np.swapaxes(jacobian, -1, -2)
        # slightly damped, so that a singular pose is no error here: its joints do not converge, and are NaN below
        change = np.linalg.solve(transposed @ jacobian + 1e-14 * np.eye(6), transposed @ error[..., None])
        q[solved] += change[..., 0]
    q[solved] = np.where(np.abs(error).max(axis=-1, keepdims=True) < 1e-8, q[solved], np.nan)
    return q


def inverse(rotation: FloatArray, position: FloatArray, m: RobotModel) -> FloatArray:
    """All postures that reach a pose of the flange; see `refined` for calibrated robots.

    Args:
        rotation: of the flange, shape (T, 3, 3).
        position: shape (T, 3) [m], base frame.
        m: the robot.

    Returns:
        Shape (T, 8, 6) [rad], each joint in −π … π, NaN if the pose is out of reach. Along a path a posture keeps its
        number: 4·shoulder + 2·wrist + elbow.
    """
    out = np.full((len(position), POSTURES, 6), np.nan)
    for number, (q1, q5, q6, q234, u, v) in enumerate(_wrists(rotation, position, m)):
        cos3 = (u * u + v * v - m.a2 * m.a2 - m.a3 * m.a3) / (2.0 * m.a2 * m.a3)
        with np.errstate(invalid="ignore"):
            bend = np.arccos(np.where(np.abs(cos3) > 1.0 + 1e-9, np.nan, np.clip(cos3, -1.0, 1.0)))
        for elbow, q3 in enumerate((bend, -bend)):
            q2 = np.arctan2(v, u) - np.arctan2(m.a3 * np.sin(q3), m.a2 + m.a3 * np.cos(q3))
            q = np.stack([q1, q2, q3, q234 - q2 - q3, q5, q6], axis=-1)
            q = np.where(np.isfinite(q).all(axis=-1, keepdims=True), q, np.nan)
            q = q - 2.0 * np.pi * np.round(q / (2.0 * np.pi))
            out[:, 2 * number + elbow] = refined(q, rotation, position, m)
    return out


def _wrists(rotation: FloatArray, position: FloatArray, m: RobotModel) -> Iterator[tuple[FloatArray, ...]]:
    """The four wrist postures.

    Each is given by q1, q5, q6, q2 + q3 + q4 and the position to which elbow and shoulder have to bring wrist 1, in the
    arm's plane from the shoulder [m]. All have shape (T,) and are NaN if the wrist cannot reach the pose."""
    r = rotation
    w = position - m.d6 * r[:, :, 2]
    radius = np.hypot(w[:, 0], w[:, 1])
    with np.errstate(invalid="ignore", divide="ignore"):
        # there is no solution inside the cylinder about the base that the wrist cannot enter: asin gives NaN
        offset = np.arcsin(np.where(radius < m.d4 - 1e-9, np.nan, np.minimum(1.0, m.d4 / radius)))
    bearing = np.arctan2(w[:, 1], w[:, 0])
    for q1 in (bearing + offset, bearing + np.pi - offset):
        s1, c1 = np.sin(q1), np.cos(q1)
        bend = np.arccos(np.clip(s1 * r[:, 0, 2] - c1 * r[:, 1, 2], -1.0, 1.0))
        for sign in (1.0, -1.0):
            q6 = np.arctan2(-sign * (s1 * r[:, 0, 1] - c1 * r[:, 1, 1]), sign * (s1 * r[:, 0, 0] - c1 * r[:, 1, 0]))
            q6 = np.where(np.abs(np.sin(bend)) < _SINGULAR_WRIST, 0.0, q6)
            z = -(r[:, :, 0] * np.sin(q6)[:, None] + r[:, :, 1] * np.cos(q6)[:, None])
            q234 = np.arctan2(c1 * z[:, 0] + s1 * z[:, 1], -z[:, 2])
            u = c1 * (w[:, 0] - m.d5 * z[:, 0]) + s1 * (w[:, 1] - m.d5 * z[:, 1])
            yield q1, sign * bend, q6, q234, u, w[:, 2] - m.d5 * z[:, 2] - m.d1


def posture(q: FloatArray, m: RobotModel) -> int:
    """Number of the posture of joints (6,), as `inverse` counts."""
    rotation, position = forward(q[None], m.nominal)
    solutions = inverse(rotation, position, m.nominal)[0]
    apart = np.abs(np.angle(np.exp(1j * (solutions - q)))).max(axis=-1)
    return int(np.nanargmin(apart))


def singularities(q: FloatArray, m: RobotModel) -> FloatArray:
    """Distance of joints from singularities, shape (..., 3): shoulder, elbow, wrist; 0 is singular.

    Elbow and wrist: |sin| of their angle. Shoulder: distance of the wrist from the plane through the base's axis and
    along joint 2's, divided by the length of both links.
    """
    q23 = q[..., 1] + q[..., 2]
    u = m.a2 * np.cos(q[..., 1]) + m.a3 * np.cos(q23) + m.d5 * np.sin(q23 + q[..., 3])
    shoulder = np.abs(u) / (abs(m.a2) + abs(m.a3))
    return np.stack([shoulder, np.abs(np.sin(q[..., 2])), np.abs(np.sin(q[..., 4]))], axis=-1)


def beyond_reach(rotation: FloatArray, position: FloatArray, m: RobotModel) -> FloatArray:
    """Distance of poses beyond the reach, shape (T, 8) [m], in every posture as `inverse` counts; 0 within reach.

    Negative if a pose is too near for the arm to fold or, inside the base's own cylinder, for the wrist to get there.
    """
    distances = np.stack([np.hypot(u, v) for *_, u, v in _wrists(rotation, position, m)], axis=-1)
    too_far = distances - abs(m.a2) - abs(m.a3)
    too_near = distances - abs(abs(m.a2) - abs(m.a3))
    w = position - m.d6 * rotation[:, :, 2]
    inside = (np.hypot(w[:, 0], w[:, 1]) - m.d4)[:, None]
    beyond = np.where(too_far > 0.0, too_far, np.minimum(too_near, 0.0))
    return np.repeat(np.where(np.isnan(distances), inside, beyond), 2, axis=-1)


def link_points(q: FloatArray, m: RobotModel) -> FloatArray:
    """Points along the arm's middle line, shape (..., 8, 3) [m].

    Shoulder, both ends of the upper arm, both ends of the forearm, wrist 1, wrist 2, flange. Upper arm and forearm run
    side by side: the upper arm is farther out by about d4, the forearm by a quarter of that.
    """
    s1, c1 = np.sin(q[..., 0]), np.cos(q[..., 0])
    zero = np.zeros_like(s1)
    radial, across = np.stack([c1, s1, zero], axis=-1), np.stack([s1, -c1, zero], axis=-1)
    up = np.array([0.0, 0.0, 1.0])
    q23 = q[..., 1] + q[..., 2]
    s, c = np.sin(q23 + q[..., 3]), np.cos(q23 + q[..., 3])
    shoulder = np.broadcast_to(m.d1 * up, across.shape)
    elbow = shoulder + m.a2 * (np.cos(q[..., 1])[..., None] * radial + np.sin(q[..., 1])[..., None] * up)
    w1 = elbow + m.a3 * (np.cos(q23)[..., None] * radial + np.sin(q23)[..., None] * up)
    w2 = w1 + m.d4 * across
    w3 = w2 + m.d5 * (s[..., None] * radial - c[..., None] * up)
    _, flange = forward(q, m.nominal)
    outside, inside = m.d4 * across, 0.25 * m.d4 * across
    return np.stack(
        [shoulder, shoulder + outside, elbow + outside, elbow + inside, w1 + inside, w2, w3, flange], axis=-2
    )


_LINKS = (("upper arm", 2, 3, 0.08), ("forearm", 4, 5, 0.06), ("wrist", 5, 6, 0.06), ("wrist", 6, 7, 0.06),
          ("wrist", 7, 8, 0.05), ("gripper", 8, 9, 0.04))  # fmt: skip
"""Name, ends as `UrKinematics.points` counts, radius [m]. Radii are rough; the gripper's is for a slim one."""

_BARS = (("base", 0.075), ("shoulder", 0.068), ("upper arm", 0.055), ("elbow", 0.055), ("forearm", 0.045),
         ("wrist 1", 0.043), ("wrist 2", 0.043), ("wrist 3", 0.04), ("gripper", 0.022))  # fmt: skip
"""Name and radius [m] of the links as they are drawn, from the foot."""

CALIBRATED_SLACK = 5e-3
"""Tolerance of the speeds of a calibrated robot, whose axes are turned by some mrad: a path that keeps a limit with
nominal lengths is up to 0.13 % above it (twenty robots with deviations of 2 mrad and 1 mm at each joint)."""


class UrKinematics(ArmModel):
    """A UR's kinematics as planning needs it.

    Args:
        robot: nominal, or calibrated.
    """

    joint_names = JOINT_NAMES
    margin_names = ("shoulder", "elbow", "wrist")
    range_remedy = "let it start a full turn back at 'home'"
    links = tuple(LinkCapsule(*link) for link in _LINKS)
    bars = tuple(LinkCapsule(name, k, k + 1, radius) for k, (name, radius) in enumerate(_BARS))
    body = (LinkCapsule("base", 0, 1, links[0].radius), links[0], links[1])
    hand = (links[3:], links[3:], ())  # gripper and wrist are beside the forearm

    def __init__(self, robot: RobotModel) -> None:
        self.robot = robot
        self.joint_low = tuple(-most for most in robot.joint_range)
        self.joint_high, self.joint_speed = robot.joint_range, robot.joint_speed
        self.checksum = robot.parameters.checksum
        if robot.calibration is not None:
            self.speed_slack, self.pose_error = CALIBRATED_SLACK, (SAME_PLACE, SAME_ANGLE)

    def forward(self, joints: FloatArray) -> tuple[FloatArray, FloatArray]:
        """See `ArmModel.forward`."""
        return forward(joints, self.robot)

    def points(self, joints: FloatArray) -> FloatArray:
        """See `ArmModel.points`."""
        points = link_points(joints, self.robot)
        return np.concatenate([np.zeros((*joints.shape[:-1], 1, 3)), points], axis=-2)

    def follow(self, rotation: FloatArray, position: FloatArray, near: FloatArray, home: FloatArray) -> FloatArray:
        """See `ArmModel.follow`."""
        number = posture(home, self.robot)
        nominal = inverse(rotation, position, self.robot.nominal)[:, number]
        joints = refined(nominal, rotation, position, self.robot)
        if np.isnan(joints).any():
            raise UnreachedError(None if np.isnan(nominal).any() else nominal)
        return np.unwrap(np.concatenate([near[None], joints]), axis=0)[1:]

    def step(self, rotation: FloatArray, position: FloatArray, start: FloatArray) -> FloatArray:
        """See `ArmModel.step`."""
        points = [start]
        for candidates in inverse(rotation, position, self.robot)[1:]:
            turned = candidates - 2.0 * np.pi * np.round((candidates - points[-1]) / (2.0 * np.pi))
            apart = np.abs(turned - points[-1]).max(axis=-1)
            if not np.isfinite(apart).any() or np.nanmin(apart) > 0.05:
                raise UnreachedError
            points.append(turned[int(np.nanargmin(apart))])
        return np.stack(points)

    def out_of_reach(self, rotation: FloatArray, position: FloatArray, home: FloatArray) -> tuple[int, str]:
        """See `ArmModel.out_of_reach`."""
        beyond, number = beyond_reach(rotation, position, self.robot), posture(home, self.robot)
        worst = _first_worst(np.abs(beyond[:, number]))
        distance = 1e3 * float(beyond[worst, number])
        another = (
            "; another posture of the arm would reach it: wait at a 'home' with the wrist bent the other way"
            if np.any(np.all(beyond == 0.0, axis=0))
            else ""
        )
        if distance > 0.0:
            return worst, f"out of the arm's reach by {distance:.0f} mm; move the receiver nearer or lower{another}"
        return worst, f"{-distance:.0f} mm too near to the arm's base; move the receiver away from it{another}"

    def place_problem(self, rotation: FloatArray, position: FloatArray) -> str:
        """See `ArmModel.place_problem`."""
        if np.isfinite(inverse(rotation, position, self.robot)).any():
            return ""
        beyond = beyond_reach(rotation, position, self.robot)[0]
        least = 1e3 * float(beyond[np.argmin(np.abs(beyond))])
        if least > 0.0:
            return f"out of reach by {least:.0f} mm; move the receiver nearer to the base"
        return f"{-least:.0f} mm too near to the arm's base; move the receiver away from it"

    def margins(self, joints: FloatArray) -> FloatArray:
        """See `ArmModel.margins`: of shoulder, elbow and wrist."""
        return singularities(joints, self.robot)

    def singular(self, joints: FloatArray, least: float, cure: str) -> Iterator[tuple[int, str]]:
        """See `ArmModel.singular`."""
        margins = self.margins(joints)
        worst = np.argmin(margins, axis=0)
        shoulder, elbow, wrist = margins[worst, np.arange(3)]
        reach, wanted = abs(self.robot.a2) + abs(self.robot.a3), math.degrees(math.asin(least))
        if shoulder < least:
            yield (
                int(worst[0]),
                f"the wrist {1e3 * shoulder * reach:.0f} mm from above the base's axis, {1e3 * least * reach:.0f} mm "
                f"are asked for; {cure} away from the base",
            )
        if elbow < least:
            folded = math.cos(float(joints[worst[1], 2])) < 0.0
            state, help_ = ("folded", "away from the base") if folded else ("straight", "nearer or lower")
            yield (
                int(worst[1]),
                f"elbow {math.degrees(math.asin(elbow)):.1f} deg from {state}, {wanted:.1f} deg are asked for; "
                f"{cure} {help_}",
            )
        if wrist < least:
            yield (
                int(worst[2]),
                f"wrist 2 {math.degrees(math.asin(wrist)):.1f} deg from where joints 4 and 6 turn about one axis, "
                f"{wanted:.1f} deg are asked for; turn 'direction', or {cure} sideways",
            )

    def link_error(self, joints: FloatArray) -> float:
        """See `ArmModel.link_error`: drawn with nominal lengths, a link differs from a calibrated robot's by no more
        than the flange does."""
        if self.robot.calibration is None:
            return 0.0
        nominal, calibrated = (forward(joints, model)[1] for model in (self.robot.nominal, self.robot))
        return SAME_PLACE + float(np.linalg.norm(nominal - calibrated, axis=-1).max())


@lru_cache(maxsize=64)
def kinematics_of(robot: RobotModel) -> UrKinematics:
    """The kinematics of a robot."""
    return UrKinematics(robot)


def _first_worst(values: FloatArray) -> int:
    """First index of the largest value; during a hold the value stays constant to within rounding."""
    most = float(values.max())
    return int(np.argmax(values >= most - 1e-6 * abs(most) - 1e-9))
