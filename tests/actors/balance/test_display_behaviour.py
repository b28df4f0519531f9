"""`display_behaviour`: habits of real displays, on the virtual bench of doses, the emulated serial balance and the
simulated balance.

The recordings of Bluetooth balances in github.com/miharekar/visualizer have gaps with medians of 0.09 to 0.12 s,
standard deviations of 0.021 to 0.046 s, and largest values of 0.22 to 0.46 s; in one of the six, 22 % of the readings
repeat the one before while the load rises, up to 4 in a row, and in the others 0 to 6 %.
"""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from actors.balance.display_behaviour import DisplayBehaviour, DisplayModel
from actors.balance.scale_model import EmulatedScale, Load, ScaleSettings
from actors.balance.simulated_balance import SimulatedBalanceSettings, VirtualBalance
from actors.dosing.virtual_dosing_bench import TrueCup, TrueScale, VirtualDosingBench
from actors.emulators.serial_balance.emulated_balance import Emulation
from sim_engine.liquids import Liquid
from tests.support.hypothesis_examples import examples

HELD = DisplayBehaviour(repeat_probability=0.42)
STEP = 1e-4


def shown(behaviour: DisplayBehaviour, rate: float, *, interval=0.1, count=600, start=0.0) -> np.ndarray:
    """Readings of a load that rises at a rate [kg/s], without noise or rounding."""
    model, seen = DisplayModel(behaviour, STEP, (4,), start), []
    for k in range(count):
        model.advance(start + rate * interval * (k + 1), interval, start)
        seen.append(model.show(lambda: model.value))
    return np.array(seen)


def runs(values: np.ndarray) -> list[int]:
    """Lengths of the runs of repeated readings."""
    return [len(list(group)) - 1 for _, group in itertools.groupby(values)]


@settings(max_examples=examples(40))
@given(probability=st.floats(0.05, 0.9), longest=st.integers(1, 8))
def test_a_held_display_repeats_as_often_and_as_long_as_its_settings_say(probability, longest):
    values = shown(DisplayBehaviour(repeat_probability=probability, longest_repeat=longest), 1e-3, count=4000)
    mean = sum(probability**k for k in range(1, longest + 1))
    assert np.mean(np.diff(values) == 0.0) == pytest.approx(mean / (1.0 + mean), abs=0.05)
    assert max(runs(values)) <= longest
    assert np.all(np.diff(values) >= 0.0)


def test_readings_of_one_conversion_are_equal_and_show_the_load_at_its_time():
    values = shown(DisplayBehaviour(conversion_interval=0.5), 1e-3, count=200)
    assert set(runs(values)[1:-1]) == {4}
    risen = 1e-3 * 0.1 * (np.arange(200) + 1)
    assert np.max(risen - values) == pytest.approx(1e-3 * 0.4, abs=1e-9)
    assert np.min(risen - values) >= -1e-12


def test_a_rate_of_the_readings_that_is_below_that_of_the_conversions_repeats_none():
    assert max(runs(shown(DisplayBehaviour(conversion_interval=0.05), 1e-3))) == 0


@settings(max_examples=examples(20))
@given(jitter=st.floats(0.005, 0.3), interval=st.floats(0.05, 0.3))
def test_readings_with_jitter_arrive_late_and_in_order(jitter, interval):
    model = DisplayModel(DisplayBehaviour(jitter=jitter), STEP, (1,))
    due = interval * np.arange(300)
    arrivals = np.array([model.arrival(float(time)) for time in due])
    assert np.all(np.diff(arrivals) > 0.0)
    assert np.all(arrivals >= due)
    assert np.mean(arrivals - due) > 0.7 * jitter


def test_jitter_gives_the_gaps_of_recorded_balances():
    model = DisplayModel(DisplayBehaviour(jitter=0.02), STEP, (1,))
    gaps = np.diff([model.arrival(0.092 * k) for k in range(500)])
    assert 0.085 < np.median(gaps) < 0.1
    assert 0.021 < np.std(gaps) < 0.046
    assert 0.14 < np.max(gaps) < 0.46


@settings(max_examples=examples(20))
@given(rate=st.floats(0.01, 0.45), band=st.floats(0.5, 3.0))
def test_tracking_of_zero_hides_a_flow_that_is_slower_than_it(rate, band):
    """OIML R 76: 0.5 steps per second."""
    behaviour = DisplayBehaviour(zero_tracking=0.5, zero_band=band)
    assert np.max(np.abs(shown(behaviour, rate * STEP))) < 0.5 * STEP


@settings(max_examples=examples(20))
@given(rate=st.floats(1.0, 500.0), start=st.sampled_from([0.0, 0.18]))
def test_tracking_of_zero_hides_little_of_a_faster_flow(rate, start):
    behaviour = DisplayBehaviour(zero_tracking=0.5)
    values = shown(behaviour, rate * STEP, interval=0.01, start=start)
    loss = start + rate * STEP * 0.01 * 600 - values[-1]
    assert 0.0 <= loss <= 0.5 * STEP * 0.5 / (rate - 0.5) + 0.5 * STEP * 0.011
    assert loss > 0.0 or rate * 0.01 > 0.5


def test_away_from_zero_nothing_is_tracked():
    model = DisplayModel(DisplayBehaviour(zero_tracking=0.5), STEP, (1,))
    for _ in range(1000):
        model.advance(0.1, 0.1)
    assert model.value == 0.1


def test_the_filter_at_rest_delays_small_changes_and_follows_large_ones_at_once():
    behaviour = DisplayBehaviour(rest_lag=1.0, rest_band=4.0)
    slow = shown(behaviour, 2.0 * STEP)  # two steps behind, within the band
    assert 2.0 * STEP * 0.1 * 600 - slow[-1] == pytest.approx(2.0 * STEP, rel=0.1)
    model = DisplayModel(behaviour, STEP, (1,))
    assert model.advance(100 * STEP, 0.1) == 100 * STEP
    model.advance(103 * STEP, 0.1)
    assert model.value == pytest.approx((100 + 3 * -math.expm1(-0.1)) * STEP)
    assert not model.settled
    model.advance(103 * STEP, 10.0)
    assert model.settled


@pytest.mark.parametrize("creep", [2.5e-4, -1e-3])
def test_creep_adds_its_part_of_the_load_with_its_time_constant(creep):
    """2.5e-4 is what OIML R 60 permits load cells of class C3 within 30 minutes."""
    model = DisplayModel(DisplayBehaviour(creep=creep, creep_time=60.0), STEP, (1,), load=0.2)
    assert model.advance(0.2, 1000.0) == 0.2, "a load of long ago creeps no more"
    assert model.advance(1.2, 1e-6) == pytest.approx(1.2, abs=1e-9)
    assert model.advance(1.2, 60.0) == pytest.approx(1.2 + creep * (1.0 - math.exp(-1.0)), abs=1e-9)
    assert model.advance(1.2, 6000.0) == pytest.approx(1.2 + creep)


# The three balances.


def bench(behaviour: DisplayBehaviour, **scale: float) -> VirtualDosingBench:
    made = TrueScale(interval=0.2, behaviour=behaviour, **scale)  # type: ignore[arg-type]
    return VirtualDosingBench(TrueCup(0.04, 0.11, 0.008), Liquid(mass=0.3), made, 3)


def test_the_virtual_bench_of_doses_shows_the_same_load_with_and_without_habits():
    plain, late = bench(DisplayBehaviour()).place_receiver(), bench(DisplayBehaviour(jitter=0.05)).place_receiver()
    assert [one.mass for one in plain] == [one.mass for one in late]
    assert np.std(np.diff([one.time for one in late])) > 0.02
    held = bench(HELD, noise=1e-4, step=1e-5).place_receiver()
    assert len(held) == len(plain)
    masses = np.array([one.mass for one in held])
    assert 0.2 < np.mean(np.diff(masses) == 0.0) < 0.65
    assert abs(masses[-1] - plain[-1].mass) < 1e-3
    assert len(bench(DisplayBehaviour(lost=0.5)).place_receiver()) < 0.7 * len(plain)


def test_two_displays_of_one_bench_repeat_differently():
    pourer = bench(HELD, noise=1e-4, step=1e-5)
    repeats = [np.diff([one.mass for one in pourer.place_receiver()]) == 0.0 for _ in range(2)]
    assert not np.array_equal(repeats[0][: len(repeats[1])], repeats[1][: len(repeats[0])])


def test_the_emulated_scale_holds_its_display_and_creeps():
    scale = EmulatedScale(ScaleSettings(behaviour=HELD.with_values(creep=1e-3, creep_time=5.0)), (2,))
    scale.put(Load((0.0, 60.0), (0.0, 0.6)))
    seen = []
    for _ in range(600):
        scale.advance(0.1)
        seen.append(float(scale.reading().value or 0.0))
    assert np.mean(np.diff(seen) == 0.0) == pytest.approx(0.42, abs=0.06)
    assert max(runs(np.array(seen))) <= 5
    scale.advance(60.0)
    assert float(scale.gross) == pytest.approx(0.6006, abs=1e-6)


def test_a_scale_with_a_slow_filter_at_rest_is_stable_when_its_display_has_arrived():
    scale = EmulatedScale(ScaleSettings(settling_time=0.0, behaviour=DisplayBehaviour(rest_lag=2.0, rest_band=50.0)))
    scale.put(Load((0.0,), (0.004,)))
    while not scale.stable:
        scale.advance(0.05)
    assert scale.time > 5.0
    assert scale.gross == pytest.approx(0.004, abs=STEP / 4.0)


def test_tare_works_with_a_tracked_zero_and_a_converted_display():
    scale = EmulatedScale(ScaleSettings(behaviour=DisplayBehaviour(zero_tracking=0.5, conversion_interval=0.25)))
    scale.put(Load((0.0,), (0.2,)))
    scale.advance(10.0)
    scale.tare()
    scale.advance(1.0)
    assert scale.reading().value == 0
    scale.put(Load((0.0, 100.0), (0.2, 0.203)))  # 0.3 steps per second
    scale.advance(100.0)
    assert scale.reading().value == 0, "the flow is slower than the tracking"
    scale.put(Load((0.0,), (0.253,)))
    scale.advance(10.0)
    assert float(scale.reading().value) == pytest.approx(50.0, abs=0.11)


def sent(behaviour: DisplayBehaviour, seconds: float = 30.0) -> tuple[list[float], list[str]]:
    """Times and lines of a balance that sends continuously while its load rises."""
    balance = Emulation("mt-sics", ScaleSettings(behaviour=behaviour), time_scale=1.0, latency=0.0, seed=(1,))
    balance.control({"do": "put", "times": [0.0, seconds], "masses": [0.0, 0.3]}, 0.0)
    balance.hear(b"SIR\r\n", 0.0)
    times, lines = [], []
    for k in range(round(seconds / 0.01)):
        for line in balance.speak(0.01 * k).decode("ascii").splitlines():
            times.append(0.01 * k)
            lines.append(line)
    return times, lines


def test_an_emulated_serial_balance_sends_late_and_loses_and_repeats_lines():
    times, lines = sent(DisplayBehaviour())
    late, _ = sent(DisplayBehaviour(jitter=0.03))
    assert np.std(np.diff(late)) > np.std(np.diff(times)) + 0.015
    assert len(late) == pytest.approx(len(times), abs=2)
    assert len(sent(DisplayBehaviour(lost=0.3))[0]) == pytest.approx(0.7 * len(times), rel=0.15)
    _, held = sent(HELD)
    assert max(runs(np.array(lines)), default=0) == 0
    assert np.mean([a == b for a, b in itertools.pairwise(held)]) == pytest.approx(0.42, abs=0.12)


def test_a_lost_reply_is_silence_for_that_query_only():
    balance = Emulation(
        "mt-sics", ScaleSettings(behaviour=DisplayBehaviour(lost=0.5)), time_scale=1.0, latency=0.0, seed=(1,)
    )
    answers = []
    for k in range(100):
        balance.hear(b"SI\r\n", 0.1 * k)
        answers.append(balance.speak(0.1 * k))
    assert 30 < answers.count(b"") < 70
    balance.hear(b"I4\r\n", 20.0)
    assert balance.speak(20.0) == b'I4 A "0123456789"\r\n', "only weights are lost"


def simulated(behaviour: DisplayBehaviour) -> VirtualBalance:
    device = VirtualBalance(SimulatedBalanceSettings(noise=0.0, settling_time=0.0, time_scale=0.0, behaviour=behaviour))
    device.prepare((1,))
    return device


def test_the_simulated_balance_creeps_and_holds_what_it_shows():
    device = simulated(DisplayBehaviour(creep=5e-3, creep_time=20.0))
    device.put(Load((0.0,), (1.0,)))
    assert device.weigh().mass == pytest.approx(1.0, abs=1e-3)
    device.pass_time(120.0)
    assert device.weigh().mass == pytest.approx(1.005, abs=1.1e-4)
    device = simulated(HELD)
    device.put(Load((0.0, 60.0), (0.0, 6.0)))
    seen = []
    for _ in range(400):
        device.pass_time(0.1)
        seen.append(device.read().mass)
    assert np.mean(np.diff(seen) == 0.0) == pytest.approx(0.42, abs=0.06)
