"""The mover of the arm: one action at a time, one step per control cycle.

`Mover` generates target positions and velocities without jumps. A violation (a joint too fast or out of its range)
ends the action with a `ViolationError` and a stop.

The speed slider, and the controller's own slowing, scale the time of every motion but a stop: that of a path, and that
of servo and speed commands, which return when their time has passed on this slower clock. At 0 the arm stands still
within its command, while the program counts as playing. No document of the manufacturer says so for a program on the
controller; it follows from public code and reports:

- A robot at 0.5 covers half of the way to a target of `servoj` within the target's time (ros2_controllers,
  `joint_trajectory_controller/doc/speed_scaling.rst`).
- The manufacturer's own program on the controller (Universal_Robots_Client_Library, `external_control.urscript`)
  integrates a spline by one `speedj(qd, a, timestep)` per step and never reads the slider. It reaches its points at any
  slider, so that a step must take as many more cycles; issue 194 reports only that the target speed is a smaller one.
- The slider at 0 pauses the motion and not the program (Universal_Robots_ROS_Driver 737).

Not emulated: a controller may make a protective stop when the slider leaves 0 (Universal_Robots_Client_Library 58).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from math import degrees

from actors.arm.ur.robot_models import Joints, RobotModel
from actors.arm_geometry import JOINT_NAMES
from actors.emulators.ur_controller.motion.motion_actions import STILL, JointLine, JointSpeed, MotionAction, Path, Servo

PROGRAM_STOP = 5.0
"""Deceleration when a program ends or is stopped while the arm moves [rad/s²]. Plausible, not measured."""

SAFETY_STOP = 10.0
"""Deceleration of a protective, safeguard or emergency stop [rad/s²]. Plausible, not measured."""

RAMP = 2.0
"""Rate of change of the effective speed after a change of the slider [1/s]."""

_GRACE = 3
"""Cycles that a servo or speed command may be late before the arm is stopped."""

_SPEED_MARGIN = 1.1
"""Factor by which a joint may exceed its speed limit before it is a violation: rounding, filters, blends."""


class ViolationError(Exception):
    """A motion that a controller ends with a protective stop; the text gives the reason."""


class ControlledElsewhereError(Exception):
    """Two threads of a program move the arm at once."""


# More than 25 methods: one method for each motion command of URScript, on the same joints.
class Mover:
    """Targets of the six joints.

    Args:
        model: limits.
        q: initial positions [rad].

    Attributes:
        q, qd, qdd: targets [rad], [rad/s], [rad/s²].
        slider: requested speed fraction, 0 … 1.
        slowing: the controller's own speed fraction, as near a limit.
        rate: effective speed fraction.
        joint_speed, joint_range: limits; a safety configuration may narrow the model's.
    """

    def __init__(self, model: RobotModel, q: Joints) -> None:
        zero: Joints = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
        self.q, self.qd, self.qdd = q, zero, zero
        self.slider = self.slowing = 1.0
        self.rate = 1.0
        self.joint_speed = model.joint_speed
        self.joint_range: tuple[tuple[float, float], ...] = tuple((-r, r) for r in model.joint_range)
        self._action: MotionAction | None = None
        self._holder: int | None = None
        self._idle = 0
        self._frozen = False

    # ---- state

    @property
    def _wanted_rate(self) -> float:
        return self.slider * self.slowing

    @property
    def scaling(self) -> float:
        """Effective speed as a fraction of the slider's, as RTDE reports it."""
        if self._action is None or _is_stop(self._action) or self.slider == 0.0:
            return self.slowing
        return min(1.0, self.rate / self.slider)

    @property
    def moving(self) -> bool:
        """Whether a target still changes."""
        return self._action is not None or any(abs(v) > STILL for v in self.qd)

    @property
    def action(self) -> MotionAction | None:
        """The current action."""
        return self._action

    @property
    def frozen(self) -> bool:
        """Whether paths are paused until `thaw`."""
        return self._frozen

    # ---- owner

    @property
    def holder(self) -> int | None:
        """Thread whose command moves the arm; None if none does."""
        return self._holder

    def take(self, thread: int) -> None:
        """Begin a thread's command.

        Raises:
            ControlledElsewhereError: another thread's command is still running.
        """
        if self._holder is not None and self._holder != thread:
            raise ControlledElsewhereError("another thread is already controlling the robot")
        self._holder = thread

    def let_go(self, thread: int) -> None:
        """End a thread's command, or the thread."""
        if self._holder == thread:
            self._holder = None

    # ---- commands

    def follow(
        self,
        line: Callable[[Joints], JointLine],
        speed: float,
        acceleration: float,
        *,
        duration: float = 0.0,
    ) -> Path:
        """Begin a path. The arm stops first."""
        prelude = self._braking() if any(abs(v) > STILL for v in self.qd) else None
        path = Path(line, speed, acceleration, self.joint_speed, duration=duration, prelude=prelude)
        self._set_out()
        self._action = path
        return path

    def _set_out(self) -> None:
        """From standstill, the effective speed needs no ramp."""
        if not any(abs(v) > STILL for v in self.qd) and (self._action is None or _is_stop(self._action)):
            self.rate = self._wanted_rate

    def servo(self, target: Joints, lookahead: float, gain: float) -> None:
        """Execute one servo command."""
        if not isinstance(self._action, Servo):
            self._set_out()
            self._action = Servo()
        self._action.aim(target, lookahead, gain)
        self._idle = 0

    def joint_speeds(self, target: Sequence[float], acceleration: float) -> None:
        """Execute one speed command in joint space."""
        if isinstance(self._action, JointSpeed):
            self._action.aim(target, acceleration)
        else:
            self._set_out()
            self._action = JointSpeed(target, acceleration)
        self._idle = 0

    def stop_joints(self, deceleration: float) -> MotionAction:
        """Stop in joint space."""
        self._action = JointSpeed((0.0,) * 6, deceleration)
        return self._action

    def abandon(self) -> None:
        """Stop, because no thread controls the arm any more."""
        self._holder = None
        if self._action is not None:
            self._action = self._braking()

    def freeze(self) -> None:
        """Stop quickly; a path is paused and can be resumed."""
        self._frozen = True
        if self._action is not None and not isinstance(self._action, Path):
            self._action = JointSpeed((0.0,) * 6, SAFETY_STOP)

    def thaw(self) -> None:
        """Resume."""
        self._frozen = False

    def place(self, q: Joints) -> None:
        """Set the positions at once; for the start only."""
        zero: Joints = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
        self.q, self.qd, self.qdd, self._action = q, zero, zero, None

    def _braking(self) -> JointSpeed:
        return JointSpeed((0.0,) * 6, PROGRAM_STOP)

    # ---- one cycle

    def step(self, dt: float) -> None:
        """Run one control cycle.

        Args:
            dt: its length [s].

        Raises:
            ViolationError: reason for which the motion was aborted; the arm is stopping.
        """
        action = self._action
        if action is None:
            if self.qd != _ZERO or self.qdd != _ZERO:
                self.qd = self.qdd = _ZERO
            return
        before = self.rate
        if not isinstance(action, Path) and not _is_stop(action):
            self._idle += 1
            if self._idle > _GRACE:
                self._action = action = self._braking()
        if not _is_stop(action):
            self._ramp(dt)
        try:
            if _is_stop(action):
                q = action.step(self.q, self.qd, dt)
            else:
                speeds = [v / before for v in self.qd] if before > 0.0 else _ZERO
                q = action.step(self.q, (*speeds,), dt * self.rate)  # on the scaled clock
            self._check(q, dt)
        except ViolationError as error:
            # The arm brakes. A stop needs no further action.
            self._break_off(dt)
            if _is_stop(action):
                return
            raise ViolationError(str(error)) from None
        self._advance(q, dt)
        if action.finished:
            self._action = None

    def _ramp(self, dt: float) -> None:
        if self._frozen:
            fastest = max(abs(v) for v in self.qd)
            self.rate = 0.0 if fastest <= SAFETY_STOP * dt else self.rate * (1.0 - SAFETY_STOP * dt / fastest)
        elif self.rate != (wanted := self._wanted_rate):
            step = RAMP * dt
            self.rate = max(wanted, self.rate - step) if self.rate > wanted else min(wanted, self.rate + step)

    def _check(self, q: Joints, dt: float) -> None:
        for i in range(6):
            speed = abs(q[i] - self.q[i]) / dt
            if not speed <= _SPEED_MARGIN * self.joint_speed[i]:  # written so that NaN is caught, too
                raise ViolationError(
                    f"{JOINT_NAMES[i]} would turn at {degrees(speed):.0f} deg/s; "
                    f"its limit is {degrees(self.joint_speed[i]):.0f} deg/s"
                )
            low, high = self.joint_range[i]
            if not low <= q[i] <= high and abs(q[i] - 0.5 * (low + high)) > abs(self.q[i] - 0.5 * (low + high)):
                raise ViolationError(f"{JOINT_NAMES[i]} would leave its range at {degrees(q[i]):.1f} deg")

    def _break_off(self, dt: float) -> None:
        self._action = stop = JointSpeed((0.0,) * 6, SAFETY_STOP)
        self._advance(stop.step(self.q, self.qd, dt), dt)

    def _advance(self, q: Joints, dt: float) -> None:
        a, v = self.q, self.qd
        qd: Joints = (
            (q[0] - a[0]) / dt,
            (q[1] - a[1]) / dt,
            (q[2] - a[2]) / dt,
            (q[3] - a[3]) / dt,
            (q[4] - a[4]) / dt,
            (q[5] - a[5]) / dt,
        )
        self.qdd = (
            (qd[0] - v[0]) / dt,
            (qd[1] - v[1]) / dt,
            (qd[2] - v[2]) / dt,
            (qd[3] - v[3]) / dt,
            (qd[4] - v[4]) / dt,
            (qd[5] - v[5]) / dt,
        )
        self.q, self.qd = q, qd


_ZERO: Joints = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


def _is_stop(action: MotionAction) -> bool:
    return isinstance(action, JointSpeed) and not any(action.target)
