"""Commands that ask: where the arm is, whether a pose can be reached, what is mounted."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from actors.ur.models import Joints
from actors.virtual_ur.commands.arguments import is_pose, six, whole
from actors.virtual_ur.commands.machine import Machine
from actors.virtual_ur.motion.actions import Path
from actors.virtual_ur.motion.lines import Arm, ToolLine, UnreachableError
from actors.virtual_ur.poses import pose_of, transform_of
from actors.virtual_ur.urscript.errors import ScriptError
from actors.virtual_ur.urscript.program import Command
from actors.virtual_ur.urscript.values import Pose

_HEAVY = {"get_inverse_kin", "get_inverse_kin_has_solution", "is_within_safety_limits", "get_joint_torques"}
"""Answers that take a tenth of a millisecond."""


class Queries:
    """Bound to one controller.

    Args:
        controller: who is asked.
    """

    def __init__(self, controller: Machine) -> None:
        self._controller = controller
        self._robot = controller.robot

    def commands(self) -> dict[str, Command]:
        """By name."""
        robot, controller = self._robot, self._controller
        answers: dict[str, Callable[..., Any]] = {
            "get_actual_joint_positions": lambda: list(robot.q),
            "get_actual_joint_speeds": lambda: list(robot.qd),
            "get_target_joint_positions": lambda: list(robot.mover.q),
            "get_target_joint_speeds": lambda: list(robot.mover.qd),
            "get_target_joint_accelerations": lambda: list(robot.mover.qdd),
            "get_actual_joint_positions_history": self.history,
            "get_actual_tcp_pose": lambda: Pose(robot.pose),
            "get_actual_tcp_speed": lambda: list(robot.tool_speed),
            "get_target_tcp_pose": lambda: Pose(robot.target_pose),
            "get_target_tcp_speed": lambda: list(robot.target_tool_speed),
            "get_actual_tool_flange_pose": lambda: Pose(pose_of(robot.kinematics.flange(robot.q))),
            "get_target_waypoint": self.target_waypoint,
            "get_forward_kin": self.forward,
            "get_inverse_kin": self.inverse,
            "get_inverse_kin_has_solution": self.has_solution,
            "is_within_safety_limits": self.within_limits,
            "is_steady": lambda: robot.steady,
            "get_steptime": lambda: controller.dt,
            "get_joint_torques": lambda: list(robot.holding_torques),
            "get_joint_temp": lambda j: 30.0 + 0.0 * whole(j, 0, 5, "joint"),
            "get_controller_temp": lambda: 35.0,
            "get_tool_current": lambda: 0.0,
            "get_tcp_force": lambda: [0.0] * 6,
            "force": lambda: 0.0,
            "tool_contact": lambda direction=None: 0,
            "get_tcp_offset": lambda: Pose(robot.tcp),
            "get_target_payload": lambda: robot.payload,
            "get_target_payload_cog": lambda: list(robot.cog),
            "get_target_payload_inertia": lambda: list(robot.inertia),
        }
        return {name: Command(answer, work=300 if name in _HEAVY else 30) for name, answer in answers.items()}

    def history(self, steps: Any = 0) -> list[float]:
        """Measured joint positions some cycles ago."""
        recent = self._robot.recent
        back = min(whole(steps, 0, 1_000_000, "steps"), len(recent) - 1)
        return list(recent[-1 - back])

    def target_waypoint(self) -> Pose:
        """Where the present path leads; where the arm stands if there is none."""
        action = self._robot.mover.action
        line = action.target if isinstance(action, Path) else None
        if line is None:
            return Pose(self._robot.target_pose)
        if isinstance(line, ToolLine):
            return Pose(pose_of(line.end))
        return Pose(pose_of(self._robot.arm.frame(line.at(line.length, self._robot.mover.q))))

    def _arm(self, tcp: Any) -> Arm:
        if tcp is None or tcp == "active_tcp":
            return self._robot.arm
        return Arm(self._robot.kinematics, transform_of(six(tcp)))

    def forward(self, q: Any = None, tcp: Any = None) -> Pose:
        """Pose of the tool at joint positions; measured ones by default."""
        return Pose(pose_of(self._arm(tcp).frame(self._robot.q if q is None else six(q))))

    def _solve(self, x: Any, qnear: Any, tcp: Any) -> Joints:
        near = self._robot.q if qnear is None else six(qnear)
        return self._arm(tcp).joints(transform_of(six(x)), near)

    def inverse(
        self, x: Any, qnear: Any = None, maxPositionError: Any = 0, maxOrientationError: Any = 0, tcp: Any = None
    ) -> list[float]:
        """Joint positions for a pose, nearest to others; the solution is exact, so the tolerances don't matter."""
        try:
            return list(self._solve(x, qnear, tcp))
        except UnreachableError as error:
            raise ScriptError(f"inverse kinematics found no solution: {error}") from None

    def has_solution(
        self, x: Any, qnear: Any = None, maxPositionError: Any = 0, maxOrientationError: Any = 0, tcp: Any = None
    ) -> bool:
        """Whether a pose can be reached."""
        try:
            self._solve(x, qnear, tcp)
        except UnreachableError:
            return False
        return True

    def within_limits(self, x: Any) -> bool:
        """Whether a pose or joint positions are reachable and allowed by the safety configuration."""
        configuration, arm = self._robot.configuration, self._robot.arm
        if is_pose(x):
            frame = transform_of(six(x))
            try:
                q = arm.joints(frame, self._robot.q)
            except UnreachableError:
                return False
        else:
            q = six(x)
            frame = arm.frame(q)
        return configuration.joints_violation(q) is None and configuration.point_violation(frame[1]) is None
