"""`serial_balance`: the driver through the real pyserial, against virtual balances of every dialect: weights, tare,
refusals.
"""

from __future__ import annotations

import math
import time
from dataclasses import replace

import pytest

from actors.balance.balance_interface import (
    BalanceError,
    CommandError,
    NoConnectionError,
    NotStableError,
    OutOfRangeError,
    UnitError,
)
from actors.balance.balance_settings import SettlingRule
from actors.balance.dialect_registry import dialects, encoders
from actors.balance.scale_model import Load
from tests.actors.balance.conftest import SOON


@pytest.mark.slow
@pytest.mark.realtime
@pytest.mark.parametrize("voice", encoders())
def test_a_tared_balance_weighs_what_is_added(driver, voice):
    far, balance = driver(voice)
    far.put(0.35)
    balance.tare()
    far.put(0.35 + 0.0123)
    before = time.monotonic()
    weight = balance.weigh()
    after = time.monotonic()
    assert weight.mass == pytest.approx(0.0123, abs=1e-9)
    assert (weight.stable, weight.shown) == (True, "12.3 g")
    assert weight.step == pytest.approx(1e-4)
    assert before <= weight.time <= after


def test_a_step_that_is_not_one_of_the_last_digit_is_taken_from_the_settings(driver):
    far, balance = driver("sbi", step=5e-4)
    far.put(0.1)
    assert balance.weigh().step == 5e-4


def test_zero_takes_drift_away_where_there_is_a_command_for_it(driver, each_dialect):
    far, balance = driver(each_dialect)
    far.put(0.05)
    if dialects()[each_dialect].zero is None:
        with pytest.raises(CommandError, match="no command for zero; use its key, or tare"):
            balance.zero()
        return
    balance.zero()
    assert balance.weigh().mass == 0.0


@pytest.mark.parametrize("dialect", ["kcp", "mt-sics", "radwag"])
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
    with pytest.raises(NotStableError, match=r"within 4 s .*touching the tray.*slower filter"):
        balance.weigh()


def test_an_overload_is_named_and_not_waited_out(driver, each_dialect):
    far, balance = driver(each_dialect, settling=SettlingRule(deadline=600.0))
    far.put(8.0)
    with pytest.raises(OutOfRangeError, match=r"over range.*Take something off"):
        balance.weigh()
    weight = balance.read()
    assert weight.status == "over range"
    assert math.isnan(weight.mass)
    assert not weight.stable


@pytest.mark.parametrize("dialect", ["a-and-d", "kcp", "kern-continuous", "mt-sics", "ohaus", "radwag", "sbi"])
def test_a_missing_pan_is_named(driver, dialect):
    far, balance = driver(dialect)
    far.put(-2.0)
    with pytest.raises(OutOfRangeError, match=r"under range.*its pan"):
        balance.weigh()


def test_a_fault_of_the_balance_is_passed_on(driver, each_dialect):
    far, balance = driver(each_dialect, **SOON)
    far.faults(fault="9")
    if each_dialect in ("a-and-d", "kern-continuous", "radwag"):  # they have no line for it
        with pytest.raises(NoConnectionError, match="no answer within"):
            balance.weigh()
        return
    with pytest.raises(BalanceError, match="reports a fault"):
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


@pytest.mark.parametrize("voice", ["a-and-d-error-code", "kcp", "mt-sics", "ohaus", "radwag"])
def test_a_balance_that_knows_another_command_set_says_so(driver, voice):
    far, balance = driver(voice, **SOON)
    far.faults(stranger=True)
    with pytest.raises(CommandError, match=r"refuses the question: .*does not know the command.*dialect: auto"):
        balance.weigh()


def test_numbers_without_a_unit_are_no_weight(driver):
    far, balance = driver("kern-continuous", **SOON)
    far.put(0.2)
    far.faults(unit=" ")
    with pytest.raises(UnitError, match=r"it sends 200\.0 without a unit; switch on the unit"):
        balance.weigh()


def test_a_tare_that_the_balance_does_not_list_is_refused(driver):
    """Its I1 claims level 1, to which tare belongs, but its I0 leaves it out."""
    _, balance = driver("mt-sics")
    balance.connect()
    found = balance._conversation.found
    assert found is not None
    balance._conversation.found = replace(found, commands=frozenset(("@", "I0", "S", "SI", "Z")))
    with pytest.raises(CommandError, match=r"it has no tare: the commands that it lists \(I0\) leave 'T' out"):
        balance.tare()
    balance.zero()
