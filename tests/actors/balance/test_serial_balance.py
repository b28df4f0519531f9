"""The driver through the real pyserial, against virtual balances of every dialect."""

from __future__ import annotations

import asyncio
import math
import threading
import time

import pytest

from actors.balance.actor import DeviceBalance
from actors.balance.errors import (
    BalanceError,
    BalanceFaultError,
    CommandError,
    NoConnectionError,
    NotStableError,
    OutOfRangeError,
    UnitError,
)
from actors.balance.serial_balance import SerialBalance
from actors.balance.settling import SettlingRule
from actors.balance.virtual_balance import Load
from actors.balance.virtual_serial.voice import VOICES
from actors.device import LocalDevice, RayDevice

from .conftest import spec_for

SOON = {"settling": SettlingRule(deadline=4.0)}
"""Gives up early, where giving up is what is tested."""


@pytest.mark.parametrize("voice", VOICES)
def test_a_tared_balance_weighs_what_is_added(driver, voice):
    far, balance = driver(voice)
    far.put(0.35)
    balance.tare()
    far.put(0.35 + 0.0123)
    weight = balance.weigh()
    assert weight.mass == pytest.approx(0.0123, abs=1e-9)
    assert (weight.stable, weight.shown) == (True, "12.3 g")
    assert weight.step == pytest.approx(1e-4)
    assert weight.time == pytest.approx(time.monotonic(), abs=0.5)


def test_a_step_that_is_not_one_of_the_last_digit_is_taken_from_the_settings(driver):
    far, balance = driver("sbi", step=5e-4)
    far.put(0.1)
    assert balance.weigh().step == 5e-4


def test_less_than_nothing_is_weighed_too(driver, each_dialect):
    far, balance = driver(each_dialect)
    far.put(0.2)
    balance.tare()
    far.put(0.0)
    assert balance.weigh().mass == pytest.approx(-0.2, abs=1e-9)


def test_zero_takes_drift_away_where_there_is_a_command_for_it(driver, each_dialect):
    far, balance = driver(each_dialect)
    far.put(0.05)
    if each_dialect == "kern-swt":
        with pytest.raises(CommandError, match="no command for zero; use its key, or tare"):
            balance.zero()
        return
    balance.zero()
    assert balance.weigh().mass == 0.0


@pytest.mark.parametrize("dialect", ["kcp", "mt-sics"])
def test_zero_with_a_load_is_refused_with_what_to_do(driver, dialect):
    far, balance = driver(dialect)
    far.put(1.0)
    with pytest.raises(OutOfRangeError, match="zero refused, over range: take everything off"):
        balance.zero()


def test_a_moving_weight_is_shown_but_does_not_count(driver, each_dialect):
    far, balance = driver(each_dialect, **SOON)
    balance.tare()
    far.put(Load((0.0, 1000.0), (0.0, 3.0)))
    shown = []
    for weight in balance.stream(0.01):
        shown.append(weight)
        if len(shown) == 8:
            break
    assert [w.status for w in shown[2:]] == ["unstable"] * 6
    assert shown[-1].mass > shown[2].mass > 0.0
    with pytest.raises(NotStableError, match=r"no stable weight within 4 s \(last .* g, unstable\).*still dripping"):
        balance.weigh()


def test_a_restless_balance_is_given_up_with_advice_in_the_time_allowed(driver, each_dialect):
    far, balance = driver(each_dialect, **SOON)
    balance.connect()
    far.faults(restless=True)
    started = time.monotonic()
    with pytest.raises(NotStableError, match=r"touching the tray.*slower filter"):
        balance.weigh()
    assert time.monotonic() - started < 4.0 / 20.0 + 0.5


def test_an_overload_is_named_and_not_waited_out(driver, each_dialect):
    far, balance = driver(each_dialect, settling=SettlingRule(deadline=200.0))
    far.put(8.0)
    started = time.monotonic()
    with pytest.raises(OutOfRangeError, match=r"over range.*Take something off"):
        balance.weigh()
    assert time.monotonic() - started < 5.0
    weight = balance.read()
    assert weight.status == "over range"
    assert math.isnan(weight.mass)
    assert not weight.stable


@pytest.mark.parametrize("dialect", ["kcp", "mt-sics", "sbi"])
def test_a_missing_pan_is_named(driver, dialect):
    far, balance = driver(dialect)
    far.put(-2.0)
    with pytest.raises(OutOfRangeError, match=r"under range.*its pan"):
        balance.weigh()


def test_a_fault_of_the_balance_is_passed_on(driver, each_dialect):
    far, balance = driver(each_dialect)
    far.faults(fault="9")
    with pytest.raises(BalanceFaultError, match="reports a fault"):
        balance.weigh()


def test_pieces_are_no_weight(driver, each_dialect):
    far, balance = driver(each_dialect)
    far.put(0.2)
    balance.weigh()
    far.faults(unit="pcs")
    with pytest.raises(UnitError, match=r"it shows 200\.0 pcs.*switch it to g"):
        balance.weigh()


def test_a_moving_load_is_not_tared(driver, each_dialect):
    far, balance = driver(each_dialect, **SOON)
    far.put(0.2)
    far.advance(5.0)
    far.faults(restless=True)
    with pytest.raises(NotStableError, match="no stable weight"):
        balance.tare()
    assert far.state()["shown"] == "200.0 g, unstable"


def test_a_tare_without_effect_is_noticed(driver, each_dialect):
    far, balance = driver(each_dialect)
    far.put(0.35)
    far.faults(powerless=True)
    with pytest.raises(CommandError, match=r"tare was sent 3 times without effect: it still shows 350\.0 g, stable"):
        balance.tare()


def test_a_frozen_display_is_noticed_when_taring(driver, each_dialect):
    far, balance = driver(each_dialect)
    far.put(0.35)
    far.advance(10.0)
    far.faults(frozen=True)
    with pytest.raises(CommandError, match=r"display\s+frozen"):
        balance.tare()


def test_silence_is_not_taken_for_rest(driver, each_dialect):
    far, balance = driver(each_dialect, **SOON)
    balance.connect()
    far.faults(silent=True)
    with pytest.raises(NoConnectionError, match=r"no answer within 4 s. Is it switched on"):
        balance.weigh()
    assert balance.read().status == "silent"
    assert balance.statistics()["unanswered"] >= 1


def test_a_bad_cable_costs_time_but_never_gives_another_weight(driver, each_dialect):
    far, balance = driver(each_dialect, settling=SettlingRule(deadline=400.0), answer_time=0.05)
    far.put(0.35)
    balance.tare()
    far.faults(garbage=0.25, halved=0.15)
    for grams in (12.3, 112.3, 2.3, 99.9, 10.0):
        far.put(0.35 + grams / 1e3)
        far.advance(5.0)
        assert balance.weigh().mass == pytest.approx(grams / 1e3, abs=1e-9)
    assert balance.statistics()["damaged"] > 0


def test_lines_that_come_unasked_and_cut_answers_in_two_do_no_harm(driver, each_dialect):
    far, balance = driver(each_dialect, settling=SettlingRule(deadline=400.0), answer_time=0.05)
    far.put(0.35)
    far.faults(unasked=0.02, interleaved=True)
    balance.tare()
    far.put(0.4)
    far.advance(5.0)
    assert balance.weigh().mass == pytest.approx(0.05, abs=1e-9)


def test_a_late_answer_is_not_taken_for_the_answer_to_the_next_question(driver, each_dialect):
    far, balance = driver(each_dialect, answer_time=0.1)
    far.put(0.1)
    far.advance(5.0)
    balance.connect()
    far.faults(delay=0.15)
    assert balance.read().status == "silent"
    far.put(0.2)
    far.advance(5.0)
    time.sleep(0.4)  # the answer of before has come by now: 100 g
    far.faults(delay=0.0)
    assert balance.read().shown == "200.0 g"
    assert balance.statistics()["stale"] == 1


def test_pulling_the_plug_while_weighing_is_mended_by_putting_it_in_again(driver, each_dialect):
    far, balance = driver(each_dialect)
    balance.connect()
    far.unplug()
    threading.Timer(0.4, far.plug).start()
    assert balance.weigh().mass == 0.0
    assert balance.statistics()["lost"] == 1


def test_a_port_that_stays_away_is_reported_in_the_time_allowed(driver, each_dialect):
    far, balance = driver(each_dialect, reconnect_time=0.5)
    balance.connect()
    far.unplug()
    started = time.monotonic()
    with pytest.raises(NoConnectionError, match=r"there is no such port.*Is the cable plugged in"):
        balance.weigh()
    assert time.monotonic() - started < 2.0
    assert balance.read().status == "lost"


def test_a_connection_that_comes_and_goes_is_reported(driver):
    far, balance = driver("kcp", settling=SettlingRule(readings=100, span=100.0, deadline=400.0), reconnect_time=5.0)
    balance.connect()
    over = threading.Event()

    def shake() -> None:
        while not over.wait(0.1):
            far.unplug()
            far.plug()

    shaking = threading.Thread(target=shake)
    shaking.start()
    try:
        with pytest.raises(NoConnectionError, match=r"its connection comes and goes.*look at cable and plug"):
            balance.weigh()
    finally:
        over.set()
        shaking.join()


def test_after_a_lost_connection_the_old_tare_counts_only_once_confirmed(driver, each_dialect):
    far, balance = driver(each_dialect)
    far.put(0.35)
    balance.tare()
    far.put(0.36)
    far.advance(5.0)
    balance.weigh()
    far.unplug()
    far.plug()
    with pytest.raises(BalanceError, match=r"since the last tare.*last seen: 10\.0 g.*confirm"):
        balance.weigh()
    with pytest.raises(BalanceError, match="since the last tare"):
        balance.weigh()
    balance.keep_reference()
    assert balance.weigh().mass == pytest.approx(0.01, abs=1e-9)


def test_a_balance_that_was_switched_off_does_not_hide_the_spill(driver):
    far, balance = driver("kcp")
    far.put(0.35)
    balance.tare()
    far.put(0.36)
    far.unplug()
    far.power_cycle()
    far.plug()
    with pytest.raises(BalanceError, match="If it was off"):
        balance.weigh()
    balance.tare()
    far.put(0.37)
    assert balance.weigh().mass == pytest.approx(0.01, abs=1e-9)


def test_a_port_that_another_program_has_open_is_named(driver):
    _, balance = driver("kcp")
    balance.connect()
    _, second = driver("kcp")
    with pytest.raises(NoConnectionError, match="another program has it open"):
        second.weigh()


def test_a_port_that_does_not_exist_is_named_at_once(driver):
    _, balance = driver("kcp", port="/dev/serial/by-id/usb-KERN")
    started = time.monotonic()
    with pytest.raises(
        NoConnectionError, match=r"balance kern-1 \(/dev/serial/by-id/usb-KERN\): there is no such port"
    ):
        balance.tare()
    assert time.monotonic() - started < 0.5


def test_a_flood_of_damaged_lines_does_not_hold_a_call_beyond_its_deadline(driver, each_dialect):
    far, balance = driver(each_dialect, **SOON)
    balance.connect()
    far.faults(unasked=0.0005, halved=0.0, garbage=0.0, interleaved=True, unit="pcs?!")
    started = time.monotonic()
    with pytest.raises(BalanceError):
        balance.weigh()
    balance.read()
    assert time.monotonic() - started < 2.0


@pytest.mark.parametrize("dialect", ["kcp", "mt-sics"])
def test_a_balance_that_knows_another_command_set_says_so(driver, dialect):
    far, balance = driver(dialect, **SOON)
    far.faults(stranger=True)
    with pytest.raises(CommandError, match=r"refuses the question: syntax error.*dialect: auto"):
        balance.weigh()


def test_an_interrupt_ends_a_wait_and_resume_lets_it_last_again(driver, each_dialect):
    far, balance = driver(each_dialect, settling=SettlingRule(deadline=200.0))
    balance.connect()
    far.faults(restless=True)
    threading.Timer(0.2, balance.interrupt).start()
    started = time.monotonic()
    with pytest.raises(BalanceError, match="interrupted"):
        balance.weigh()
    assert time.monotonic() - started < 1.0
    balance.resume()
    far.faults(restless=False)
    assert balance.weigh().mass == 0.0


def test_an_interrupt_ends_the_wait_for_an_answer_too(driver):
    far, balance = driver("kcp", answer_time=10.0)
    balance.connect()
    far.faults(silent=True)
    threading.Timer(0.2, balance.interrupt).start()
    started = time.monotonic()
    with pytest.raises(BalanceError, match="interrupted"):
        balance.weigh()
    assert time.monotonic() - started < 3.0


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


def test_the_last_reading_is_shown_at_once_while_another_call_has_the_line(driver):
    _, balance = driver("kcp")
    shown = balance.weigh().shown
    listening = threading.Thread(target=balance.listen, args=(1.5,))
    listening.start()
    time.sleep(0.2)
    started = time.monotonic()
    assert balance.read().shown == shown
    assert time.monotonic() - started < 0.8
    listening.join()


def test_questions_keep_the_pace_that_the_manual_asks_for(driver):
    far, balance = driver("kcp", time_scale=1.0, interval=0.0, settling=SettlingRule(deadline=1.0))
    balance.connect()
    far.faults(restless=True)
    before = far.state()["questions"]
    with pytest.raises(NotStableError):
        balance.weigh()
    assert far.state()["questions"] - before <= 11  # Kern: no sooner than 100 ms after the last


def test_the_display_is_read_five_to_ten_times_a_second(driver):
    _, balance = driver("kern-swt", time_scale=1.0)
    balance.connect()
    times = set()
    started = time.monotonic()
    for weight in balance.stream(0.1):
        times.add(weight.time)
        if time.monotonic() - started > 2.0:
            break
    assert 10 <= len(times) <= 21


def test_behind_its_device_it_is_a_balance_like_any_other(driver):
    far, balance = driver("mt-sics")
    far.put(0.35)

    async def play():
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
        return weight, shown, counts

    weight, shown, counts = asyncio.run(play())
    assert weight.mass == pytest.approx(0.0012, abs=1e-9)
    assert [w.shown for w in shown] == ["1.2 g"] * 3
    assert counts["lines"] > 5


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
