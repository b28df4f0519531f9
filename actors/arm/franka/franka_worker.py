"""`python -m actors.arm.franka.franka_worker FD`: the process that holds the client library of a Franka arm.

It serves requests of its driver one after another, and watches that driver: no program on a Franka goes on without its
client. If the driver is gone or silent for `SILENCE` during a motion, this process brings the cup upright along the
path of the pour, or stops an upright one. It ends if the driver is gone.

Joint speeds are sent as a motion that ends by itself (`turn`), which the library's own thread keeps at 1 kHz. If this
process or the computer dies, no one commands the robot any more: it brakes as it stands, with a tilted cup.

Source: franky-control 2.0 and libfranka, their stubs and texts; tried with franky-sim 1.0.4, never with a robot.
"""

from __future__ import annotations

import contextlib
import math
import re
import sys
import time
from dataclasses import dataclass
from multiprocessing.connection import Connection
from typing import Any

import franky
import numpy as np
from numpy.typing import NDArray

from actors.arm.arm_interface import ArmFacts, ArmRefusedError
from actors.arm.franka.franka_arm import FrankaSettings
from actors.arm.joint_driver import JointReading, speeds_along
from actors.arm.planned_pour import JointPath, PourPath
from actors.arm.planning.kinematics import transform_of
from actors.arm.planning.motion_segments import upright_way
from actors.interfaces import LaboratoryError

FloatArray = NDArray[np.float64]

SILENCE = 0.2
"""Time without a request during a motion after which the driver counts as silent [s of the robot's clock]."""

WATCH = 5e-3
"""Longest time between two looks at the driver and the robot during a motion [s]."""

QUICK = 0.25
"""Time in which the cup that is brought upright without a driver reaches the limit of its tilt's speed [s]."""

REST = 0.1
"""Time for which speeds are still commanded after the end of that way [s]."""

HOLD = 0.1
"""Time for which a speed of that way is kept without a newer one [s]."""

SAME_TOOL = 2e-3, math.radians(1.0)
"""Largest difference of the tool in Desk from the one in the laboratory's file [m], [rad]."""

ERRORS = franky.Exception, RuntimeError
"""Of the client library; not all of them have a class."""

ATTEMPTS = 10
"""Readings of the state that may fail in a row."""

MODES = {
    "Other": "it is not ready: open its brakes in Desk, choose 'Execution', and activate FCI",
    "Guiding": "it is guided by hand; let it go",
    "Reflex": "a reflex has stopped it ({errors}): look for what it touched or what was too fast, then release and "
    "recover it",
    "UserStopped": "the user stop is pressed, or the external activation device is off; release it",
    "AutomaticErrorRecovery": "it recovers from an error; wait",
}
KINDS = {"UserStopped": "safeguard"}


@dataclass
class _Return:
    """The way back upright without a driver: since when, and when speeds were sent last [s of the robot's clock]."""

    way: JointPath
    begun: float
    sent: float


class Worker:
    """The requests, each a method.

    Args:
        connection: to the driver.
    """

    def __init__(self, connection: Connection) -> None:
        self._connection = connection
        self._robot: Any = None
        self._spec: FrankaSettings | None = None
        self._path: PourPath | None = None
        self._moving = False
        self._return: _Return | None = None
        self._heard = 0.0
        self._trouble = ""
        self._trouble_kind = "protective stop"

    def serve(self) -> None:
        """Serve requests until the driver closes the connection or is gone, and the cup is upright."""
        driver = True
        while driver or self._return is not None:
            try:
                if driver and self._connection.poll(WATCH if self._moving or self._return else None):
                    self._connection.send(self._answer(*self._connection.recv()))
            except (EOFError, OSError):
                driver = False
            try:
                if self._moving and (not driver or self._now() > self._heard + SILENCE):
                    self._begin_return()
                if self._return is not None:
                    self._go_on(self._return)
            except ERRORS:  # the robot is not there any more, or has stopped by itself
                self._moving, self._return = False, None
        with contextlib.suppress(*ERRORS):
            self.halt()
            if self._robot is not None:
                self._robot.join_motion(2.0)

    def _answer(self, name: str, arguments: tuple[Any, ...]) -> Any:
        try:
            self._heard = self._now()
            return getattr(self, name)(*arguments)
        except (LaboratoryError, ConnectionError) as error:
            return error
        except franky.NetworkException as error:
            return ConnectionError(f"the connection to the robot is lost: {error}")
        except ERRORS as error:
            if name not in ("turn", "halt"):
                return ConnectionError(f"the robot does not reply to '{name}': {error}")
            self._trouble = f"it has refused a command ({error}): look into it, then release and recover it"
            return None

    # ---- requests

    def open(self, spec: FrankaSettings) -> ArmFacts:
        """Connect, and compare model, end effector and load with the laboratory's file."""
        real_time = franky.RealtimeConfig.Ignore if spec.clock else franky.RealtimeConfig.Enforce
        try:
            self._robot = franky.Robot(spec.address, realtime_config=real_time)
        except franky.IncompatibleVersionException as error:
            raise ArmRefusedError(
                f"the robot at {spec.address} speaks another version of the interface ({error}): install the wheel of "
                "franky-control for its system version, see 'Connect a Franka'"
            ) from error
        except franky.RealtimeException as error:
            raise ArmRefusedError(f"this computer needs a real-time kernel: {error}") from error
        except ERRORS as error:
            raise ConnectionError(
                f"no connection to the robot at {spec.address} ({error}): check that FCI is active in Desk, that the "
                "cable is in the control box, and that no other client is in control"
            ) from error
        self._spec = spec
        self._compare(spec)
        return ArmFacts(model=spec.model, problem=self.read().problem)

    def _compare(self, spec: FrankaSettings) -> None:
        named = re.search(r'<robot[^>]*\bname="(\w+)"', self._robot.model_urdf)
        if named and named[1] != spec.model:
            raise ArmRefusedError(f"the robot at {spec.address} is a '{named[1]}'; arm.model is '{spec.model}'")
        state, tool = self._robot.state, transform_of(spec.tool)
        there = np.array(state.F_T_EE.matrix)
        apart = float(np.linalg.norm(there[:3, 3] - tool.position))
        cosine = 0.5 * (float(np.trace(there[:3, :3].T @ tool.rotation)) - 1.0)
        turned = math.acos(max(-1.0, min(1.0, cosine)))
        if apart > SAME_TOOL[0] or turned > SAME_TOOL[1]:
            raise ArmRefusedError(
                f"the end effector in Desk differs from 'tool' by {1e3 * apart:.0f} mm and {math.degrees(turned):.0f} "
                "deg; correct one of them"
            )
        load = spec.payload - state.m_ee
        if load < 0.0:
            raise ArmRefusedError(
                f"the end effector in Desk has {state.m_ee:.2f} kg, more than 'payload', which includes it"
            )
        moment = spec.payload * np.array(spec.payload_centre.vector) - state.m_ee * np.ravel(state.F_x_Cee)
        centre = moment / load if load > 0.0 else np.zeros(3)
        inertia = (load * 1e-3 * np.eye(3)).ravel().tolist()  # of a cup of some centimetres
        self._robot.set_load(load, centre.tolist(), inertia)

    def read(self) -> JointReading:
        """The robot's state, with its problem as a sentence."""
        state = self._state
        mode = state.robot_mode.name
        problem, kind = self._trouble, self._trouble_kind
        if mode in MODES:
            errors = str(state.last_motion_errors).strip("[]") or "no reason reported"
            problem, kind = MODES[mode].format(errors=errors), KINDS.get(mode, "protective stop")
        return JointReading(state.time.to_sec(), np.ravel(state.q).astype(float), problem, kind)

    def pours(self, path: PourPath | None) -> None:
        """See `FrankaRobot.pours`."""
        self._path = path

    def turn(self, speeds: FloatArray, seconds: float) -> None:
        """See `VelocityRobot.turn`: the speeds, then 0; the library follows within the robot's own limits."""
        if self._return is None:
            self._moving = True
            self._send(speeds, seconds)

    def halt(self) -> None:
        """Stop; a cup that is brought upright without the driver is not stopped."""
        self._moving = False
        if self._return is None and self._robot is not None and self._robot.is_in_control:
            self._robot.move(franky.JointVelocityStopMotion(), asynchronous=True)

    def recover(self) -> str:
        """See `FrankaRobot.recover`."""
        if not self._robot.recover_from_errors():
            raise ArmRefusedError("the robot does not recover; look at Desk for its message")
        return "recovered from its errors"

    # ---- the robot

    @property
    def _state(self) -> Any:
        """The newest state: without a motion, the oldest one in the socket's buffer comes first."""
        for left in reversed(range(ATTEMPTS)):
            try:
                state = self._robot.state
                return state if self._robot.is_in_control else self._robot.state
            except franky.Exception:
                raise
            except RuntimeError:  # an error of the network's library, seen on busy computers
                if not left:
                    raise
                time.sleep(2e-3)
        raise AssertionError

    def _now(self) -> float:
        return 0.0 if self._robot is None else float(self._state.time.to_sec())

    def _send(self, speeds: FloatArray, seconds: float) -> None:
        hold = franky.Duration(max(round(1e3 * seconds), 0))
        waypoints = [
            franky.JointVelocityWaypoint(speeds, hold_target_duration=hold),
            franky.JointVelocityWaypoint(np.zeros(len(speeds))),
        ]
        self._robot.move(franky.JointVelocityWaypointMotion(waypoints), asynchronous=True)

    # ---- without a driver

    def _begin_return(self) -> None:
        """Begin to bring the cup of a pour upright along its path; an upright cup is stopped."""
        path, spec = self._path, self._spec
        assert spec is not None
        self._trouble_kind, self._trouble = "watchdog", "the driver was silent, and the robot was stopped"
        if path is None:
            self.halt()
            return
        self._moving, state = False, self._state
        quick = spec.with_values(upright_speed=spec.limits.tilt_speed, approach_speed=2.0 * spec.limits.joint_speed)
        try:
            way, _ = upright_way(path, np.ravel(state.q).astype(float), quick, QUICK)
        except LaboratoryError:
            self.halt()
            return
        self._trouble = "the driver was silent, and the cup was brought upright"
        now = state.time.to_sec()
        self._return = _Return(way, now, now)

    def _go_on(self, back: _Return) -> None:
        """Keep the robot on its way back until it has arrived."""
        state = self._state
        now = state.time.to_sec()
        if now > back.begun + back.way.duration + REST:
            self._return = None
            self.halt()
        elif now > back.sent or now == back.begun:
            joints = np.ravel(state.q).astype(float)
            self._send(speeds_along(back.way, now - back.begun, now - back.sent, joints), HOLD)
            back.sent = now


if __name__ == "__main__":
    Worker(Connection(int(sys.argv[1]))).serve()
