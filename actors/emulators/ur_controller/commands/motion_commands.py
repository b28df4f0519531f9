"""Commands that move the arm, or wait."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from actors.emulators.ur_controller.commands.command_arguments import (
    LONGEST,
    ControllerAccess,
    positive,
    rate,
    six,
)
from actors.emulators.ur_controller.motion.motion_actions import JointLine
from actors.emulators.ur_controller.motion.mover import ControlledElsewhereError
from actors.emulators.ur_controller.urscript.lexer import ScriptError
from actors.emulators.ur_controller.urscript.program import Command, Steps
from actors.emulators.ur_controller.urscript.script_values import UrPose, number

UNSUPPORTED = (
    "movel movep movec servoc speedl direct_torque get_forward_kin get_inverse_kin get_inverse_kin_has_solution "
    "is_within_safety_limits get_joint_torques get_target_waypoint get_target_tcp_speed get_actual_tool_flange_pose "
    "get_actual_joint_positions_history tool_contact pose_trans pose_sub force_mode freedrive_mode teach_mode "
    "conveyor_pulse_decode track_conveyor_linear track_conveyor_circular"
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
            "servoj": self.servoj,
            "speedj": self.speedj,
            "stopj": self.stop,
            "stopl": self.stop,
            "sync": self.sync,
            "sleep": self.sleep,
        }
        commands = {name: Command(function, waits=True) for name, function in waiting.items()}
        for name in UNSUPPORTED.split():
            commands[name] = Command(_refuse(name))
        for name in ("end_force_mode", "end_freedrive_mode", "end_teach_mode"):
            commands[name] = Command(lambda: None)
        commands["get_freedrive_status"] = Command(lambda: 0)
        return commands

    # ---- paths

    def movej(self, q: Any, a: Any = 1.4, v: Any = 1.05, t: Any = 0, r: Any = 0) -> Steps:
        """Move to joint positions, linearly in joint space."""
        if isinstance(q, UrPose) or number(r) > 0.0:
            raise ScriptError("movej to a pose, or with a blend radius, is not supported by this virtual controller")
        target = six(q)
        while beyond := self._controller.safety.configuration.joints_violation(target):
            self._controller.protective_stop(f"the target is not allowed: {beyond}")
            yield  # even if the program is resumed, the target stays forbidden
        speed, acceleration, duration = rate(v, "speed"), rate(a, "acceleration"), min(number(t), LONGEST)
        duration = max(duration, self._controller.dt) if duration > 0.0 else 0.0
        thread = self._take()
        done = False
        try:
            path = None
            while path is None or not path.finished:
                if path is None or self._mover.action is not path:
                    # the first time, and after a protective stop ended the path and the program was resumed
                    path = self._mover.follow(
                        lambda start: JointLine(start, target), speed, acceleration, duration=duration
                    )
                yield
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

    def speedj(self, qd: Any, a: Any = 1.4, t: Any = None) -> Steps:
        """Hold joint speeds for a time; without a time, until they are reached."""
        target, acceleration = six(qd), rate(a, "acceleration")
        return self._hold(
            self._cycles(t),
            lambda: self._mover.joint_speeds(target, acceleration),
            lambda: max(abs(x - self._mover.rate * y) for x, y in zip(self._mover.qd, target, strict=True)) < 1e-6,
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

    def stop(self, a: Any, aRot: Any = None) -> Steps:
        """Stop in joint space; so does stopl, which a real controller brakes along the path of the tool."""
        deceleration = rate(a, "deceleration")
        thread = self._take()
        try:
            stop = self._mover.stop_joints(deceleration)
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


def _refuse(name: str) -> Callable[..., None]:
    def refuse(*_: Any, **__: Any) -> None:
        raise ScriptError(f"{name} is not supported by this virtual controller")

    return refuse
