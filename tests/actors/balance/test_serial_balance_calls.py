"""`serial_balance`: several calls of the driver at a time: interrupts, streams, pace, and the driver behind its
device.
"""

from __future__ import annotations

import asyncio
import threading

import numpy as np
import pytest

from actors.balance.balance_device import DeviceBalance
from actors.balance.balance_interface import BalanceError, NotStableError, OutOfRangeError
from actors.balance.balance_settings import SettlingRule
from actors.balance.serial_balance import SerialBalance
from actors.runtime.remote_object import LocalDevice, RayDevice
from tests.actors.balance.conftest import spec_for
from tests.support.waiting import PATIENCE


@pytest.mark.realtime
def test_an_interrupt_ends_the_wait_for_an_answer_too(driver):
    far, balance = driver("kcp", answer_time=2 * PATIENCE)
    balance.connect()
    far.faults(silent=True)
    threading.Timer(0.2, balance.interrupt).start()
    with pytest.raises(BalanceError, match="interrupted"):
        balance.weigh()


@pytest.mark.realtime
def test_the_stream_goes_on_while_a_weight_is_waited_for_and_does_not_change_it(driver, each_dialect):
    far, balance = driver(each_dialect)
    far.put(0.35)
    balance.tare()
    far.put(0.36)
    seen, over = [], threading.Event()

    def watch() -> None:
        for weight in balance.stream(0.02):
            seen.append(weight)
            if over.is_set():
                return

    watcher = threading.Thread(target=watch)
    watcher.start()
    weights = [balance.weigh().mass for _ in range(3)]
    over.set()
    watcher.join(5.0)
    assert weights == pytest.approx([0.01] * 3, abs=1e-9)
    assert len(seen) >= 3
    assert [w.time for w in seen] == sorted(w.time for w in seen)
    assert seen[-1].status == "stable"


@pytest.mark.realtime
def test_the_last_reading_is_shown_at_once_while_another_call_has_the_line(driver, monkeypatch):
    _, balance = driver("kcp")
    shown = balance.weigh().shown
    begun, listen = threading.Event(), balance._conversation.listen
    monkeypatch.setattr(balance._conversation, "listen", lambda seconds: (begun.set(), listen(seconds)))
    listening = threading.Thread(target=balance.listen, args=(3.0,))
    listening.start()
    assert begun.wait(PATIENCE)
    assert balance.read().shown == shown
    assert listening.is_alive(), "it was read while the other call had the line"
    listening.join()


@pytest.mark.realtime
def test_questions_keep_the_pace_that_the_manual_asks_for(driver):
    far, balance = driver("kcp", time_scale=1.0, interval=0.0, settling=SettlingRule(deadline=1.0))
    balance.connect()
    far.faults(restless=True)
    before = far.state()["questions"]
    with pytest.raises(NotStableError):
        balance.weigh()
    assert far.state()["questions"] - before <= 11  # Kern: no sooner than 100 ms after the last


@pytest.mark.realtime
def test_the_display_is_read_five_to_ten_times_a_second(driver):
    _, balance = driver("kern-swt", time_scale=1.0)
    balance.connect()
    times = set()
    for weight in balance.stream(0.1):
        times.add(weight.time)
        if len(times) == 12:
            break
    steps = np.diff(sorted(times))
    assert np.median(steps) > 0.08  # a busy machine reads late, never early
    assert min(steps) < 0.3


@pytest.mark.realtime
async def test_behind_its_device_it_is_a_balance_like_any_other(driver):
    far, balance = driver("mt-sics")
    far.put(0.35)
    device = LocalDevice("balance", lambda: balance)
    behind = DeviceBalance(device, longest_call=30.0)
    assert "MT-SICS" in await behind.connect()
    await behind.tare()
    far.put(0.3512)
    weight = await behind.weigh()
    shown = [w async for w in _first(behind.stream(0.05), 3)]
    await behind.interrupt()
    with pytest.raises(BalanceError, match="interrupted"):
        await behind.weigh()
    counts = await behind.statistics()
    await behind.release()
    await device.close()
    assert weight.mass == pytest.approx(0.0012, abs=1e-9)
    assert [w.shown for w in shown] == ["1.2 g"] * 3
    assert counts["lines"] > 5


@pytest.mark.slow
@pytest.mark.realtime
@pytest.mark.ray
def test_in_a_process_of_its_own_it_weighs_and_its_errors_keep_their_kind(ray_running, virtual):
    far = virtual("mt-sics")

    async def play():
        device = RayDevice("balance", SerialBalance, spec_for(far, "mt-sics"), "kern-1")
        behind = DeviceBalance(device, longest_call=30.0)
        far.put(0.35)
        await behind.tare()
        far.put(0.3512)
        weight = await behind.weigh()
        far.put(8.0)
        with pytest.raises(OutOfRangeError, match=r"balance kern-1 .* over range"):
            await behind.weigh()
        await device.close()
        return weight

    assert asyncio.run(play()).mass == pytest.approx(0.0012, abs=1e-9)


async def _first(stream, count):
    async for item in stream:
        yield item
        count -= 1
        if count == 0:
            return
