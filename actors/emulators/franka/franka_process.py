"""`python -m actors.emulators.franka.franka_process`: franky-sim with the clock of a virtual bench.

The simulated robot speaks libfranka's protocol at its address. The devices of the bench wait for it, and it for them:
while a client moves it, their clock is the simulation's, which may be slower than the wall clock. While it stands,
their clock is the wall clock, and the robot's own time runs slower, since nothing happens in it. A client may be late
by `LATE`, then the robot waits for it, since the host may be slow; a real one stops. After `LONGEST_STAND` it hangs,
and a reflex stops the robot.

A line of JSON is answered by a line of JSON: `{"since": t}` by the joints since a time of the robot, `{"pace": s}` sets
the bench seconds per second of the clock, `{"orders": ["trip"]}` is a fault.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import sys
import threading
import time
from collections import deque
from pathlib import Path
from typing import Any

from franky_sim import franka_robot_server
from franky_sim.franka_robot_protocol import (
    AutomaticErrorRecoveryCommand,
    BaseCommand,
    MoveStatus,
    RobotCommand,
    RobotMode,
)
from franky_sim.mujoco_simulator import MujocoSimulator

from actors.emulators.franka.client_reminder import ClientReminder
from actors.runtime.bench_clock import LONGEST_STAND, SharedClock

TICK = 1e-3
"""Control cycle of the robot [s]."""

LATE = 10
"""Cycles by which the client's commands may be late before the robot waits for them."""

EVERY = 8
"""Cycles between two samples of the history."""

CREEP = 2e-4
"""Changes of the joints that do not count [rad]: a standing robot of franky-sim sags by a little more."""

SILENCE = 0.2
"""Wall time after which a moving robot makes a cycle although the clock of the bench stands, or its client is late [s]:
libfranka counts a second of silence as a lost connection."""

KEPT = 600.0
"""Time for which samples are kept [s]."""

STANDING = 4e-3
"""Time between two cycles while no client moves the robot [s of the clock]."""


class Ports(franka_robot_server.FrankaRobotServer):  # type: ignore[misc]  # it has no types
    """The robot's ports, with what franky-sim leaves out: late clients, reflexes, a pulled cable."""

    reflex = unplugged = False
    quiet = 0
    """States that were sent since the last command of a motion; 0 before its first one."""
    reminder: ClientReminder

    def start_motion(self, *arguments: Any) -> None:
        """Begin a motion."""
        self.quiet = 0
        super().start_motion(*arguments)

    def _handle_udp_command(self, command_data: bytes) -> None:
        self.quiet = 1
        super()._handle_udp_command(command_data)

    def send_state(self) -> None:
        """Send the state to a client."""
        super().send_state()
        self.quiet += self.quiet > 0
        if self._FrankaServer__message_id == 1:
            size = 8 + len(self._get_state_bytes())
            client = self._FrankaServer__client_address, self._FrankaServer__client_udp_port
            self.reminder.remind(client, size, self._FrankaServer__udp_socket)

    def reset_state(self) -> None:
        """Let go of the client."""
        super().reset_state()
        self.reminder.forget()

    @property
    def late(self) -> bool:
        """Whether the robot has to wait for its client's command."""
        return self.current_motion_id > 0 and self.quiet > LATE

    @property
    def robot_state(self) -> Any:
        """The state that is sent."""
        state = super().robot_state
        return state.replace(robot_mode=RobotMode.kReflex) if self.reflex else state

    def trip(self) -> None:
        """Stop with a reflex."""
        self.reflex = True
        if motion := self.current_motion_id:
            self.stop_motion(send_preemption_signal=False)
            BaseCommand.send_response(self._tcp_socket, RobotCommand.kMove, motion, MoveStatus.kReflexAborted)
            self.reset_current_motion_id()


class Recovery(AutomaticErrorRecoveryCommand):  # type: ignore[misc]  # it has no types
    """A client's word that the robot may recover from a reflex."""

    def handle(self, server: Any) -> None:
        """Recover."""
        server.reflex = False
        super().handle(server)


class VirtualFranka:
    """The simulated robot, its clock and its history.

    Args:
        simulator: it has one robot.
        address: of the robot's ports.
        clock: of the bench.
        time_scale: bench seconds per second of the clock.
    """

    def __init__(self, simulator: MujocoSimulator, address: str, clock: SharedClock, time_scale: float) -> None:
        self._simulator, self._clock, self._scale = simulator, clock, time_scale
        (self._robot,) = simulator.robots
        franka_robot_server.AutomaticErrorRecoveryCommand = Recovery  # the class that a new server looks up
        self._ports = Ports(self._robot, [address])
        self._ports.init()
        simulator.start()
        self._samples: deque[tuple[float, list[float], str]] = deque(maxlen=round(KEPT / (EVERY * TICK)))
        self._waited = 0.0
        self._cycles = 0
        self._orders: deque[str] = deque()
        self._ended = threading.Event()

    def run(self) -> None:
        """Run control cycles until the input ends."""
        threading.Thread(target=self._answer, daemon=True).start()
        due = time.monotonic()
        while not self._ended.is_set():
            moves = self._ports.current_motion_id > 0
            period, longest = (TICK / self._scale, SILENCE) if moves else (STANDING, STANDING)
            waits = time.monotonic() + longest
            while not (passes := self._clock.may_pass(period)) and time.monotonic() < waits:
                self._clock.advance(0.0)
                time.sleep(2e-4)
            self._cycle()
            self._clock.advance(period if passes else 0.0)
            due = max(due + period, time.monotonic() - 0.1)  # never faster than the wall clock, but for short delays
            if (left := due - time.monotonic()) > 0.0:
                time.sleep(left)
        self._ports.cleanup()

    def _cycle(self) -> None:
        ports = self._ports
        while self._orders:
            match self._orders.popleft():
                case "trip":
                    ports.trip()
                case "mend":
                    ports.reflex = False
                case "unplug":
                    ports.reset_state()
                    ports.unplugged, self._held = True, self._robot.inner_state.q
                case "plug":
                    ports.unplugged = False
        if ports.unplugged:
            self._robot.joint_position_control(self._held)
        else:
            ports.process_commands()
            waits = time.monotonic() + SILENCE
            while (late := ports.late) and time.monotonic() < waits:
                self._clock.advance(0.0)
                time.sleep(2e-4)
                ports.process_commands()
            self._waited = self._waited + SILENCE if late else 0.0
            if self._waited >= LONGEST_STAND:
                ports.trip()
        self._simulator.step()
        ports.send_state()
        self._cycles += 1
        if self._cycles % EVERY == 0:
            joints, before = list(map(float, self._robot.inner_state.q)), self._samples[-1][1] if self._samples else []
            if before and max(abs(a - b) for a, b in zip(joints, before, strict=True)) < CREEP:
                joints = before
            self._samples.append((self._cycles * TICK, joints, json.dumps(joints)))

    def _answer(self) -> None:
        for line in sys.stdin:
            request = json.loads(line)
            self._scale = request.get("pace", self._scale)
            self._orders.extend(request.get("orders", []))
            later = [(t, text) for t, _, text in list(self._samples) if t > request.get("since", 1e12)]
            # The joints are encoded one by one: no thread could send states while a long text is encoded at once.
            joints, times = ", ".join(text for _, text in later), ", ".join(repr(t) for t, _ in later)
            _say(f'{{"now": {self._cycles * TICK!r}, "times": [{times}], "joints": [{joints}]}}')
        self._ended.set()


def main() -> None:
    """Serve until the input ends."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--address", required=True)
    parser.add_argument("--clock", required=True, type=Path)
    parser.add_argument("--time-scale", type=float, default=1.0)
    parser.add_argument("--joints", required=True)
    chosen = parser.parse_args()
    joints = [float(q) for q in chosen.joints.split(",")]
    Ports.reminder = ClientReminder()
    with contextlib.redirect_stdout(sys.stderr), MujocoSimulator() as simulator:
        simulator.add_robot(initial_q=joints)
        robot = VirtualFranka(simulator, chosen.address, SharedClock(chosen.clock), chosen.time_scale)
        _say(json.dumps({"ready": chosen.address}))
        robot.run()
        Ports.reminder.close()
        SharedClock.remove(chosen.clock)


def _say(answer: str) -> None:
    sys.__stdout__.write(answer + "\n")  # type: ignore[union-attr]
    sys.__stdout__.flush()  # type: ignore[union-attr]


if __name__ == "__main__":
    main()
