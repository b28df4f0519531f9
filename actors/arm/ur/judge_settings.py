"""Whether the settings of a laboratory's file and those of the controller agree: tool, mount, payload, home, limits."""

from __future__ import annotations

import math

from actors.arm.geometry import JOINT_NAMES, Pose
from actors.arm.spec import UrArmSpec
from actors.arm.ur.primary import RobotState
from actors.arm.ur.survey import Exchange
from actors.checks import Check

TOOL_TOLERANCE, TURN_TOLERANCE = 1e-3, math.radians(0.5)
"""How far the controller's TCP may be from the file's [m], [rad]."""

PAYLOAD_TOLERANCE, CENTRE_TOLERANCE = 0.1, 0.02
"""How far its payload [kg] and its payload's centre [m] may be."""

MOUNT_TOLERANCE, GRAVITY = math.radians(15.0), 9.81
"""How far up may be from where the file says [rad]: the tool's accelerometer is not a level. [m/s²]"""

HOME_TOLERANCE = math.radians(1.0)


def tool_check(spec: UrArmSpec, state: RobotState) -> Check:
    """Whether the controller's TCP is the file's."""
    there = Pose(*state.tool)
    away, turned = distance(spec.tool, there), turn(spec.tool, there)
    if away <= TOOL_TOLERANCE and turned <= TURN_TOLERANCE:
        return Check("tool", "ok", f"TCP {_point(there)}")
    return Check(
        "tool",
        "fail",
        f"TCP on the controller {_point(there)}, in the file {_point(spec.tool)}: {1e3 * away:.1f} mm and "
        f"{math.degrees(turned):.1f} deg apart",
        "set the TCP in the installation on the teach pendant, or correct 'tool' in the file: they have to agree",
    )


def mount_check(spec: UrArmSpec, state: RobotState, exchange: Exchange) -> Check:
    """Whether up is where the file says: the tool feels it."""
    from scipy.spatial.transform import Rotation

    felt = exchange.acceleration
    strength = math.hypot(*felt) if felt is not None else 0.0
    if felt is None or not state.pose or not 0.5 * GRAVITY < strength < 1.5 * GRAVITY:
        return Check(
            "mount", "warn", "where up is, the tool doesn't tell", "compare 'mount' with the teach pendant yourself"
        )
    up = Rotation.from_rotvec(state.pose[3:]).apply([a / strength for a in felt])
    away = math.acos(max(-1.0, min(1.0, sum(a * b for a, b in zip(up, spec.mount.up, strict=True)))))
    tilt = math.degrees(math.acos(max(-1.0, min(1.0, float(up[2])))))
    if away <= MOUNT_TOLERANCE:
        return Check("mount", "ok", f"tilted by {tilt:.0f} deg, as the file says")
    turn = math.degrees(math.atan2(float(up[0]), float(up[1])))
    return Check(
        "mount",
        "fail",
        f"the tool feels up {math.degrees(away):.0f} deg away from where the file has it: tilt {tilt:.0f} deg, turn "
        f"{turn:.0f} deg would agree with it",
        "correct 'mount' in the file and the mounting in the installation on the teach pendant: pours would go astray",
    )


def payload_check(spec: UrArmSpec, exchange: Exchange) -> Check:
    """Whether the controller's payload is the file's."""
    if exchange.payload is None or exchange.payload_centre is None:
        return Check("payload", "warn", "not told", "compare payload and centre with the teach pendant yourself")
    away = math.dist(exchange.payload_centre, spec.payload_centre)
    text = f"{exchange.payload:.2f} kg"
    if abs(exchange.payload - spec.payload) <= PAYLOAD_TOLERANCE and away <= CENTRE_TOLERANCE:
        return Check("payload", "ok", text)
    return Check(
        "payload",
        "fail",
        f"{text} on the controller, {spec.payload:.2f} kg in the file; centres {1e3 * away:.0f} mm apart",
        "set payload and centre in the installation on the teach pendant, or correct them in the file: a wrong payload "
        "ends in protective stops",
    )


def home_check(spec: UrArmSpec, state: RobotState) -> Check:
    """Whether the arm stands where it waits."""
    away = [abs(a - b) for a, b in zip(state.joints, spec.home, strict=True)]
    worst = max(range(6), key=away.__getitem__)
    if away[worst] <= HOME_TOLERANCE:
        return Check("position", "ok", "at home")
    return Check(
        "position",
        "warn",
        f"not at home: {JOINT_NAMES[worst]} is {math.degrees(away[worst]):.1f} deg away",
        "bring it home slowly with 'decant jog', watching it, before a pour",
    )


def limit_checks(spec: UrArmSpec, state: RobotState) -> list[Check]:
    """Whether the file stays within the controller's limits."""
    checks = []
    if state.joint_speeds:
        slowest = min(state.joint_speeds)
        if spec.limits.joint_speed > slowest + 1e-6:
            checks.append(
                Check(
                    "joint speed",
                    "warn",
                    f"the file allows {math.degrees(spec.limits.joint_speed):.0f} deg/s, the controller "
                    f"{math.degrees(slowest):.0f} deg/s for its slowest joint",
                    "a fast pour may end in a protective stop; lower 'joint_speed' in the file",
                )
            )
        else:
            checks.append(Check("joint speed", "ok", "the file's limit is within the controller's"))
    out = [
        i for i, (q, (low, high)) in enumerate(zip(spec.home, state.joint_ranges, strict=False)) if not low <= q <= high
    ]
    if out:
        checks.append(
            Check(
                "home", "fail", f"{JOINT_NAMES[out[0]]} of 'home' is outside the controller's range", "correct 'home'"
            )
        )
    return checks


def distance(a: Pose, b: Pose) -> float:
    """Between two frames' origins [m]."""
    return math.dist((a.x, a.y, a.z), (b.x, b.y, b.z))


def turn(a: Pose, b: Pose) -> float:
    """Between two frames' directions [rad]."""
    from scipy.spatial.transform import Rotation

    turned = Rotation.from_rotvec([a.rx, a.ry, a.rz]).inv() * Rotation.from_rotvec([b.rx, b.ry, b.rz])
    return float(turned.magnitude())


def _point(pose: Pose) -> str:
    return f"({1e3 * pose.x:.1f}, {1e3 * pose.y:.1f}, {1e3 * pose.z:.1f}) mm"
