"""Commands that read the arm's state, set tool, payload and messages, and access registers and signals.

`Queries` reads poses, joints and reachability. `SettingCommands` sets TCP, payload and gravity, and sends messages.
`Signalling` reads and writes registers and digital and analogue inputs and outputs.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from actors.arm.ur.robot_models import Joints
from actors.emulators.ur_controller.commands.command_arguments import ControllerAccess, is_pose, positive, six, whole
from actors.emulators.ur_controller.motion.motion_actions import Path
from actors.emulators.ur_controller.motion.motion_lines import KinematicArm, ToolLine, UnreachableError
from actors.emulators.ur_controller.registers import REGISTERS
from actors.emulators.ur_controller.robot_kinematics import pose_of, transform_of
from actors.emulators.ur_controller.urscript.lexer import ScriptError
from actors.emulators.ur_controller.urscript.program import Command
from actors.emulators.ur_controller.urscript.script_values import UrPose, number, numbers, show

_HEAVY = {"get_inverse_kin", "get_inverse_kin_has_solution", "is_within_safety_limits", "get_joint_torques"}
"""Commands that take about 0.1 ms."""


class Queries:
    """The query commands of one controller.

    Args:
        controller: source of the values.
    """

    def __init__(self, controller: ControllerAccess) -> None:
        self._controller = controller
        self._robot = controller.robot

    def commands(self) -> dict[str, Command]:
        """Return the commands by name."""
        robot, controller = self._robot, self._controller
        answers: dict[str, Callable[..., Any]] = {
            "get_actual_joint_positions": lambda: list(robot.q),
            "get_actual_joint_speeds": lambda: list(robot.qd),
            "get_target_joint_positions": lambda: list(robot.mover.q),
            "get_target_joint_speeds": lambda: list(robot.mover.qd),
            "get_target_joint_accelerations": lambda: list(robot.mover.qdd),
            "get_actual_joint_positions_history": self.history,
            "get_actual_tcp_pose": lambda: UrPose(robot.pose),
            "get_actual_tcp_speed": lambda: list(robot.tool_speed),
            "get_target_tcp_pose": lambda: UrPose(robot.target_pose),
            "get_target_tcp_speed": lambda: list(robot.target_tool_speed),
            "get_actual_tool_flange_pose": lambda: UrPose(pose_of(robot.kinematics.flange(robot.q))),
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
            "get_tcp_offset": lambda: UrPose(robot.tcp),
            "get_target_payload": lambda: robot.payload,
            "get_target_payload_cog": lambda: list(robot.cog),
            "get_target_payload_inertia": lambda: list(robot.inertia),
        }
        return {name: Command(answer, work=300 if name in _HEAVY else 30) for name, answer in answers.items()}

    def history(self, steps: Any = 0) -> list[float]:
        """Return the measured joint positions of some cycles ago."""
        recent = self._robot.recent
        back = min(whole(steps, 0, 1_000_000, "steps"), len(recent) - 1)
        return list(recent[-1 - back])

    def target_waypoint(self) -> UrPose:
        """Return the target of the current path, or the target pose if there is none."""
        action = self._robot.mover.action
        line = action.target if isinstance(action, Path) else None
        if line is None:
            return UrPose(self._robot.target_pose)
        if isinstance(line, ToolLine):
            return UrPose(pose_of(line.end))
        return UrPose(pose_of(self._robot.arm.frame(line.at(line.length, self._robot.mover.q))))

    def _arm(self, tcp: Any) -> KinematicArm:
        if tcp is None or tcp == "active_tcp":
            return self._robot.arm
        return KinematicArm(self._robot.kinematics, transform_of(six(tcp)))

    def forward(self, q: Any = None, tcp: Any = None) -> UrPose:
        """Return the tool pose at joint positions; measured ones by default."""
        return UrPose(pose_of(self._arm(tcp).frame(self._robot.q if q is None else six(q))))

    def _solve(self, x: Any, qnear: Any, tcp: Any) -> Joints:
        near = self._robot.q if qnear is None else six(qnear)
        return self._arm(tcp).joints(transform_of(six(x)), near)

    def inverse(
        self, x: Any, qnear: Any = None, maxPositionError: Any = 0, maxOrientationError: Any = 0, tcp: Any = None
    ) -> list[float]:
        """Return the joint positions for a pose, nearest to the given ones; the solution is exact, so the tolerances
        are unused.
        """
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


FARTHEST = 10.0
"""Largest entry of a tool centre point [m], [rad]; a larger one is a mistake of units."""

HEAVIEST = 12.5
"""Maximum payload of the arm [kg]."""

WITHOUT_EFFECT = (
    "force_mode_set_damping",
    "force_mode_set_gain_scaling",
    "zero_ftsensor",
    "ft_rtde_input_enable",
    "enable_external_ft_sensor",
    "set_tool_voltage",
    "set_tool_communication",
)
"""Accepted and ignored: there is no force, no sensor and no tool connector here."""


class SettingCommands:
    """The setting commands of one controller.

    Args:
        controller: receives the settings.
    """

    def __init__(self, controller: ControllerAccess) -> None:
        self._controller = controller
        self._robot = controller.robot

    def commands(self) -> dict[str, Command]:
        """Return the commands by name."""
        by_name = dict.fromkeys(WITHOUT_EFFECT, Command(lambda *_, **__: None))
        by_name |= {
            "set_tcp": Command(self.set_tcp),
            "set_payload": Command(self.set_payload),
            "set_target_payload": Command(self.set_payload),
            "set_payload_mass": Command(self.set_payload),
            "set_payload_cog": Command(lambda cog: self.set_payload(self._robot.payload, cog)),
            "set_gravity": Command(self.set_gravity),
            "textmsg": Command(self.textmsg),
            "popup": Command(self.popup),
            "protective_stop": Command(lambda: self._controller.protective_stop("asked for by the program")),
            "rtde_set_watchdog": Command(self.set_watchdog),
        }
        return by_name

    def set_tcp(self, pose: Any, tcp_name: Any = "") -> None:
        """Set the tool centre point in the flange's frame."""
        tool = six(pose)
        if max(abs(x) for x in tool) > FARTHEST:
            raise ScriptError(f"a tool centre point at {show(list(tool))}: no entry may be beyond {FARTHEST:g}")
        self._robot.set_tcp(tool)

    def set_payload(self, m: Any, cog: Any = None, inertia: Any = None, transition_time: Any = 0) -> None:
        """Set mass [kg], centre of gravity [m] and inertia [kg m²] of the payload at the flange."""
        mass = number(m)
        if not 0.0 <= mass <= HEAVIEST:
            raise ScriptError(f"a payload of {show(m)} kg; the arm carries 0 … {HEAVIEST:g} kg")
        self._robot.payload = mass
        if cog is not None:
            x, y, z = numbers(cog, 3)
            self._robot.cog = (x, y, z)
        if inertia is not None:
            self._robot.inertia = six(inertia)

    def set_gravity(self, d: Any) -> None:
        """Set the acceleration of the base that corresponds to gravity [m/s²]; it points upwards for an upright arm."""
        x, y, z = numbers(d, 3)
        self._robot.gravity = (x, y, z)

    def textmsg(self, s1: Any, s2: Any = "") -> None:
        """Write a line to the log."""
        self._controller.tell("text", show(s1) + show(s2))

    def popup(
        self, s: Any, title: Any = "Popup", warning: Any = False, error: Any = False, blocking: Any = False
    ) -> None:
        """Show a message that the operator has to close."""
        self._controller.popup = show(s)
        self._controller.tell("popup", show(s))

    def set_watchdog(self, variable_name: Any, min_frequency: Any, action: Any = "pause") -> None:
        """Pause or stop the program if a client does not write an input often enough."""
        name, doing = str(variable_name), str(action).lower()
        if doing not in ("pause", "stop", "ignore"):
            raise ScriptError(f"a watchdog can 'pause', 'stop' or 'ignore', not '{doing}'")
        if number(min_frequency) == 0.0 or doing == "ignore":
            self._controller.watchdogs.remove(name)
            return
        self._controller.watchdogs.set(name, 1.0 / positive(min_frequency, "min_frequency"), doing)


_GROUPS = {"standard_digital": (0, 7), "configurable_digital": (8, 7), "tool_digital": (16, 1), "digital": (0, 15)}
"""First bit and highest number of each group of digital signals."""


class Signalling:
    """The register and signal commands of one controller.

    Args:
        controller: owner of registers and signals.
    """

    def __init__(self, controller: ControllerAccess) -> None:
        self._registers = controller.registers
        self._signals = controller.signals

    def commands(self) -> dict[str, Command]:
        """Return the commands by name."""
        r, by_name = self._registers, {}
        for name, store in (("integer", (r.input_int, r.output_int)), ("float", (r.input_double, r.output_double))):
            inputs, outputs = store
            by_name[f"read_input_{name}_register"] = _reader(inputs)
            by_name[f"read_output_{name}_register"] = _reader(outputs)
            by_name[f"write_output_{name}_register"] = _writer(outputs, integer=name == "integer")
        by_name["read_input_boolean_register"] = lambda at: bool(r.input_bits >> whole(at, 0, 127, "register") & 1)
        by_name["read_output_boolean_register"] = lambda at: bool(r.output_bits >> whole(at, 0, 127, "register") & 1)
        by_name["write_output_boolean_register"] = self._write_bit
        for group, (first, highest) in _GROUPS.items():
            by_name[f"set_{group}_out"] = self._digital_setter(first, highest)
            by_name[f"get_{group}_out"] = self._digital_getter(first, highest, inputs=False)
            by_name[f"get_{group}_in"] = self._digital_getter(first, highest, inputs=True)
        for name in ("set_analog_out", "set_standard_analog_out"):
            by_name[name] = self.set_analog
        for name in ("set_analog_outputdomain", "set_standard_analog_output_domain"):
            by_name[name] = self.set_domain
        for name in ("get_analog_out", "get_standard_analog_out"):
            by_name[name] = lambda n: self._signals.analog_reading(whole(n, 0, 1, "output"))
        for name in ("get_analog_in", "get_standard_analog_in"):
            by_name[name] = lambda n: self._signals.analog_in[whole(n, 0, 1, "input")]
        return {name: Command(function) for name, function in by_name.items()}

    def _write_bit(self, at: Any, value: Any) -> None:
        bit = 1 << whole(at, 0, 127, "register")
        self._registers.output_bits = self._registers.output_bits | bit if value else self._registers.output_bits & ~bit

    def _digital_setter(self, first: int, highest: int) -> Callable[..., Any]:
        return lambda n, b: self._signals.set_output(first + whole(n, 0, highest, "output"), bool(b))

    def _digital_getter(self, first: int, highest: int, *, inputs: bool) -> Callable[..., Any]:
        def get(n: Any) -> bool:
            bits = self._signals.digital_in if inputs else self._signals.digital_out
            return bool(bits >> (first + whole(n, 0, highest, "signal")) & 1)

        return get

    def set_analog(self, n: Any, f: Any) -> None:
        """Set an analogue output as a fraction of its range."""
        self._signals.analog_out[whole(n, 0, 1, "output")] = min(1.0, max(0.0, number(f)))

    def set_domain(self, n: Any, domain: Any) -> None:
        """Set the domain of an analogue output: ampere (0) or volt (1)."""
        self._signals.analog_voltage[whole(n, 0, 1, "output")] = bool(whole(domain, 0, 1, "domain"))


def _reader(store: list[Any]) -> Callable[..., Any]:
    def read(at: Any) -> Any:
        if type(at) is int and 0 <= at < REGISTERS:
            return store[at]
        return store[whole(at, 0, REGISTERS - 1, "register")]

    return read


def _writer(store: list[Any], *, integer: bool) -> Callable[..., Any]:
    def write(at: Any, value: Any) -> None:
        written = number(value)
        if integer:
            written = (int(written) + 0x80000000) % 0x100000000 - 0x80000000
        store[whole(at, 0, REGISTERS - 1, "register")] = written

    return write
