"""An arm at a virtual controller of its own, and what the controller saw."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from actors.arm.planned_pour import PourPath
from actors.arm.ur.ur_driver import UrArm
from actors.contract_tests import contract_calls
from actors.emulators.ur_controller import VirtualController
from actors.runtime.bench_clock import SharedClock
from tests.support.loopback import free_address
from tests.support.ur_pours import HOME, START, pour_path, settings
from tests.support.waiting import PATIENCE

SCALE = 10.0


class Call(contract_calls.Call):
    """A blocking call in a thread, with what it gave."""

    def result(self, patience: float = PATIENCE) -> Any:
        self.join(patience)
        assert not self.is_alive(), "the call did not come back"
        if self.error is not None:
            raise self.error
        return self.value


class Rig:
    """Arm, controller, and a pour to make."""

    def __init__(self, controller: VirtualController, arm: UrArm, path: PourPath) -> None:
        self.controller, self.arm, self.path = controller, arm, path
        self.called: Call | None = None

    def fault(self, name: str, **arguments: Any) -> dict[str, Any]:
        return self.controller.fault(name, **arguments)

    @property
    def now(self) -> float:
        return float(self.fault("state")["time"])

    @property
    def joints(self) -> np.ndarray:
        return np.array(self.fault("state")["joints"])

    @property
    def worker(self) -> int:
        """Process id."""
        pid = self.arm._session.pid
        assert pid is not None
        return pid

    def history(self, since: float) -> tuple[np.ndarray, np.ndarray]:
        kept = self.fault("history", since=since)
        return np.array(kept["times"]), np.array(kept["joints"]).reshape(-1, 6)

    def moved(self, since: float) -> float:
        """How far any joint has moved since a time of the controller [rad]."""
        joints = self.history(since)[1]
        return float(np.ptp(joints, axis=0).max()) if len(joints) else 0.0

    def to_start(self) -> None:
        self.arm.release()
        self.arm.move_to_start(self.path)

    def pouring(self) -> Call:
        """The pour, going on in a thread; at its start before."""
        self.to_start()
        self.called = Call(self.arm.execute, self.path)
        return self.called

    def await_phase(self, phase: str) -> None:
        self.await_that(lambda: self.arm.state().phase == phase, f"phase {phase}")

    def await_tilt(self, tilt: float) -> None:
        """Until the last joint has really turned so far [rad]."""
        self.await_that(lambda: self._tilted(tilt), f"a tilt of {tilt}")

    def _tilted(self, tilt: float) -> bool:
        over = self.called is not None and not self.called.is_alive()
        reached = bool(self.joints[5] - START[5] > tilt)
        assert reached or not over, "the pour was over before a starved machine saw it tilt"
        return reached

    def await_rest(self) -> None:
        self.await_that(lambda: max(map(abs, self.fault("state")["speeds"])) == 0.0, "rest")
        self.await_time(self.now + 0.5)  # joints follow their targets a few milliseconds late

    def await_time(self, clock: float) -> None:
        """Until the controller's clock shows so much [s]."""
        self.await_that(lambda: self.now >= clock, f"time {clock}")

    @staticmethod
    def await_that(condition: Callable[[], bool], what: str, patience: float = PATIENCE) -> None:
        end = time.monotonic() + patience
        while not condition():
            assert time.monotonic() < end, f"{what} did not come"
            time.sleep(0.005)


class Makers:
    """Starts rigs, and ends them."""

    def __init__(self) -> None:
        self._made: list[Rig] = []

    def __call__(self, path: PourPath | None = None, connect: bool = True, **changes: Any) -> Rig:
        """A controller at home, and an arm that is connected to it; `clock` is the file of a clock that they share."""
        scale = changes.pop("time_scale", SCALE)
        options: dict[str, Any] = {"model": changes.pop("there", "ur10e"), "time_scale": scale, "joints": HOME}
        options["frequency"] = changes.pop("frequency", 125.0)
        options["polyscope_x"] = changes.pop("polyscope_x", False)
        if clock := changes.get("clock"):
            SharedClock.create(Path(clock))
            options["clock"] = clock
        controller = VirtualController.start(address=free_address(), **options)
        arm = UrArm(settings(controller.address, time_scale=scale, **changes))
        rig = Rig(controller, arm, path or pour_path())
        self._made.append(rig)
        if connect:
            arm.connect()
        return rig

    def close(self) -> None:
        for rig in self._made:
            rig.arm.close()
            rig.controller.close()


@pytest.fixture
def make_rig() -> Iterator[Makers]:
    """Start controllers with arms that end with the test."""
    makers = Makers()
    yield makers
    makers.close()


@pytest.fixture
def rig(make_rig: Makers) -> Rig:
    return make_rig()


@pytest.fixture(scope="module")
def _resting() -> Iterator[Rig]:
    makers = Makers()
    yield makers()
    makers.close()


@pytest.fixture
def resting(_resting: Rig) -> Iterator[Rig]:
    """An arm at home that several tests share, for none of them moves it."""
    began = _resting.now
    yield _resting
    assert _resting.moved(began) == 0.0
    _resting.arm.lock()
    _resting.fault("slider", fraction=1.0)
