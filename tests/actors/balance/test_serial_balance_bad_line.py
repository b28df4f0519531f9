"""`serial_balance`: the driver at a bad line: silence, damage, late answers, lost and taken ports."""

from __future__ import annotations

import threading
import time

import pytest

from actors.balance.balance_interface import BalanceError, NoConnectionError
from actors.balance.balance_settings import SettlingRule
from actors.balance.dialect_registry import dialects
from actors.balance.serial_balance import OFF_TIME
from tests.actors.balance.conftest import SOON
from tests.support.waiting import PATIENCE


@pytest.mark.realtime
def test_silence_is_not_taken_for_rest(driver, each_dialect):
    far, balance = driver(each_dialect, **SOON)
    balance.connect()
    far.faults(silent=True)
    with pytest.raises(NoConnectionError, match=r"no answer within 4 s. Is it switched on"):
        balance.weigh()
    assert balance.read().status == "silent"
    assert balance.statistics()["unanswered"] >= 1


@pytest.mark.slow
@pytest.mark.parametrize("dialect", dialects())
def test_a_bad_cable_costs_time_but_never_gives_another_weight(driver, dialect):
    far, balance = driver(dialect, settling=SettlingRule(deadline=400.0), answer_time=0.05)
    far.put(0.35)
    balance.tare()
    far.faults(garbage=0.1, halved=0.1)
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
    with pytest.raises(NoConnectionError, match=r"there is no such port.*Is the cable plugged in"):
        balance.weigh()
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


def test_a_balance_switched_off_behind_a_port_that_stays_open_does_not_hide_the_spill(driver):
    far, balance = driver("kcp", answer_time=0.2)
    far.put(0.35)
    balance.tare()
    far.put(0.36)
    far.faults(silent=True)
    end = time.monotonic() + OFF_TIME + 1.0
    while time.monotonic() < end:
        assert balance.read().status in ("silent", "stable", "unstable")
    far.power_cycle()
    far.faults(silent=False)
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
    _, balance = driver("kcp", port="/dev/serial/by-id/usb-KERN", reconnect_time=2 * PATIENCE)
    with pytest.raises(
        NoConnectionError, match=r"balance kern-1 \(/dev/serial/by-id/usb-KERN\): there is no such port"
    ):
        balance.tare()


@pytest.mark.slow
def test_a_flood_of_damaged_lines_does_not_hold_a_call_beyond_its_deadline(driver, each_dialect):
    far, balance = driver(each_dialect, **SOON)
    balance.connect()
    far.faults(unasked=0.0005, halved=0.0, garbage=0.0, interleaved=True, unit="pcs?!")
    with pytest.raises(BalanceError):
        balance.weigh()
    balance.read()
