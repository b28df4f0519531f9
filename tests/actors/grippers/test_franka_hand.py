"""`franka_hand`: the Hand of a Franka by the client library of others, against franky-sim's server of the protocol."""

from __future__ import annotations

import re
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from actors.runtime.bench_clock import SharedClock
from decant.plugins.testing import GripperContract, GripperRig
from orchestrator.campaigns.file_loading import load_laboratory
from sim_engine.errors import DecantError

pytest.importorskip("franky")
pytest.importorskip("franky_sim")

from actors.emulators.franka.hand_emulator import HandEmulator
from actors.grippers.franka_hand import FrankaHand, HandSettings
from actors.grippers.gripper_interface import GripperError
from tests.support.waiting import PATIENCE, wait_for

pytestmark = pytest.mark.realtime

WIDTH = 0.06


@pytest.fixture
def emulator() -> Iterator[HandEmulator]:
    emulator = HandEmulator(HandSettings(time_scale=20.0))
    yield emulator
    emulator.close()


@pytest.fixture
def bench(emulator: HandEmulator) -> Iterator[GripperRig]:
    driver = FrankaHand(emulator.gripper)
    yield GripperRig(
        driver, emulator.gripper, emulator.put, WIDTH, emulator.close, lambda: emulator.fault("power", 0.0)
    )
    driver.close()


class TestHand(GripperContract):
    @pytest.fixture
    def bench(self, bench: GripperRig) -> GripperRig:
        return bench


class _Spy:
    """The client, with the names of its commands."""

    def __init__(self, hand: Any) -> None:
        self._hand, self.commands = hand, list[str]()

    def __getattr__(self, name: str) -> Any:
        if name in ("stop", "move_async", "grasp_async", "homing_async"):
            self.commands.append(name)
        return getattr(self._hand, name)


def test_a_command_to_fingers_that_hold_comes_after_a_stop_and_a_stop_lets_nothing_go(bench: GripperRig) -> None:
    """libfranka, issues 93 and 108: another command to a Hand that holds something waits, or fails."""
    bench.gripped()
    driver: Any = bench.driver
    driver._hand = spy = _Spy(driver._hand)
    bench.driver.stop()
    bench.driver.grip(0.8 * WIDTH, 40.0)
    assert spy.commands == []
    bench.driver.open(0.07)
    bench.driver.open(0.075)
    assert spy.commands == ["stop", "move_async", "move_async"]


def test_a_motion_is_stopped_from_another_thread(bench: GripperRig, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("actors.grippers.franka_hand.SPEED", 1e-4)
    bench.driver.connect()
    errors = list[Exception]()

    def move() -> None:
        try:
            bench.driver.open(0.02)
        except GripperError as error:
            errors.append(error)

    moving = threading.Thread(target=move)
    moving.start()
    wait_for(lambda: bench.driver.state().moving, "the fingers do not move")
    bench.driver.stop()
    moving.join(PATIENCE)
    assert "Command aborted" in str(errors[0])
    assert not bench.driver.state().moving


def test_fingers_that_were_not_homed_are_made_ready_first(bench: GripperRig, emulator: HandEmulator) -> None:
    emulator._server._max_width = 0.0
    bench.driver.connect()
    assert "not homed" in bench.driver.state().problem
    bench.driver.prepare()
    assert bench.driver.state().problem == ""


def test_a_hand_of_a_busy_virtual_bench_is_read_again(emulator: HandEmulator, tmp_path: Path) -> None:
    """One late state let a pour end as if its cup were lost."""
    SharedClock.create(tmp_path / "clock")
    driver: Any = FrankaHand(emulator.gripper.with_values(clock=str(tmp_path / "clock")))
    driver.connect()
    threading.Timer(1.5, emulator.fault, ("power", 1.0)).start()  # libfranka waits for a state for a second
    emulator.fault("power", 0.0)
    assert driver.state().problem == ""
    driver.close()


def test_nobody_at_the_address_is_one_error() -> None:
    driver = FrankaHand(HandSettings(address="127.255.255.1"))
    with pytest.raises(GripperError, match=r"Hand at 127\.255\.255\.1: .*is the Hand mounted and chosen in Desk"):
        driver.connect()
    with pytest.raises(GripperError, match="connect first"):
        driver.state()


@pytest.mark.parametrize(
    ("section", "text"),
    [
        ("{kind: franka, force: 20 N}", r"gripper\.force: this gripper grips with 30 … 70 N"),
        ("{kind: franka, address: 172.16.0.2}", r"gripper\.address: a virtual gripper has no address"),
        ("{kind: franka}", ""),
    ],
)
def test_the_shipped_laboratory_with_its_hand(section: str, text: str, tmp_path: Path) -> None:
    laboratory = Path("configs/laboratories/franka.yaml").read_text(encoding="utf-8")
    path = tmp_path / "laboratory.yaml"
    path.write_text(laboratory.replace("balance:", f"gripper: {section}\nbalance:"), encoding="utf-8")
    if not text:
        assert load_laboratory(path).gripper is not None
        return
    with pytest.raises(DecantError, match=text) as error:
        load_laboratory(path)
    assert str(error.value).count("laboratory.yaml:") == 1


def test_another_arm_has_no_hand(tmp_path: Path) -> None:
    laboratory = Path("configs/laboratories/night.yaml").read_text(encoding="utf-8")
    path = tmp_path / "laboratory.yaml"
    path.write_text(re.sub("gripper: .*", "gripper: {kind: franka}", laboratory), encoding="utf-8")
    with pytest.raises(DecantError, match="this arm is another one") as error:
        load_laboratory(path)
    assert str(error.value).count("laboratory.yaml:") == 1
