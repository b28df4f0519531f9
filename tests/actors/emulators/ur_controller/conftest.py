"""A controller to step by hand, addresses nobody else uses, and real clients in processes of their own."""

from __future__ import annotations

import json
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from actors.emulators.ur_controller import VirtualController
from actors.emulators.ur_controller.controller import Controller, RuntimeState
from actors.emulators.ur_controller.robot import MODELS
from actors.emulators.ur_controller.servers.primary_messages import ControllerMessage
from actors.runtime.child_process import child_environment
from tests.support.loopback import free_address

CLIENTS = Path(__file__).parents[3] / "support" / "ur_clients"


class Bench:
    """A controller without sockets or clock: time passes when a test says so."""

    def __init__(self, **options: Any) -> None:
        self.controller = Controller(options.pop("model", MODELS["ur10e"]), **options)
        self.messages: list[ControllerMessage] = []
        self.controller.listeners.append(self.messages.append)
        self.times: list[float] = []
        self.joints: list[Any] = []
        self.points: list[Any] = []

    @property
    def robot(self) -> Any:
        return self.controller.robot

    def tick(self, seconds: float = 0.0, ticks: int = 1) -> None:
        """Let time pass, recording targets."""
        robot = self.controller.robot
        for _ in range(round(seconds / self.controller.dt) if seconds else ticks):
            self.controller.tick()
            self.times.append(self.controller.now)
            self.joints.append(robot.mover.q)
            self.points.append(robot.tool_frame(robot.mover.q)[1])

    def start(self, program: str) -> None:
        """Upload a program, given as its statements."""
        body = "\n".join("  " + line for line in program.strip().splitlines())
        self.controller.upload(f"def test():\n{body}\nend\n")

    def run(self, program: str, limit: float = 60.0) -> float:
        """Upload a program and let time pass until it has ended. Returns how long that took [s]."""
        self.start(program)
        began = self.controller.now
        while self.controller.runtime is RuntimeState.PLAYING:
            assert self.controller.now - began < limit, f"still running after {limit} s"
            self.tick()
        return self.controller.now - began

    def said(self, kind: str) -> list[str]:
        """Messages of a kind."""
        return [message.text for message in self.messages if message.kind == kind]

    @property
    def speeds(self) -> Any:
        """(T, 6) target joint speeds [rad/s]."""
        return np.diff(np.array(self.joints), axis=0) / self.controller.dt

    @property
    def tool_speeds(self) -> Any:
        """(T,) target speeds of the tool [m/s]."""
        return np.linalg.norm(np.diff(np.array(self.points), axis=0), axis=1) / self.controller.dt


@pytest.fixture
def bench() -> Bench:
    return Bench()


class Client:
    """A scenario of `clients` with the real client library, in a process that is ended at the deadline.

    The library's constructors hold the interpreter, and its calls may block for minutes: hence the process.
    """

    def __init__(self, scenario: str, address: str, deadline: float = 40.0, **arguments: Any) -> None:
        self._scenario = scenario
        self._process = subprocess.Popen(
            [sys.executable, str(CLIENTS), scenario, address, json.dumps(arguments)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            env=child_environment(),
        )
        self._timer = threading.Timer(deadline, self._process.kill)
        self._timer.daemon = True
        self._timer.start()
        self._said: list[str] = []

    def wait_for(self, word: str) -> None:
        """Wait until it prints a word on a line of its own."""
        assert self._process.stdout is not None
        for line in self._process.stdout:
            self._said.append(line)
            if line.strip() == word:
                return
        self.end()
        raise AssertionError(f"'{self._scenario}' ended without saying '{word}':\n{''.join(self._said)}")

    def go_on(self) -> None:
        """Let it go on."""
        assert self._process.stdin is not None
        self._process.stdin.write("\n")
        self._process.stdin.flush()

    def result(self) -> dict[str, Any]:
        """Wait for its end. Returns what it saw."""
        assert self._process.stdout is not None
        self._said += self._process.stdout.readlines()
        code = self.end()
        assert code == 0, f"'{self._scenario}' ended with {code}:\n{''.join(self._said)}"
        seen: dict[str, Any] = json.loads(self._said[-1])
        return seen

    def end(self) -> int:
        """Wait for its end. Returns its exit status."""
        code = self._process.wait()
        self._timer.cancel()
        for stream in (self._process.stdin, self._process.stdout):
            if stream is not None:
                stream.close()
        return code


def observe(scenario: str, address: str, **arguments: Any) -> dict[str, Any]:
    """Run a scenario to its end. Returns what it saw."""
    return Client(scenario, address, **arguments).result()


@pytest.fixture(scope="module")
def shared() -> Iterator[VirtualController]:
    """One controller for all tests of a module, four times as fast as time."""
    with VirtualController.start(address=free_address(), time_scale=4.0) as controller:
        yield controller


@pytest.fixture
def fresh() -> Iterator[Callable[..., VirtualController]]:
    """Start controllers that end with the test."""
    started: list[VirtualController] = []

    def start(**options: Any) -> VirtualController:
        started.append(VirtualController.start(**{"address": free_address(), "time_scale": 4.0, **options}))
        return started[-1]

    yield start
    for controller in started:
        controller.close()
