"""The arm: its commanded and measured state, tool and payload, power modes, and the emulated models.

`Robot` follows the targets of its `Mover` and reports measured values. `Power` switches between the power modes with
their delays. `MODELS` lists the robots with the controllers that the emulator imitates.
"""

from __future__ import annotations

import random
from collections import deque
from dataclasses import dataclass, fields, replace
from enum import IntEnum
from math import exp, radians

from actors.arm.ur import robot_models as models
from actors.arm.ur.robot_models import Joints, RobotModel
from actors.emulators.ur_controller.motion.mover import Mover, ViolationError
from actors.emulators.ur_controller.robot_kinematics import (
    Kinematics,
    Transform,
    Vector,
    compose,
    distance,
    pose_of,
    transform_of,
)
from actors.emulators.ur_controller.safety_system import SafetyConfiguration

TRACKING_LAG = 0.004
"""Time constant with which healthy joints follow their targets [s]. Plausible, not measured."""

STEADY = 1e-4
"""Joint speed below which the arm counts as steady [rad/s]."""

SETTLING = 0.2
"""Time below `STEADY` until the arm counts as steady [s]."""

HISTORY_RATE = 125.0
"""Positions stored per second of controller time [Hz]."""

HISTORY_TIME = 600.0
"""Time for which positions are stored [s]; at thirty times the pace, 20 s in which a busy host may read none."""

Pose = tuple[float, float, float, float, float, float]


class Robot:
    """Joints, tool and payload.

    Args:
        model: robot model.
        q: initial positions [rad].
        configuration: safety limits.

    Attributes:
        q, qd: measured positions and speeds, noise included [rad], [rad/s].
        noise: standard deviation of the measured positions [rad].
        lag: time constant with which the joints follow their targets [s].
        payload: [kg]; `cog` [m], `inertia` [kg m²].
        gravity: direction in the base's frame [m/s²].
        external_force: on the tool, in the base's frame [N], [N m]; it moves nothing.
        history: (time, q) as executed, without noise, at `HISTORY_RATE`.
    """

    def __init__(self, model: RobotModel, q: Joints, configuration: SafetyConfiguration) -> None:
        self.model = model
        self.kinematics = Kinematics(model)
        self.mover = Mover(model, q)
        self.tcp: Pose = (0.0,) * 6
        self._tool = transform_of(self.tcp)
        self.payload = 0.0
        self.cog: Vector = (0.0, 0.0, 0.0)
        self.inertia: Pose = (0.0,) * 6
        self.gravity: Vector = (0.0, 0.0, 9.82)
        self.external_force: Pose = (0.0,) * 6
        self.noise = 0.0
        self.lag = TRACKING_LAG
        self._random = random.Random(0)
        self._true = q
        self.q, self.qd = q, self.mover.qd
        self._point = self.tool_frame(q)[1]
        self._steady_for = SETTLING
        self.history: deque[tuple[float, Joints]] = deque(maxlen=int(HISTORY_RATE * HISTORY_TIME))
        self._next_memory = 0.0
        self._cache: dict[str, object] = {}
        self.configure(configuration)

    def configure(self, configuration: SafetyConfiguration) -> None:
        """Apply safety limits."""
        self.configuration = configuration
        self.mover.joint_range = configuration.joint_ranges
        self.mover.joint_speed = configuration.joint_speeds

    def set_tcp(self, pose: Pose) -> None:
        """Set the tool: its centre point in the flange's frame."""
        self.tcp = pose
        self._tool = transform_of(pose)
        self._point = self.tool_frame(self.mover.q)[1]
        self._cache.clear()

    def tool_frame(self, q: Joints) -> Transform:
        """Transform of the tool centre point at joint positions [rad]."""
        return compose(self.kinematics.flange(q), self._tool)

    def forget(self) -> None:
        """Reset as after a power cut: no tool, no payload, no history."""
        self.set_tcp((0.0,) * 6)
        self.payload, self.cog, self.inertia = 0.0, (0.0, 0.0, 0.0), (0.0,) * 6
        self.history.clear()
        self._next_memory = 0.0

    def step(self, now: float, dt: float) -> None:
        """Run one control cycle.

        Raises:
            ViolationError: a limit was exceeded; the mover is stopping already, or must be stopped.
        """
        self._cache.clear()
        moves = self.mover.moving
        try:
            self.mover.step(dt)
            if moves:
                self._check(dt)
        finally:
            self._follow(now, dt, moves)

    def _check(self, dt: float) -> None:
        before, point = self._point, self.tool_frame(self.mover.q)[1]
        self._point = point
        speed = distance(before, point) / dt
        if speed > 1.05 * self.configuration.tool_speed:
            raise ViolationError(
                f"the tool moves at {speed:.2f} m/s; its limit is {self.configuration.tool_speed:.2f} m/s"
            )
        if self.configuration.planes:
            beyond = self.configuration.point_violation(point)
            if beyond is not None and self._deeper(before, point):
                raise ViolationError(beyond)

    def _deeper(self, before: Vector, point: Vector) -> bool:
        """Whether a step moved further out of the allowed space; the motion back is permitted."""

        def inside(p: Vector) -> float:
            return min(
                sum(a * b for a, b in zip(x.normal, p, strict=True)) - x.offset for x in self.configuration.planes
            )

        return inside(point) < inside(before)

    def _follow(self, now: float, dt: float, moves: bool) -> None:
        target, true = self.mover.q, self._true
        if moves or true != target:
            share = 1.0 - exp(-dt / self.lag)
            reached = [a + share * (b - a) for a, b in zip(true, target, strict=True)]
            if all(abs(a - b) < 1e-9 for a, b in zip(reached, target, strict=True)):
                reached = list(target)
            fresh: Joints = (reached[0], reached[1], reached[2], reached[3], reached[4], reached[5])
            rates = [(b - a) / dt for a, b in zip(true, fresh, strict=True)]
            self.qd = (rates[0], rates[1], rates[2], rates[3], rates[4], rates[5])
            self._true = fresh
        elif self.qd != _ZERO:
            self.qd = _ZERO
        if self.noise > 0.0:
            noisy = [a + self._random.gauss(0.0, self.noise) for a in self._true]
            self.q = (noisy[0], noisy[1], noisy[2], noisy[3], noisy[4], noisy[5])
        else:
            self.q = self._true
        self._steady_for = self._steady_for + dt if max(map(abs, self.qd)) < STEADY else 0.0
        if now >= self._next_memory:
            self._next_memory = now + 1.0 / HISTORY_RATE - 1e-9
            self.history.append((now, self._true))

    # ---- reported values

    @property
    def steady(self) -> bool:
        """Whether the arm has been still for `SETTLING`."""
        return self._steady_for >= SETTLING

    @property
    def frame(self) -> Transform:
        """Transform of the tool centre point, as measured."""
        cached = self._cache.get("frame")
        if cached is None:
            cached = self._cache["frame"] = self.tool_frame(self.q)
        return cached  # type: ignore[return-value]

    @property
    def pose(self) -> Pose:
        """Pose of the tool centre point, as measured."""
        cached = self._cache.get("pose")
        if cached is None:
            cached = self._cache["pose"] = pose_of(self.frame)
        return cached  # type: ignore[return-value]

    @property
    def target_pose(self) -> Pose:
        """Target pose of the tool centre point."""
        cached = self._cache.get("target_pose")
        if cached is None:
            cached = self._cache["target_pose"] = pose_of(self.tool_frame(self.mover.q))
        return cached  # type: ignore[return-value]

    @property
    def tool_speed(self) -> Pose:
        """Measured velocity of the tool centre point [m/s], [rad/s]."""
        if self.qd == _ZERO:
            return _ZERO
        cached = self._cache.get("tool_speed")
        if cached is None:
            cached = self._cache["tool_speed"] = self.kinematics.velocity(self.q, self.qd, self.frame[1])
        return cached  # type: ignore[return-value]

    @property
    def elbow_velocity(self) -> Vector:
        """Measured velocity of the elbow, which the first two joints move [m/s]."""
        if self.qd == _ZERO:
            return 0.0, 0.0, 0.0
        elbow = self.kinematics.axes(self.q)[1][2]
        x, y, z, *_ = self.kinematics.velocity(self.q, (self.qd[0], self.qd[1], 0.0, 0.0, 0.0, 0.0), elbow)
        return x, y, z

    @property
    def deviation(self) -> float:
        """Largest distance of a joint from its target [rad]."""
        return max(abs(a - b) for a, b in zip(self.q, self.mover.q, strict=True))

    @property
    def target_tool_speed(self) -> Pose:
        """Target velocity of the tool centre point [m/s], [rad/s]."""
        if self.mover.qd == _ZERO:
            return _ZERO
        point = self.tool_frame(self.mover.q)[1]
        return self.kinematics.velocity(self.mover.q, self.mover.qd, point)


_ZERO: Joints = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


class RobotMode(IntEnum):
    """Robot mode as RTDE and the dashboard report it."""

    NO_CONTROLLER = -1
    DISCONNECTED = 0
    CONFIRM_SAFETY = 1
    BOOTING = 2
    POWER_OFF = 3
    POWER_ON = 4
    IDLE = 5
    BACKDRIVE = 6
    RUNNING = 7
    UPDATING_FIRMWARE = 8


BOOT_TIME = 4.0
"""Time from 'power on' until the joints respond [s]. Plausible, not measured."""

POWER_ON_TIME = 1.0
"""Time from the response of the joints to idle [s]."""

BRAKE_TIME = 3.0
"""Time from 'brake release' to running [s]."""


class Power:
    """Power modes over controller time.

    Args:
        mode: initial mode.
    """

    def __init__(self, mode: RobotMode = RobotMode.RUNNING) -> None:
        self.mode = mode
        self._plan: list[tuple[float, RobotMode]] = []

    @property
    def powered(self) -> bool:
        """Whether the joints have power."""
        return self.mode in (RobotMode.POWER_ON, RobotMode.IDLE, RobotMode.BACKDRIVE, RobotMode.RUNNING)

    @property
    def running(self) -> bool:
        """Whether the brakes are off and the arm may move."""
        return self.mode is RobotMode.RUNNING

    def on(self, now: float) -> None:
        """Switch on; idle after some seconds."""
        if self.mode is RobotMode.POWER_OFF and not self._plan:
            self.mode = RobotMode.BOOTING
            self._plan = [(now + BOOT_TIME, RobotMode.POWER_ON), (now + BOOT_TIME + POWER_ON_TIME, RobotMode.IDLE)]

    def release_brakes(self, now: float) -> None:
        """Release the brakes, after switching on if necessary."""
        self.on(now)
        if self.mode is RobotMode.RUNNING or (self._plan and self._plan[-1][1] is RobotMode.RUNNING):
            return
        idle = self._plan[-1][0] if self._plan else now
        self._plan.append((idle + BRAKE_TIME, RobotMode.RUNNING))

    def off(self) -> None:
        """Switch off; the brakes close."""
        self.mode, self._plan = RobotMode.POWER_OFF, []

    def step(self, now: float) -> None:
        """Let time pass."""
        while self._plan and now >= self._plan[0][0]:
            self.mode = self._plan.pop(0)[1]


@dataclass(frozen=True, kw_only=True)
class ControlledModel(RobotModel):
    """One robot model with its controller.

    Attributes:
        version: of the controller's software: major, minor, bugfix, build.
        remote_control: whether the controller has the remote-control mode.
        serial: its number; digits only.
    """

    version: tuple[int, int, int, int]
    remote_control: bool
    serial: str

    @property
    def primary_type(self) -> tuple[int, int]:
        """Robot type and subtype in configuration data."""
        return self.kind, 2 if self.cb3 else 1

    @property
    def polyscope_x(self) -> bool:
        """Whether it runs PolyScope X, with a Robot API instead of the dashboard."""
        return self.version[0] >= 10

    @property
    def e_series(self) -> bool:
        """Whether the controller belongs to the generation after CB3."""
        return self.version[0] >= 5


CB3_SOFTWARE, E_SERIES_SOFTWARE, LATER_SOFTWARE = (3, 15, 8, 106339), (5, 12, 6, 1102099), (5, 17, 2, 1000000)
X_SOFTWARE = (10, 14, 0, 0)
"""Versions of the emulated controllers' software. The builds of the last two are invented."""


def _controlled(key: str, model: RobotModel) -> ControlledModel:
    values = {item.name: getattr(model, item.name) for item in fields(model)}
    if model.cb3:
        return ControlledModel(**values, version=CB3_SOFTWARE, remote_control=False, serial="2016300123")
    elder = key in ("ur3e", "ur5e", "ur10e", "ur16e")
    version = E_SERIES_SOFTWARE if elder else LATER_SOFTWARE
    return ControlledModel(**values, version=version, remote_control=True, serial="20205300456")


MODELS = {key: _controlled(key, model) for key, model in models.MODELS.items()}
"""Models by the names of the `--model` option."""


def calibrated(model: ControlledModel) -> ControlledModel:
    """A model with the calibration of a plausible robot, which differs from nominal by millimetres."""
    return replace(model, calibration=models.plausible_calibration(model))


HOME: Joints = tuple(radians(v) for v in (0.0, -90.0, 90.0, -90.0, -90.0, 0.0))  # type: ignore[assignment]
"""Initial joint positions: a pose in the middle of the workspace, away from singularities."""
