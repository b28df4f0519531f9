"""Compares a robot with its settings: model, lengths, limits, and where its controller has the tool.

`robot_checks` makes one line for each fact, with the remedy, for `decant robot check`. A driver refuses to connect if
one of them fails (`robot_problems`), because pours would then go astray or end in protective stops.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from actors.arm.planning.kinematics import transform_of
from actors.arm.planning.trajectory import STEEPEST
from actors.arm.ur.primary_interface import RobotState
from actors.arm.ur.robot_models import SAME_ANGLE, SAME_PLACE, model_named, same_robot
from actors.arm.ur.ur_kinematics import forward
from actors.arm.ur_settings import UrArmSettings
from actors.arm_geometry import JOINT_NAMES, Pose
from actors.interfaces import DeviceCheck

PAYLOAD_TOLERANCE, CENTRE_TOLERANCE = 0.1, 0.02
"""Largest differences of payload [kg] and payload centre [m]."""

SAME_LENGTH = 5e-3
"""Largest difference between a length that a robot reports as nominal and the model's [m]."""


def robot_problems(
    spec: UrArmSettings, name: str, software: Sequence[int], state: RobotState, *, rests: bool
) -> list[str]:
    """The facts that prevent a pour, each with its remedy; see `robot_checks`."""
    checks = robot_checks(spec, name, software, state, rests=rests)
    return [f"{check.found}: {check.advice}" for check in checks if check.state == "fail"]


def robot_checks(
    spec: UrArmSettings, name: str, software: Sequence[int], state: RobotState, *, rests: bool
) -> list[DeviceCheck]:
    """One line for each fact. If the model differs, only that is reported.

    Args:
        spec: settings of the laboratory's file.
        name: of the model, as the dashboard reports it.
        software: version of the controller's software.
        state: of the robot, as its primary interface reports it.
        rests: whether the arm stands still, so that joints and tool belong together.
    """
    model = model_named(name, software)
    wrong = not same_robot(model, spec.model) or state.kind not in (None, spec.robot.kind)
    if wrong:
        version = ".".join(map(str, software[:3]))
        return [
            DeviceCheck(
                "model",
                "fail",
                f"is a {(model or 'nameless robot').upper()} of type {state.kind} (software {version}); the arm is set "
                f"up as {spec.model.upper()}, type {spec.robot.kind}",
                "is this the right controller? Lengths and limits differ between models: correct 'model' or 'address'",
            )
        ]
    checks = [DeviceCheck("model", "ok", spec.model.upper())]
    checks += [_lengths(spec, state), *_limits(spec, state)]
    return checks + ([_kinematics(spec, state)] if rests and state.pose and state.joints else [])


def payload_check(spec: UrArmSettings, payload: float | None, centre: Sequence[float] | None) -> DeviceCheck:
    """Compare the controller's payload [kg] and its centre [m] with the file's; None if they are not reported."""
    if payload is None or centre is None:
        return DeviceCheck(
            "payload", "warn", "not reported", "compare payload and centre with the teach pendant yourself"
        )
    away = math.dist(centre, spec.payload_centre.vector)
    text = f"{payload:.2f} kg"
    if abs(payload - spec.payload) <= PAYLOAD_TOLERANCE and away <= CENTRE_TOLERANCE:
        return DeviceCheck("payload", "ok", text)
    return DeviceCheck(
        "payload",
        "fail",
        f"{text} on the controller, {spec.payload:.2f} kg in the file; centres {1e3 * away:.0f} mm apart",
        "set payload and centre in the installation on the teach pendant, or correct them in the file: a wrong payload "
        "ends in protective stops",
    )


def _lengths(spec: UrArmSettings, state: RobotState) -> DeviceCheck:
    robot = spec.robot
    apart = max((abs(a - b) for a, b in zip(state.lengths, (*robot.a, *robot.d), strict=False)), default=0.0)
    if apart > SAME_LENGTH:
        return DeviceCheck(
            "lengths",
            "fail",
            f"has a link that differs by {1e3 * apart:.1f} mm from a {spec.model.upper()}'s",
            "this series of the model is not supported; send 'decant robot check' with its label to the maintainers",
        )
    calibration = state.calibration
    origin = "nominal, as a simulator's are" if calibration is None else f"calibrated, checksum {calibration.checksum}"
    return DeviceCheck("lengths", "ok", origin)


def _limits(spec: UrArmSettings, state: RobotState) -> list[DeviceCheck]:
    checks = []
    allowed = [min(spec.limits.joint_speed, fastest) for fastest in spec.robot.joint_speed]
    slow = [k for k, speed in enumerate(state.joint_speeds) if allowed[k] > speed + 1e-6]
    if slow:
        k = min(slow, key=state.joint_speeds.__getitem__)
        checks.append(
            DeviceCheck(
                "joint speed",
                "fail",
                f"limits {JOINT_NAMES[k]} to {math.degrees(state.joint_speeds[k]):.0f} deg/s; the file allows "
                f"{math.degrees(allowed[k]):.0f} deg/s",
                "a fast pour would end in a protective stop: lower 'limits.joint_speed' in the file",
            )
        )
    elif state.joint_speeds:
        checks.append(DeviceCheck("joint speed", "ok", "the file's limit is within the controller's"))
    least = min(state.joint_accelerations, default=math.inf)
    if max(spec.approach_acceleration, STEEPEST) > least + 1e-6:
        checks.append(
            DeviceCheck(
                "joint acceleration",
                "fail",
                f"limits a joint to {math.degrees(least):.0f} deg/s²; approaches are planned with "
                f"{math.degrees(spec.approach_acceleration):.0f} deg/s², pours with up to "
                f"{math.degrees(STEEPEST):.0f} deg/s²",
                "lower 'approach_acceleration' in the file; if the pours' own is too much, this robot cannot make them",
            )
        )
    ranges = zip(spec.home.angles, state.joint_ranges, strict=False)
    out = [k for k, (q, (low, high)) in enumerate(ranges) if not low <= q <= high]
    if out:
        checks.append(
            DeviceCheck("home", "fail", f"does not allow {JOINT_NAMES[out[0]]} of 'home'", "correct 'home' in the file")
        )
    return checks


def _kinematics(spec: UrArmSettings, state: RobotState) -> DeviceCheck:
    """Compare the own forward kinematics with the controller's pose of the tool."""
    robot = spec.with_values(calibration=state.calibration).robot
    rotation, position = forward(np.array(state.joints), robot)
    tool, flange = transform_of(Pose.of(*state.tool)), transform_of(Pose.of(*state.pose))
    away = float(np.linalg.norm(position + rotation @ tool.position - flange.position))
    chord = float(np.linalg.norm(rotation @ tool.rotation - flange.rotation)) / math.sqrt(8.0)
    turned = 2.0 * math.asin(min(1.0, chord))
    deviation = f"{1e3 * away:.2f} mm and {math.degrees(turned):.3f} deg from where its lengths and joints put it"
    if away <= SAME_PLACE and turned <= SAME_ANGLE:
        return DeviceCheck("kinematics", "ok", f"the tool is {deviation}")
    return DeviceCheck(
        "kinematics",
        "fail",
        f"has its tool {deviation}; at most {1e3 * SAME_PLACE:g} mm and {math.degrees(SAME_ANGLE):g} deg are allowed",
        "pours would go astray. Is 'model' right? If so, switch the controller off and on, so that it sends its "
        "calibration anew; if that does not help, the robot needs the manufacturer's service",
    )
