"""An arm with a ROS 2 driver, over rosbridge: Decant's Python needs no ROS.

    arm: {kind: ros2, address: 192.168.0.20, home: [-25 deg, 35 deg, …], tool: {z: 100 mm}, …}

Replace URDF, links, names of joints, topic and action by those of your robot.
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any, Literal

import numpy as np
import roslibpy

from decant.plugins import ArmFacts, ArmRefusedError, ChainArmKind, ChainArmSettings, JointPath, JointReading

JOINTS = [f"joint{k}" for k in range(1, 8)]
STATES = "/joint_states", "sensor_msgs/msg/JointState"
ACTION = "/joint_trajectory_controller/follow_joint_trajectory", "control_msgs/action/FollowJointTrajectory"
THREADS = "/rosbridge_websocket:send_action_goals_in_new_thread"
SILENCE = 1.0  # s without joints after which the robot counts as lost


class Ros2Settings(ChainArmSettings):
    """An arm with a ROS 2 driver."""

    urdf = Path(__file__).with_name("seven_joints.urdf")
    base_link, flange_link = "base", "flange"

    kind: Literal["ros2"] = "ros2"
    """An arm with a ROS 2 driver."""

    address: str = "127.0.0.1"
    """Address of rosbridge."""

    port: int = 9090
    """Its port."""


class Ros2Robot:
    """See `decant.plugins.JointRobot`."""

    def __init__(self, spec: Ros2Settings) -> None:
        self._spec, self._goal = spec, ""
        self._ros: Any = None

    def connect(self) -> ArmFacts:
        self.close()
        self._received, self._problem = 0.0, ""
        self._reading: Any = None
        self._ros = roslibpy.Ros(self._spec.address, self._spec.port)
        try:
            self._ros.run(5.0)
            threads = roslibpy.Service(self._ros, "/rosapi/get_param", "rosapi_msgs/srv/GetParam")
            if threads.call({"name": THREADS}, timeout=5.0)["value"] != "true":
                raise ArmRefusedError("start rosbridge with send_action_goals_in_new_thread:=true; else nothing stops")
        except roslibpy.core.RosTimeoutError as error:
            raise ConnectionError(f"no rosbridge at {self._spec.address}:{self._spec.port}: {error}") from None
        roslibpy.Topic(self._ros, *STATES, throttle_rate=5).subscribe(self._take)
        self._action = roslibpy.ActionClient(self._ros, *ACTION)
        until = time.monotonic() + 5.0
        while self._reading is None and time.monotonic() < until:
            time.sleep(0.01)
        return ArmFacts(model="ros2", problem=self.read().problem)

    def _take(self, message: dict[str, Any]) -> None:
        joints = dict(zip(message["name"], message["position"], strict=True))  # in any order, with others between
        if joints.keys() >= set(JOINTS):
            stamp = message["header"]["stamp"]
            measured = np.array([joints[name] for name in JOINTS], dtype=float)
            self._reading = stamp["sec"] + 1e-9 * stamp["nanosec"], measured
            self._received = time.monotonic()

    def read(self) -> JointReading:
        if self._ros is None or not self._ros.is_connected or time.monotonic() > self._received + SILENCE:
            raise ConnectionError(f"no joints from rosbridge at {self._spec.address}:{self._spec.port}")
        stamp, joints = self._reading
        return JointReading(stamp, joints, self._problem)

    def begin(self, path: JointPath) -> None:
        points = [
            {"positions": q.tolist(), "time_from_start": {"sec": int(t), "nanosec": int(1e9 * (t % 1.0))}}
            for t, q in zip(path.times[1:], path.joints[1:], strict=True)
        ]
        goal = roslibpy.Goal({"trajectory": {"joint_names": JOINTS, "points": points}})
        self._goal = self._action.send_goal(goal, self._end, lambda feedback: None, self._end)

    def _end(self, result: dict[str, Any]) -> None:
        if result["status"] not in (roslibpy.GoalStatus.SUCCEEDED, roslibpy.GoalStatus.CANCELED):
            self._problem = f"its controller has given the motion up: {result['values']}; look into it and recover it"

    def halt(self) -> None:
        self.read()
        if self._goal:
            self._action.cancel_goal(self._goal)

    def close(self) -> None:
        if self._ros is not None:
            self._ros.factory.stopTrying()
            self._ros.close()


class Ros2Kind(ChainArmKind[Ros2Settings]):
    """Arms with a ROS 2 driver."""

    settings, robot = Ros2Settings, Ros2Robot
