"""The clock that the devices of a virtual bench share."""

from __future__ import annotations

import itertools
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from actors.balance.balance_settings import SerialBalanceSettings
from actors.balance.serial_balance import SerialBalance
from actors.balance.serial_port import Wire
from actors.bench.virtual_bench import CREEP, standing
from actors.emulators.serial_balance.balance_process import VirtualSerialBalance
from actors.runtime import bench_clock
from actors.runtime.bench_clock import DeviceClock, SharedClock, device_clock
from actors.runtime.child_process import child_environment
from tests.support.waiting import wait_for


@pytest.fixture
def file(tmp_path: Path) -> Path:
    SharedClock.create(tmp_path / "clock")
    return tmp_path / "clock"


def test_all_that_share_it_read_the_time_that_its_controller_has_written(file: Path) -> None:
    controller, balance = SharedClock(file), device_clock(str(file))
    before = balance.now
    assert balance.now == before, "it stands"
    controller.advance(0.25)
    assert balance.now == pytest.approx(before + 0.25)


def test_it_does_not_pass_what_a_program_has_promised_until_the_program_acts_again(file: Path) -> None:
    controller, worker = SharedClock(file), SharedClock(file)
    worker.promise("arm", 0.1)
    assert controller.may_pass(0.09)
    controller.advance(0.09)
    assert not controller.may_pass(0.02)
    worker.promise("arm", 0.1)
    assert controller.may_pass(0.09)
    assert not controller.may_pass(0.2)
    worker.withdraw("arm")
    assert controller.may_pass(1e9)


def test_it_goes_on_without_a_program_that_hangs_and_waits_for_one_that_catches_up(
    file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    wall = itertools.count(1000.0, 1.0)
    monkeypatch.setattr(bench_clock, "LONGEST_STAND", 5.0)
    controller, slow = SharedClock(file), SharedClock(file)
    monkeypatch.setattr(bench_clock.time, "monotonic", lambda: next(wall))
    for behind in range(50, 0, -1):
        slow.promise("liquid", -0.1 * behind)
        assert [controller.may_pass(0.002) for _ in range(3)] == [False] * 3
    slow.promise("liquid", 0.1)
    assert controller.may_pass(0.002)
    slow.promise("liquid", 0.0)
    passes = [controller.may_pass(0.002) for _ in range(12)]
    assert passes == sorted(passes), "it stands, and then goes on"
    assert 5 <= passes.count(False) <= 8


def test_it_waits_for_no_program_that_has_ended(file: Path) -> None:
    text = "import sys; from pathlib import Path; from actors.runtime.bench_clock import SharedClock; "
    text += "SharedClock(Path(sys.argv[1])).promise('dose', 0.004)"
    subprocess.run([sys.executable, "-c", text, str(file)], check=True, env=child_environment())
    controller = SharedClock(file)
    assert not controller.may_pass(0.008)
    assert controller.may_pass(0.008)


def test_it_waits_for_an_emulated_balance_that_the_host_delays(file: Path) -> None:
    """On a busy machine its readings came too late for the driver's limits, which this clock measures."""
    controller = SharedClock(file)
    balance = VirtualSerialBalance.start(clock=str(file))
    try:
        wait_for(lambda: not controller.may_pass(1e6), "the balance acts")
        os.kill(balance.pid, signal.SIGSTOP)
        begin = controller.now
        while controller.may_pass(0.002):
            controller.advance(0.002)
        assert not controller.may_pass(0.002)
        assert controller.now - begin < 0.075, "a dose would see its last grams late"
        os.kill(balance.pid, signal.SIGCONT)
        wait_for(lambda: controller.may_pass(0.002), "the balance acts again")
    finally:
        balance.close()
    assert controller.may_pass(1e6)


@pytest.mark.parametrize("time_scale", [30.0, 1.0])
def test_a_weight_settles_however_late_the_driver_of_the_balance_is(
    file: Path, monkeypatch: pytest.MonkeyPatch, time_scale: float
) -> None:
    """At thirty times its pace a weight must settle in 0.67 s of the clock; a busy host woke the driver three times.

    At its usual pace the driver looks as often as on an idle host: a dose of 50 g became one of 52 g.
    """
    clock, ended, looks = SharedClock(file), threading.Event(), list[float]()

    def turn() -> None:
        """The clock passes as fast as it may: a host on which all programs but the controller are late."""
        while not ended.is_set():
            if clock.may_pass(0.001):
                clock.advance(0.001)
            else:
                time.sleep(1e-3)

    def late(wire: Wire, end: float) -> bytes | None:
        looks.append(clock.now)
        line = line_until(wire, end)
        time.sleep(0.1)  # the host is busy
        return line

    line_until = Wire.line_until
    monkeypatch.setattr(Wire, "line_until", late)
    balance = VirtualSerialBalance.start(baud=0, time_scale=time_scale, latency=0.002, clock=str(file))
    spec = SerialBalanceSettings(port=balance.port, dialect="kcp", time_scale=time_scale, clock=str(file))
    driver, controller = SerialBalance(spec), threading.Thread(target=turn, daemon=True)
    try:
        balance.put(0.1234)
        controller.start()
        assert driver.weigh().mass == pytest.approx(0.1234, abs=1e-3)
    finally:
        ended.set()
        controller.join()
        driver.close()
        balance.close()
    assert clock.may_pass(1e6), "it does not wait for a driver that weighs nothing"
    apart = sorted(later - earlier for earlier, later in itertools.pairwise(looks))
    assert apart[len(apart) // 2] < 0.16, "it asks each 0.1 s"


def test_it_goes_on_without_its_controller_and_without_a_program_that_hangs(
    file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What hangs is not late: then devices have to fail as real ones do."""
    controller, driver = SharedClock(file), SharedClock(file)
    driver.promise("arm", 0.004)
    begin, real = driver.now, time.monotonic()
    assert not controller.may_pass(0.008)
    monkeypatch.setattr(bench_clock.time, "monotonic", lambda: real + bench_clock.LONGEST_STAND + 3.0)
    assert driver.now > begin + 2.0
    assert not controller.may_pass(0.008)
    assert controller.may_pass(0.008)


def test_hardware_and_other_machines_have_the_wall_clock(tmp_path: Path) -> None:
    for path in ("", str(tmp_path / "not here")):
        clock = device_clock(path)
        assert type(clock) is DeviceClock
        assert clock.patience == 1.0
        assert abs(clock.now - time.monotonic()) < 60.0


async def test_devices_do_not_age_while_the_liquid_of_the_bench_is_simulated(file: Path) -> None:
    """On a slow machine the balance drifted by grams meanwhile."""
    controller, bench = SharedClock(file), SharedClock(file)
    async with standing(bench):
        assert not controller.may_pass(2.0 * CREEP)
    assert controller.may_pass(1e9)
