"""`rig_worker`: the standing status of a rig's arm: whether it can move, why not, and what to do, without a run."""

from __future__ import annotations

import asyncio
import threading
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest

from actors.emulators.ur_controller.controller_process import VirtualController
from actors.interfaces import DeviceCheck
from orchestrator.campaigns.file_loading import load_laboratory
from orchestrator.daemon.rigs import rig_worker
from orchestrator.daemon.state.daemon_settings import Rig
from tests.support.hardware_laboratory import hardware_rig
from tests.support.toy_daemon import Served, held, run, serving
from tests.support.waiting import PATIENCE


async def arm_of(served: Served, rig: str, state: str) -> dict[str, Any]:
    """The status of a rig's arm, once it is in a state."""
    async with asyncio.timeout(PATIENCE):
        async for _ in served.daemon.feed.read(0, beat=0.05):
            rigs = {one["name"]: one for one in await served.get("/rigs")}
            arm: dict[str, Any] | None = rigs[rig]["arm"]
            if arm is not None and arm["state"] == state:
                return arm
    raise AssertionError("unreachable")


@pytest.mark.realtime
@pytest.mark.parametrize(
    ("fault", "arguments", "text", "advice"),
    [
        ("protective_stop", {}, "protective stop is in force", "find the cause, then unlock it"),
        ("reduced", {}, "reduced mode is in force", "pours need the normal limits"),
        ("slider", {"fraction": 0.5}, "the speed slider is at 50 %", "set the slider"),
        (
            "remote",
            {"active": False},
            "remote control is off: the controller refuses programs",
            "switch from Local to Remote",
        ),
        ("power", {"mode": "idle"}, "the robot is idle, brakes closed, not running", "press START"),
    ],
)
def test_an_idle_arm_that_cannot_move_says_why_and_what_to_do(
    tmp_path: Path, fault: str, arguments: dict[str, Any], text: str, advice: str
) -> None:
    with VirtualController.start("127.81.4.1", "ur10e") as controller:
        rig = hardware_rig(tmp_path, controller.address, "ur10e")

        async def work() -> None:
            async with serving(tmp_path, rigs=(rig,), arm_interval=0.05) as served:
                assert (await arm_of(served, "rig", "ok"))["text"] == "the arm is ready to move"
                before = controller.fault("state")
                controller.fault(fault, **arguments)
                arm = await arm_of(served, "rig", "fail")
                assert text in arm["text"]
                assert advice in arm["advice"]
                assert controller.fault("state")["joints"] == before["joints"]

        run(work())


@pytest.mark.realtime
async def test_a_controller_that_refuses_connections_is_a_status_too(tmp_path: Path) -> None:
    rig = hardware_rig(tmp_path, "127.81.4.2")  # loopback: every port refuses
    async with serving(tmp_path, rigs=(rig,), arm_interval=0.05) as served:
        arm = await arm_of(served, "rig", "fail")
        assert "all ports that Decant uses are closed" in arm["text"]
        assert "while booting, wait" in arm["advice"]


SHORT = 20.0
"""End of a reading that a failed test has left waiting [s]."""


@dataclass(frozen=True)
class ArmThatIsRead:
    """An arm whose readings are counted, and wait until the test lets them end."""

    go: threading.Event = field(default_factory=threading.Event)
    readings: list[int] = field(default_factory=list)

    def readiness(self) -> DeviceCheck:
        self.readings.append(1)
        self.go.wait(SHORT)
        return DeviceCheck("motion", "ok", "the arm is ready to move")


async def test_an_arm_is_not_read_during_a_run_and_no_run_begins_during_a_reading(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    laboratory = tmp_path / "numbers.yaml"
    laboratory.write_text("{name: numbers, bench: {liquid: {particles: 400}, time_scale: 0}}\n")
    arm = ArmThatIsRead()
    monkeypatch.setattr(rig_worker, "arm_kind", lambda spec: spec)
    spec = load_laboratory(laboratory).model_copy(update={"mode": "hardware", "arm": arm})
    async with serving(tmp_path, held, rigs=(Rig("north", laboratory, spec),), arm_interval=0.0) as served:
        async with asyncio.timeout(PATIENCE):
            while not arm.readings:
                await asyncio.sleep(0.01)
        key = await served.submit(rig="north")
        assert (await served.get(f"/campaigns/{key}"))["state"] == "queued"
        arm.go.set()
        bench = (await served.pouring()).bench
        counted = len(arm.readings)
        for _ in range(100):
            await asyncio.sleep(0)
        rigs = await served.get("/rigs")
        assert [one["arm"] for one in rigs if one["name"] == "north"] == [None]
        assert len(arm.readings) == counted
        bench.go.set()
        await served.until(key, "finished")
        assert await arm_of(served, "north", "ok")
        assert len(arm.readings) > counted


async def test_a_rig_without_hardware_has_no_arm_status(tmp_path: Path) -> None:
    path = Path("configs/laboratories/virtual.yaml").resolve()
    async with serving(tmp_path, rigs=(Rig("rig", path, load_laboratory(path)),), arm_interval=0.0) as served:
        for _ in range(20):
            await asyncio.sleep(0)
        assert {one["name"]: one["arm"] for one in await served.get("/rigs")} == {"rig": None, "none": None}
