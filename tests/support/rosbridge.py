"""A rosbridge server, as ROSBRIDGE_PROTOCOL.md of rosbridge_suite describes it, with a robot behind it; no ROS.

Its joint states come with another node's in between, and their joints are in alphabetical order from the end. As in
rosbridge 2 and 3, goals go on when their client has gone, and without `threads` a goal blocks what follows it.
"""

from __future__ import annotations

import contextlib
import json
import threading
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from websockets.exceptions import ConnectionClosed
from websockets.sync.server import Server, ServerConnection, serve

from tests.plugins.decant_example.simulated_robot import SimulatedRobot

SUCCEEDED, CANCELED, ABORTED = 4, 5, 6
"""Of action_msgs/msg/GoalStatus."""


class Rosbridge:
    """Serves on loopback until `close`.

    Args:
        robot: behind the action and the topic.
        threads: the server's parameter 'send_action_goals_in_new_thread'.

    Attributes:
        goals: arguments of all goals that were accepted.
        failure: what a result says, apart from its goal, if goals can't be sent to an action server; else empty.
    """

    def __init__(self, robot: SimulatedRobot, threads: bool = True) -> None:
        self.robot, self._threads = robot, threads
        self.goals: list[dict[str, Any]] = []
        self.failure: dict[str, Any] = {}
        self._canceled: dict[str, threading.Event] = {}
        self._clients: set[ServerConnection] = set()
        self.port = 0
        self.start()

    def start(self) -> None:
        self._server: Server = serve(self._serve, "127.0.0.1", self.port)
        self.port = self._server.socket.getsockname()[1]
        threading.Thread(target=self._server.serve_forever, daemon=True).start()

    def close(self) -> None:
        """Close all connections, and accept no more."""
        self._server.shutdown()
        for client in list(self._clients):
            client.close()

    def _serve(self, client: ServerConnection) -> None:
        self._clients.add(client)
        try:
            for text in client:
                message = json.loads(text)
                getattr(self, f"_{message['op']}")(client, message)
        except ConnectionClosed:
            pass
        finally:
            self._clients.discard(client)

    def _later(self, work: Callable[..., None], *arguments: Any) -> None:
        def quietly() -> None:
            with contextlib.suppress(ConnectionClosed):
                work(*arguments)

        threading.Thread(target=quietly, daemon=True).start()

    # ---- operations

    def _call_service(self, client: ServerConnection, message: dict[str, Any]) -> None:
        assert message["service"] == "/rosapi/get_param"
        assert message["args"]["name"] == "/rosbridge_websocket:send_action_goals_in_new_thread"
        answer = {"op": "service_response", "id": message["id"], "service": message["service"], "result": True}
        client.send(json.dumps({**answer, "values": {"value": json.dumps(self._threads)}}))

    def _subscribe(self, client: ServerConnection, message: dict[str, Any]) -> None:
        assert (message["topic"], message["type"]) == ("/joint_states", "sensor_msgs/msg/JointState")
        self._later(self._publish, client)

    def _publish(self, client: ServerConnection) -> None:
        while client in self._clients:
            moment, joints = self.robot.measure()
            names = [f"joint{k + 1}" for k in range(len(joints))]
            for name, position in (["finger"], [0.04]), (names[::-1], joints[::-1].tolist()):
                stamp = {"sec": int(moment), "nanosec": int(1e9 * (moment % 1.0))}
                state = {"header": {"stamp": stamp, "frame_id": ""}, "name": name, "position": position}
                client.send(json.dumps({"op": "publish", "topic": "/joint_states", "msg": state}))
            time.sleep(0.01)

    def _send_action_goal(self, client: ServerConnection, message: dict[str, Any]) -> None:
        assert message["action"] == "/joint_trajectory_controller/follow_joint_trajectory"
        assert message["action_type"] == "control_msgs/action/FollowJointTrajectory"
        if self.failure:
            answer = {"op": "action_result", "action": message["action"], "id": message["id"]}
            client.send(json.dumps({**answer, **self.failure}))
            return
        self._canceled[message["id"]] = threading.Event()
        if self._threads:
            self._later(self._follow, client, message)
        else:
            self._follow(client, message)

    def _cancel_action_goal(self, client: ServerConnection, message: dict[str, Any]) -> None:
        assert message["action"] == "/joint_trajectory_controller/follow_joint_trajectory"
        if canceled := self._canceled.get(message["id"]):
            canceled.set()

    def _follow(self, client: ServerConnection, message: dict[str, Any]) -> None:
        trajectory, canceled = message["args"]["trajectory"], self._canceled[message["id"]]
        since = [point["time_from_start"] for point in trajectory["points"]]
        assert all(0 <= time["nanosec"] < 10**9 for time in since)
        times = np.array([0.0, *(time["sec"] + 1e-9 * time["nanosec"] for time in since)])
        assert np.all(np.diff(times) > 0.0)
        order = [trajectory["joint_names"].index(f"joint{k + 1}") for k in range(len(trajectory["joint_names"]))]
        begun, joints = self.robot.measure()
        path = np.array([joints, *(np.array(point["positions"])[order] for point in trajectory["points"])])
        self.goals.append(message["args"])
        if not self.robot.tripped:
            self.robot.follow(times, path)
        status, code, text = SUCCEEDED, 0, ""
        while status == SUCCEEDED and (self.robot.measure()[0] < begun + times[-1]):
            if self.robot.tripped:
                status, code, text = ABORTED, -4, "path tolerance violated"
            elif canceled.wait(0.01):
                self.robot.hold()
                status = CANCELED
        values = {"error_code": code, "error_string": text}
        result = {"op": "action_result", "id": message["id"], "action": message["action"], "values": values}
        client.send(json.dumps({**result, "status": status, "result": True}))
