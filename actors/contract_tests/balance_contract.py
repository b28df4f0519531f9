"""What every balance has to do, as tests. A driver's author derives a class from `BalanceContract` and runs pytest::

    class TestMyBalance(BalanceContract):
        @pytest.fixture
        def bench(self) -> Iterator[BalanceBench]:
            driver = MyBalance("/dev/ttyUSB0")
            yield BalanceBench(driver, put=ask_somebody_to_put, tolerance=0.2e-3)
            driver.close()

`put` changes what stands on the balance; before a real one it asks the operator. What a bench lacks is skipped, and
pytest shows it. Without `restless` the contract cannot check that a moving value is never taken for a weight, without
`unplug` and `plug` not that a lost connection is an error, without `ignore_tare` not that a tare without effect is one.
"""

from __future__ import annotations

import pickle
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass

import pytest

from actors.balance.balance_interface import BalanceDriver, ReferenceLostError, Weight
from actors.contract_tests.contract_calls import PATIENCE, Call
from actors.interfaces import LaboratoryError

AT_ONCE = 2.0
"""Longest time that an answer may take which should come at once [s]; a starved machine needs a part of it."""

READINGS = 10
"""Readings of a moving display, none of which may be stable."""


@dataclass(frozen=True)
class BalanceBench:
    """A balance to be tried, empty, and hands beside it.

    Attributes:
        driver: the driver, not yet connected.
        put: puts so much on it, in place of what was there [kg].
        tolerance: how far a weight may be off: step and scatter of the balance [kg].
        load: something that it weighs well [kg].
        capacity: more than it weighs [kg]; None: not to be tried.
        unplug, plug: pull the plug of its line, and put it in again; None: not to be tried.
        restless: has the load move from now on, or come to rest again; None: not to be tried.
        ignore_tare: has the balance take tare and do nothing from now on, or obey again; None: not to be tried.
        lost_within: the longest time from `unplug` to the error of a call under way [s of the clock].
        make: class and arguments that the driver was made of, to be made in another process.
    """

    driver: BalanceDriver
    put: Callable[[float], None]
    tolerance: float
    load: float = 0.2
    capacity: float | None = None
    unplug: Callable[[], None] | None = None
    plug: Callable[[], None] | None = None
    restless: Callable[[bool], None] | None = None
    ignore_tare: Callable[[bool], None] | None = None
    lost_within: float = 30.0
    make: tuple[object, ...] = ()


class BalanceContract:
    """Derive from this, in a class whose name begins with Test, with a fixture `bench`."""

    # Tests are skipped for what a bench can't do, never for what a driver can't: beside a real one nobody may be there
    # who trips it or pulls its plug, and its author is to see what was not tried. Ours leave out as little as they can.

    def test_it_says_who_it_is(self, bench: BalanceBench) -> None:
        """People read it in `decant doctor`."""
        assert bench.driver.connect().strip()

    def test_it_weighs_what_is_put_on_it(self, bench: BalanceBench) -> None:
        """In kilograms, and only what has settled counts."""
        bench.driver.tare()
        for mass in (bench.load, 0.5 * bench.load, bench.load):
            before = bench.driver.read()
            bench.put(mass)
            weight = bench.driver.weigh()
            assert weight.stable, f"weigh() returns {_g(weight.mass)} that is not stable; it waits for a stable weight"
            self._is(bench, weight, mass, "weigh()")
            assert weight.time > before.time, (
                f"weigh() returns a weight of the time {weight.time:.3f} s, before {_g(mass)} were put on the balance "
                f"({before.time:.3f} s); it weighs what is there now"
            )

    def test_the_display_follows_what_is_put_on_it(self, bench: BalanceBench) -> None:
        """An old reading is not shown as a new one."""
        bench.driver.tare()
        before = bench.driver.read()
        for mass in (bench.load, 0.5 * bench.load):
            bench.put(mass)
            self._shows(bench, mass)
        after = bench.driver.read()
        assert after.time > before.time, (
            f"read() gives {after.time:.3f} s as the time of its reading, and {before.time:.3f} s before the load was "
            "changed twice; it is the time at which the reading was made"
        )
        bench.driver.tare()
        self._shows(bench, 0.0)

    def test_times_of_weights_go_forwards(self, bench: BalanceBench) -> None:
        """They are matched with what the arm did."""
        first, second = bench.driver.weigh(), bench.driver.weigh()
        assert second.time > first.time, (
            f"weigh() returns a weight of the time {second.time:.3f} s, after one of the time {first.time:.3f} s"
        )

    def test_a_tare_counts_what_is_there_as_nothing(self, bench: BalanceBench) -> None:
        """What is taken away afterwards reads below zero."""
        bench.put(bench.load)
        bench.driver.tare()
        self._is(bench, bench.driver.weigh(), 0.0, "after tare weigh()")
        bench.put(1.5 * bench.load)
        self._is(bench, bench.driver.weigh(), 0.5 * bench.load, "after tare and half the load more weigh()")
        bench.put(0.0)
        self._is(bench, bench.driver.weigh(), -bench.load, "after tare of a load that was taken away weigh()")

    def test_a_tare_without_effect_is_an_error(self, bench: BalanceBench) -> None:
        """Balances acknowledge commands that they do not execute; a pour would start from a wrong zero."""
        if bench.ignore_tare is None:
            pytest.skip("BalanceBench.ignore_tare is missing: not checked is whether a tare without effect is an error")
        bench.put(bench.load)
        bench.driver.weigh()
        bench.ignore_tare(True)
        try:
            self._fails(Call(bench.driver.tare), "tare()", "although the balance still shows the load", PATIENCE)
        finally:
            bench.ignore_tare(False)

    def test_a_tare_waits_for_rest(self, bench: BalanceBench) -> None:
        """A moving value is never taken for zero."""
        if bench.restless is None:
            pytest.skip("BalanceBench.restless is missing: not checked is whether tare waits for rest")
        bench.driver.weigh()
        bench.restless(True)
        try:
            self._fails(Call(bench.driver.tare), "tare()", "although the display never came to rest", PATIENCE)
        finally:
            bench.restless(False)

    def test_a_moving_display_is_not_called_stable(self, bench: BalanceBench) -> None:
        """People read it during a pour, and records keep it."""
        if bench.restless is None:
            pytest.skip("BalanceBench.restless is missing: not checked is whether a moving display is called stable")
        bench.driver.weigh()
        bench.restless(True)
        try:
            self._await(lambda: not bench.driver.read().stable, "read() calls a display stable that never rests")
            for _ in range(READINGS):
                weight = bench.driver.read()
                assert not weight.stable, f"read() calls {_g(weight.mass)} stable; the display never rests"
                time.sleep(0.02)
        finally:
            bench.restless(False)

    def test_the_same_thing_weighs_the_same(self, bench: BalanceBench) -> None:
        """A spill is a difference of weights."""
        bench.put(bench.load)
        masses = [bench.driver.weigh().mass for _ in range(3)]
        spread = max(masses) - min(masses)
        assert spread <= 2.0 * bench.tolerance, (
            f"three weights of the same load differ by {_g(spread)}; at most {_g(2.0 * bench.tolerance)} are allowed"
        )

    def test_looking_changes_no_weight_and_takes_no_time(self, bench: BalanceBench) -> None:
        """The display is watched during a pour."""
        bench.driver.tare()
        bench.put(bench.load)
        bench.driver.weigh()
        began = time.monotonic()
        assert isinstance(bench.driver.read(), Weight)
        took = time.monotonic() - began
        assert took < AT_ONCE, f"read() took {took:.1f} s; it answers at once ({AT_ONCE:g} s), also during a call"
        self._is(bench, bench.driver.weigh(), bench.load, "after read() weigh()")

    def test_a_wait_can_be_ended_and_later_ones_last_again(self, bench: BalanceBench) -> None:
        """A stop must not wait for a balance."""
        if bench.restless is None:
            pytest.skip("nothing makes this balance wait")
        bench.driver.weigh()
        bench.restless(True)
        ended: list[float] = []

        def weigh() -> None:
            with pytest.raises(LaboratoryError):
                bench.driver.weigh()
            ended.append(time.monotonic())

        waiting = threading.Thread(target=weigh)
        waiting.start()
        time.sleep(0.2)
        asked = time.monotonic()
        bench.driver.interrupt()
        waiting.join(30.0)
        assert ended
        assert ended[0] - asked < AT_ONCE
        bench.restless(False)
        bench.driver.resume()
        bench.put(bench.load)
        bench.driver.weigh()

    def test_what_never_rests_is_no_weight(self, bench: BalanceBench) -> None:
        """A moving value is never taken for a weight."""
        if bench.restless is None:
            pytest.skip("nothing makes this balance restless")
        bench.driver.weigh()
        bench.restless(True)
        try:
            with pytest.raises(LaboratoryError):
                bench.driver.weigh()
        finally:
            bench.restless(False)

    def test_more_than_it_carries_is_an_error_and_not_a_weight(self, bench: BalanceBench) -> None:
        """And it weighs again once it is relieved."""
        if bench.capacity is None:
            pytest.skip("this balance is not to be overloaded")
        bench.driver.tare()
        bench.put(bench.capacity)
        with pytest.raises(LaboratoryError):
            bench.driver.weigh()
        bench.put(bench.load)
        self._is(bench, bench.driver.weigh(), bench.load, "after an overload was taken away weigh()")

    def test_a_lost_connection_puts_the_tare_in_doubt(self, bench: BalanceBench) -> None:
        """A balance that was off begins at a new zero: no weight until a person has said that the tare holds."""
        if bench.unplug is None or bench.plug is None:
            pytest.skip("this balance has no plug to pull")
        bench.driver.tare()
        bench.put(bench.load)
        bench.unplug()
        bench.driver.read()  # watching never fails
        bench.plug()
        with pytest.raises(ReferenceLostError):
            bench.driver.weigh()
        bench.driver.keep_reference()
        self._is(bench, bench.driver.weigh(), bench.load, "after keep_reference weigh()")

    def test_a_lost_connection_is_an_error_and_no_weight(self, bench: BalanceBench) -> None:
        """Calls end in a stated time, the call under way too; what is shown is not the last weight."""
        if bench.unplug is None or bench.plug is None:
            pytest.skip("BalanceBench.unplug or plug is missing: not checked is what a lost connection comes to")
        bench.driver.tare()
        bench.put(bench.load)
        bench.driver.weigh()
        self._shows(bench, bench.load)
        waiting = None
        if bench.restless is not None:
            bench.restless(True)
            waiting = Call(bench.driver.weigh)
        bench.unplug()
        try:
            if waiting is not None:
                self._fails(waiting, "weigh(), under way,", "although its connection was cut", bench.lost_within)
            self._await(
                lambda: not bench.driver.read().stable,
                "read() shows a stable weight after its connection was cut; it shows none, with the status 'lost'",
            )
            for call, name in ((bench.driver.weigh, "weigh()"), (bench.driver.tare, "tare()")):
                self._fails(Call(call), name, "although its connection was cut", bench.lost_within)
        finally:
            bench.plug()
            if bench.restless is not None:
                bench.restless(False)

    def test_it_can_be_made_where_the_bench_is(self, bench: BalanceBench) -> None:
        """Class and settings travel to another process."""
        if not bench.make:
            pytest.skip("it was not said what the driver is made of")
        assert pickle.loads(pickle.dumps(bench.make)) is not None

    def test_closing_twice_does_no_harm(self, bench: BalanceBench) -> None:
        """Ends overlap."""
        bench.driver.connect()
        bench.driver.close()
        bench.driver.close()

    # ---- how

    @staticmethod
    def _is(bench: BalanceBench, weight: Weight, mass: float, call: str) -> None:
        assert weight.mass == pytest.approx(mass, abs=bench.tolerance), (
            f"{call} returns {_g(weight.mass)}; {_g(mass)} ± {_g(bench.tolerance)} would be right"
        )

    def _shows(self, bench: BalanceBench, mass: float) -> None:
        def follows() -> bool:
            weight = bench.driver.read()
            return weight.stable and weight.mass == pytest.approx(mass, abs=bench.tolerance)

        self._await(follows, f"read() never shows a stable {_g(mass)}, which is what is on the balance", bench)

    @staticmethod
    def _await(condition: Callable[[], bool], otherwise: str, bench: BalanceBench | None = None) -> None:
        end = time.monotonic() + PATIENCE
        while not condition():
            seen = "" if bench is None else f"; it shows {_g(bench.driver.read().mass)}"
            assert time.monotonic() < end, otherwise + seen
            time.sleep(0.01)

    @staticmethod
    def _fails(call: Call, name: str, although: str, within: float) -> None:
        call.join(within)
        assert not call.is_alive(), f"{name} still waits after {within:g} s, {although}; it raises a LaboratoryError"
        assert call.error is not None, f"{name} returned {call.value}, {although}; it raises a LaboratoryError"
        assert isinstance(call.error, LaboratoryError), (
            f"{name} raised {type(call.error).__name__} ({call.error}), {although}; it raises a LaboratoryError"
        )


def _g(mass: float) -> str:
    return f"{1e3 * mass:.1f} g"
