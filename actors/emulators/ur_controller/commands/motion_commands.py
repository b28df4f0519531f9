"""Commands that move the arm, or wait."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from actors.arm.ur.robot_models import Joints
from actors.emulators.ur_controller.commands.command_arguments import (
    LONGEST,
    ControllerAccess,
    is_pose,
    positive,
    rate,
    six,
)
from actors.emulators.ur_controller.motion.motion_actions import MotionAction
from actors.emulators.ur_controller.motion.motion_lines import JointLine, Line, ToolLine, UnreachableError
from actors.emulators.ur_controller.motion.mover import ControlledElsewhereError
from actors.emulators.ur_controller.robot_kinematics import (
    Transform,
    compose,
    distance,
    norm3,
    rotation_between,
    transform_of,
)
from actors.emulators.ur_controller.urscript.lexer import ScriptError
from actors.emulators.ur_controller.urscript.program import Command, Steps
from actors.emulators.ur_controller.urscript.script_values import number

UNSUPPORTED = (
    "force_mode",
    "freedrive_mode",
    "teach_mode",
    "movec",
    "direct_torque",
    "conveyor_pulse_decode",
    "track_conveyor_linear",
    "track_conveyor_circular",
)
"""Commands of real controllers that are not emulated; a program that calls one ends with an error."""


class MoveCommands:
    """The motion commands of one controller.

    Args:
        controller: of the arm.
    """

    def __init__(self, controller: ControllerAccess) -> None:
        self._controller = controller
        self._robot = controller.robot
        self._mover = controller.robot.mover

    def commands(self) -> dict[str, Command]:
        """Return the commands by name."""
        waiting: dict[str, Callable[..., Steps]] = {
            "movej": self.movej,
            "movel": self.movel,
            "movep": self.movel,
            "servoj": self.servoj,
            "servoc": self.servoc,
            "speedj": self.speedj,
            "speedl": self.speedl,
            "stopj": self.stopj,
            "stopl": self.stopl,
            "sync": self.sync,
            "sleep": self.sleep,
        }
        commands = {name: Command(function, waits=True) for name, function in waiting.items()}
        for name in UNSUPPORTED:
            commands[name] = Command(_refuse(name))
        for name in ("end_force_mode", "end_freedrive_mode", "end_teach_mode"):
            commands[name] = Command(lambda: None)
        commands["get_freedrive_status"] = Command(lambda: 0)
        return commands

    # ---- paths

    def movej(self, q: Any, a: Any = 1.4, v: Any = 1.05, t: Any = 0, r: Any = 0) -> Steps:
        """Move to joint positions or a pose, linearly in joint space."""
        target = self._inverse(transform_of(six(q))) if is_pose(q) else six(q)
        while beyond := self._controller.safety.configuration.joints_violation(target):
            self._controller.protective_stop(f"the target is not allowed: {beyond}")
            yield  # even if the program is resumed, the target stays forbidden
        yield from self._follow(lambda start: JointLine(self._robot.arm, start, target), a, v, t, r)

    def movel(self, pose: Any, a: Any = 1.2, v: Any = 0.25, t: Any = 0, r: Any = 0) -> Steps:
        """Move to a pose or joint positions, linearly in tool space."""
        target = transform_of(six(pose)) if is_pose(pose) else self._robot.arm.frame(six(pose))
        self._inverse(target)
        arm = self._robot.arm
        return self._follow(lambda start: ToolLine(arm, arm.frame(start), target), a, v, t, r)

    def _follow(self, line: Callable[[Joints], Line], a: Any, v: Any, t: Any, r: Any) -> Steps:
        speed, acceleration = rate(v, "speed"), rate(a, "acceleration")
        duration, radius = min(number(t), LONGEST), max(number(r), 0.0)
        duration = max(duration, self._controller.dt) if duration > 0.0 else 0.0
        thread = self._take()
        done = False
        try:
            path = self._mover.follow(line, speed, acceleration, duration=duration, radius=radius)
            while not path.released:
                yield
                if not path.released and self._mover.action is not path:
                    # A protective stop ended the path, and the program was resumed.
                    path = self._mover.follow(line, speed, acceleration, duration=duration, radius=radius)
            done = True
        finally:
            self._release(thread, done)

    # ---- servo and speed

    def servoj(
        self, q: Any, a: Any = 0, v: Any = 0, t: Any = 0.002, lookahead_time: Any = 0.1, gain: Any = 300
    ) -> Steps:
        """Move towards joint positions for a time, which the slider stretches; to be called again at its end."""
        target = six(q)
        lookahead = min(max(positive(lookahead_time, "lookahead_time"), 0.03), 0.2)  # limits of the manual
        strength = min(max(positive(gain, "gain"), 100.0), 2000.0)
        return self._hold(self._cycles(t), lambda: self._mover.servo(target, lookahead, strength))

    def servoc(self, pose: Any, a: Any = 1.2, v: Any = 0.25, r: Any = 0) -> Steps:
        """Move towards a pose at the tool speed, braking in time; to be called in every cycle."""
        target, speed, acceleration = transform_of(six(pose)), rate(v, "speed"), rate(a, "acceleration")

        def aim() -> None:
            frame = self._robot.arm.frame(self._mover.q)
            away = [b - c for b, c in zip(target[1], frame[1], strict=True)]
            turn = rotation_between(frame[0], target[0])
            left = max(norm3(away), norm3(turn))
            pace = min(speed, (2.0 * 0.8 * acceleration * left) ** 0.5, left / (2.0 * self._controller.dt))
            turned = compose((frame[0], (0.0, 0.0, 0.0)), ((1.0, 0, 0, 0, 1.0, 0, 0, 0, 1.0), turn))[1]
            share = pace / left if left > 1e-9 else 0.0
            velocity = [share * x for x in (*away, *turned)]
            self._mover.tool_speed(self._robot.arm, velocity, acceleration, acceleration)

        return self._hold(1, aim)

    def speedj(self, qd: Any, a: Any = 1.4, t: Any = None) -> Steps:
        """Hold joint speeds for a time; without a time, until they are reached."""
        target, acceleration = six(qd), rate(a, "acceleration")
        return self._hold(
            self._cycles(t),
            lambda: self._mover.joint_speeds(target, acceleration),
            lambda: max(abs(x - self._mover.rate * y) for x, y in zip(self._mover.qd, target, strict=True)) < 1e-6,
        )

    def speedl(self, xd: Any, a: Any = 1.2, t: Any = None, aRot: Any = None) -> Steps:
        """Hold a tool velocity for a time; without a time, until it is reached."""
        target, acceleration = six(xd), rate(a, "acceleration")
        turning = acceleration if aRot is None else rate(aRot, "aRot")

        def reached() -> bool:
            speed, scaled = self._robot.target_tool_speed, [self._mover.rate * x for x in target]
            return distance(speed, scaled) < 1e-4 and distance(speed[3:], scaled[3:]) < 1e-4

        return self._hold(
            self._cycles(t),
            lambda: self._mover.tool_speed(self._robot.arm, target, acceleration, turning),
            reached,
        )

    def _cycles(self, t: Any) -> int:
        return 0 if t is None else max(1, round(min(number(t), LONGEST) / self._controller.dt))

    def _hold(self, cycles: int, command: Callable[[], None], reached: Callable[[], bool] = lambda: True) -> Steps:
        thread = self._take()
        done = False
        try:
            passed = 0.0
            while True:
                command()
                yield
                passed += self._mover.rate
                if passed >= cycles - 1e-6 and self._mover.rate > 0.0 and (cycles or reached()):
                    break
            done = True
        finally:
            self._release(thread, done)

    # ---- stops and time

    def stopj(self, a: Any) -> Steps:
        """Stop in joint space."""
        return self._stop(self._mover.stop_joints, a)

    def stopl(self, a: Any, aRot: Any = None) -> Steps:
        """Stop along the tool's path."""
        return self._stop(lambda rate: self._mover.stop_tool(self._robot.arm, rate), a)

    def _stop(self, begin: Callable[[float], MotionAction], a: Any) -> Steps:
        deceleration = rate(a, "deceleration")
        thread = self._take()
        try:
            stop = begin(deceleration)
            while not stop.finished:
                yield
                if self._mover.action is None:
                    break
        finally:
            self._release(thread, True)

    def sync(self) -> Steps:
        """Suspend the thread until the next cycle."""
        yield

    def sleep(self, t: Any) -> Steps:
        """Wait [s]."""
        for _ in range(max(1, round(min(number(t), LONGEST) / self._controller.dt))):
            yield

    # ---- common parts

    def _take(self) -> int:
        program = self._controller.running
        if program is None or program.secondary:
            raise ScriptError("a secondary program can't move the robot")
        try:
            self._mover.take(program.current)
        except ControlledElsewhereError as error:
            raise ScriptError(str(error)) from None
        return program.current

    def _release(self, thread: int, done: bool) -> None:
        self._mover.let_go(thread)
        if not done:
            self._mover.abandon()

    def _inverse(self, frame: Transform) -> Joints:
        try:
            return self._robot.arm.joints(frame, self._mover.q)
        except UnreachableError as error:
            raise ScriptError(f"inverse kinematics found no solution: {error}") from None


def _refuse(name: str) -> Callable[..., None]:
    def refuse(*_: Any, **__: Any) -> None:
        raise ScriptError(f"{name} is not supported by this virtual controller")

    return refuse
