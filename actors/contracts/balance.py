"""What every balance has to do, as tests. A driver's author derives a class from `BalanceContract` and runs pytest.

    class TestMyBalance(BalanceContract):
        @pytest.fixture
        def bench(self) -> Iterator[BalanceBench]:
            driver = MyBalance("/dev/ttyUSB0")
            yield BalanceBench(driver, put=ask_somebody_to_put, tolerance=0.2e-3)
            driver.close()

`put` changes what stands on the balance; before a real one it asks a person. What a bench can't do (`capacity`,
`unplug`, `restless`) is left out, and pytest says what was skipped.
"""

from __future__ import annotations

import pickle
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass

import pytest

from actors.balance.errors import ReferenceLostError
from actors.balance.protocol import BalanceDriver, Weight
from actors.protocols import LaboratoryError

AT_ONCE = 2.0
"""Longest time that an answer may take which should come at once [s]; a starved machine needs a part of it."""


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
            bench.put(mass)
            weight = bench.driver.weigh()
            assert weight.stable
            assert weight.mass == pytest.approx(mass, abs=bench.tolerance)

    def test_times_of_weights_go_forwards(self, bench: BalanceBench) -> None:
        """They are matched with what the arm did."""
        first, second = bench.driver.weigh(), bench.driver.weigh()
        assert second.time > first.time

    def test_a_tare_counts_what_is_there_as_nothing(self, bench: BalanceBench) -> None:
        """What is taken away afterwards reads below zero."""
        bench.put(bench.load)
        bench.driver.tare()
        assert bench.driver.weigh().mass == pytest.approx(0.0, abs=bench.tolerance)
        bench.put(1.5 * bench.load)
        assert bench.driver.weigh().mass == pytest.approx(0.5 * bench.load, abs=bench.tolerance)
        bench.put(0.0)
        assert bench.driver.weigh().mass == pytest.approx(-bench.load, abs=bench.tolerance)

    def test_the_same_thing_weighs_the_same(self, bench: BalanceBench) -> None:
        """A spill is a difference of weights."""
        bench.put(bench.load)
        masses = [bench.driver.weigh().mass for _ in range(3)]
        assert max(masses) - min(masses) <= 2.0 * bench.tolerance

    def test_looking_changes_no_weight_and_takes_no_time(self, bench: BalanceBench) -> None:
        """The display is watched during a pour."""
        bench.driver.tare()
        bench.put(bench.load)
        bench.driver.weigh()
        began = time.monotonic()
        assert isinstance(bench.driver.read(), Weight)
        assert time.monotonic() - began < AT_ONCE
        assert bench.driver.weigh().mass == pytest.approx(bench.load, abs=bench.tolerance)

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
        assert bench.driver.weigh().mass == pytest.approx(bench.load, abs=bench.tolerance)

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
        assert bench.driver.weigh().mass == pytest.approx(bench.load, abs=bench.tolerance)

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
