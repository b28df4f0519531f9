"""The contract of balance drivers, as tests. The author of a driver derives a class from `BalanceContract` and runs
pytest::

    class TestMyBalance(BalanceContract):
        @pytest.fixture
        def bench(self) -> Iterator[BalanceBench]:
            driver = MyBalance("/dev/ttyUSB0")
            yield BalanceBench(driver, put=ask_somebody_to_put, tolerance=0.2e-3)
            driver.close()

`put` changes the load on the balance; with a real one it asks the operator. Tests for features that a bench lacks are
skipped, and pytest shows them. Without `restless` the contract cannot check that a moving value is never taken for a
weight. Without `unplug` and `plug` it cannot check that a lost connection is an error, and without `ignore_tare` that a
tare without effect is one.
"""

from __future__ import annotations

import pickle
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass

import pytest

from actors.balance.balance_interface import BalanceDriver, ReferenceLostError, Weight
from actors.contract_tests.contract_calls import EVENT_TIMEOUT, Call
from actors.interfaces import LaboratoryError

AT_ONCE = 2.0
"""Time limit for calls that return immediately [s]; a fully loaded machine stays well below it."""

READINGS = 10
"""Number of readings of a moving display, none of which may be stable."""


@dataclass(frozen=True)
class BalanceBench:
    """A balance under test, without a load.

    Attributes:
        driver: the driver, not yet connected.
        put: replaces the load on the balance [kg].
        tolerance: largest error of a weight: step and scatter of the balance [kg].
        load: a load within its range [kg].
        capacity: a load above its range [kg]; None: not tested.
        unplug, plug: unplug its line and plug it in again; None: not tested.
        restless: makes the load move from now on, or rest again; None: not tested.
        ignore_tare: makes the balance accept a tare without executing it from now on, or execute it again; None: not
            tested.
        lost_within: the longest time from `unplug` to the error of a running call [s of the clock].
        make: class and arguments of the driver, to create it in another process.
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
    """Derive a test class from this, with a name that begins with Test and a fixture `bench`."""

    # Tests are skipped if the bench lacks a feature, never if the driver does. With a real balance there may be no one
    # to pull its plug, and the author must see which tests were skipped. The project's own benches skip as few tests as
    # possible.

    def test_it_says_who_it_is(self, bench: BalanceBench) -> None:
        """`decant robot check` shows the identification."""
        assert bench.driver.connect().strip()

    def test_it_weighs_what_is_put_on_it(self, bench: BalanceBench) -> None:
        """In kilograms, and only settled weights count."""
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
        """An old reading is not reported as a new one."""
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
        """Times relate weights to the motion of the arm."""
        first, second = bench.driver.weigh(), bench.driver.weigh()
        assert second.time > first.time, (
            f"weigh() returns a weight of the time {second.time:.3f} s, after one of the time {first.time:.3f} s"
        )

    def test_a_tare_counts_what_is_there_as_nothing(self, bench: BalanceBench) -> None:
        """A load that is removed after the tare gives a negative weight."""
        bench.put(bench.load)
        bench.driver.tare()
        self._is(bench, bench.driver.weigh(), 0.0, "after tare weigh()")
        bench.put(1.5 * bench.load)
        self._is(bench, bench.driver.weigh(), 0.5 * bench.load, "after tare and half the load more weigh()")
        bench.put(0.0)
        self._is(bench, bench.driver.weigh(), -bench.load, "after tare of a load that was taken away weigh()")

    def test_a_tare_without_effect_is_an_error(self, bench: BalanceBench) -> None:
        """Balances may acknowledge commands without executing them; a pour would start from a wrong zero."""
        if bench.ignore_tare is None:
            pytest.skip("BalanceBench.ignore_tare is missing; not checked: whether a tare without effect is an error")
        bench.put(bench.load)
        bench.driver.weigh()
        bench.ignore_tare(True)
        try:
            self._fails(Call(bench.driver.tare), "tare()", "although the balance still shows the load", EVENT_TIMEOUT)
        finally:
            bench.ignore_tare(False)

    def test_a_tare_waits_for_rest(self, bench: BalanceBench) -> None:
        """A moving value is never taken for zero."""
        if bench.restless is None:
            pytest.skip("BalanceBench.restless is missing; not checked: whether tare waits for rest")
        bench.driver.weigh()
        bench.restless(True)
        try:
            self._fails(Call(bench.driver.tare), "tare()", "although the display never came to rest", EVENT_TIMEOUT)
        finally:
            bench.restless(False)

    def test_a_moving_display_is_not_called_stable(self, bench: BalanceBench) -> None:
        """The operator reads the display during a pour, and records keep it."""
        if bench.restless is None:
            pytest.skip("BalanceBench.restless is missing; not checked: whether a moving display is called stable")
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
        """The display is read during a pour."""
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
        """The balance weighs again after the overload is removed."""
        if bench.capacity is None:
            pytest.skip("this balance is not to be overloaded")
        bench.driver.tare()
        bench.put(bench.capacity)
        with pytest.raises(LaboratoryError):
            bench.driver.weigh()
        bench.put(bench.load)
        self._is(bench, bench.driver.weigh(), bench.load, "after an overload was taken away weigh()")

    def test_a_lost_connection_puts_the_tare_in_doubt(self, bench: BalanceBench) -> None:
        """A balance that was off has a new zero: no weight is returned until the operator confirms the tare."""
        if bench.unplug is None or bench.plug is None:
            pytest.skip("this balance has no plug to pull")
        bench.driver.tare()
        bench.put(bench.load)
        bench.unplug()
        bench.driver.read()  # read() never fails
        bench.plug()
        with pytest.raises(ReferenceLostError):
            bench.driver.weigh()
        bench.driver.keep_reference()
        self._is(bench, bench.driver.weigh(), bench.load, "after keep_reference weigh()")

    def test_a_lost_connection_is_an_error_and_no_weight(self, bench: BalanceBench) -> None:
        """Calls end within the stated time, including the running one; the display does not keep the last weight."""
        if bench.unplug is None or bench.plug is None:
            pytest.skip("BalanceBench.unplug or plug is missing; not checked: what happens when the connection is lost")
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
        """Class and settings can be sent to another process."""
        if not bench.make:
            pytest.skip("it was not said what the driver is made of")
        assert pickle.loads(pickle.dumps(bench.make)) is not None

    def test_closing_twice_does_no_harm(self, bench: BalanceBench) -> None:
        """Several parts of a bench may close the driver."""
        bench.driver.connect()
        bench.driver.close()
        bench.driver.close()

    # ---- helpers

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
        end = time.monotonic() + EVENT_TIMEOUT
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
