"""The contracts of pumps and spill sensors, as tests. The author of a driver derives a class and runs pytest::

    class TestMyPump(PumpContract):
        @pytest.fixture
        def bench(self) -> Iterator[PumpRig]:
            driver = MyPump("/dev/ttyUSB0")
            yield PumpRig(driver, MyPumpSettings(), weigh=read_the_balance, tolerance=0.05)
            driver.close()

`weigh` and `wet` observe and change the world without the driver; with real devices they ask the operator. Tests for
features that a bench lacks are skipped, and pytest shows them.
"""

from __future__ import annotations

import pickle
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass

import pytest

from actors.contract_tests.contract_calls import EVENT_TIMEOUT, Call
from actors.interfaces import LaboratoryError
from actors.liquid_devices import Pump, PumpSettings, PumpStoppedError, SpillSensor

AT_ONCE = 2.0
"""Time limit for calls that return immediately [s]; a fully loaded machine stays well below it."""


@dataclass(frozen=True)
class PumpRig:
    """A pump under test, with liquid at its inlet.

    Attributes:
        driver: not yet connected.
        settings: of the driver.
        weigh: the volume that has left the outlet so far [m³], measured without the driver.
        tolerance: largest relative error of a volume.
        volume: a volume of some seconds' flow [m³].
        stops_within: longest time from `stop` to the end of the flow [s of the clock].
        unplug: disconnects the pump; None: not tested.
        make: class and arguments of the driver, to create it in another process.
    """

    driver: Pump
    settings: PumpSettings
    weigh: Callable[[], float]
    tolerance: float
    volume: float = 20e-6
    stops_within: float = 1.0
    unplug: Callable[[], None] | None = None
    make: tuple[object, ...] = ()

    def move(self, volume: float) -> None:
        """Request a volume [m³] as the bench does."""
        method, amount = self.settings.request(volume)
        getattr(self.driver, method)(amount)

    def flows(self, since: float) -> bool:
        """Wait until more than `since` [m³] has left the outlet; whether it has."""
        end = time.monotonic() + EVENT_TIMEOUT
        while self.weigh() <= since and time.monotonic() < end:
            time.sleep(0.01)
        return self.weigh() > since


class PumpContract:
    """Derive a test class from this, with a name that begins with Test and a fixture `bench`."""

    def test_it_says_who_it_is_and_nothing_flows(self, bench: PumpRig) -> None:
        """Connecting moves no liquid, also the second time."""
        assert bench.driver.connect().strip()
        assert bench.driver.connect().strip()
        assert bench.weigh() == pytest.approx(0.0, abs=bench.settings.smallest)

    def test_it_moves_what_is_requested(self, bench: PumpRig) -> None:
        """The flow has ended when the call returns; half the volume is half as much."""
        bench.driver.connect()
        for volume in (bench.volume, 0.5 * bench.volume):
            before = bench.weigh()
            bench.move(volume)
            moved = bench.weigh() - before
            assert moved == pytest.approx(volume, rel=bench.tolerance, abs=bench.settings.smallest)
            assert bench.weigh() - before == pytest.approx(moved, abs=0.1 * bench.settings.smallest)

    def test_a_stop_ends_the_flow_and_is_an_error(self, bench: PumpRig) -> None:
        """The bench must not take a stopped portion for a whole one."""
        bench.driver.connect()
        before = bench.weigh()
        call = Call(bench.move, bench.volume)
        if not bench.flows(before):
            bench.driver.stop()
            pytest.skip("the flow can't be seen while it lasts")
        begun = time.monotonic()
        bench.driver.stop()
        assert isinstance(call.ended(), PumpStoppedError)
        assert time.monotonic() - begun < bench.stops_within + AT_ONCE
        stopped = bench.weigh()
        assert stopped - before < bench.volume * (1.0 - bench.tolerance)
        assert not threading.Event().wait(0.2)
        assert bench.weigh() == pytest.approx(stopped, abs=0.1 * bench.settings.smallest)

    def test_a_stop_at_rest_does_not_stop_the_next_request(self, bench: PumpRig) -> None:
        """The bench stops the pump after every failure."""
        bench.driver.connect()
        bench.driver.stop()
        before = bench.weigh()
        bench.move(0.5 * bench.volume)
        assert bench.weigh() - before == pytest.approx(0.5 * bench.volume, rel=bench.tolerance)

    def test_a_lost_connection_is_an_error(self, bench: PumpRig) -> None:
        """No volume counts as moved if the pump does not answer."""
        if bench.unplug is None:
            pytest.skip("the bench can't unplug the pump")
        bench.driver.connect()
        bench.unplug()
        with pytest.raises(LaboratoryError):
            bench.move(bench.volume)

    def test_it_closes_twice_and_goes_to_another_process(self, bench: PumpRig) -> None:
        """Errors of the last calls would hide the reason of a failure."""
        bench.driver.connect()
        bench.driver.close()
        bench.driver.close()
        if not bench.make:
            pytest.skip("the bench does not say how the driver is made")
        assert pickle.loads(pickle.dumps(bench.make)) == bench.make


@dataclass(frozen=True)
class SpillRig:
    """A spill sensor under test, dry.

    Attributes:
        driver: not yet connected.
        wet: makes the place wet, or dries it again.
        place: name of that place.
        seen_within: longest time until an event is reported [s of the clock].
        unplug: disconnects the sensor; None: not tested.
    """

    driver: SpillSensor
    wet: Callable[[bool], None]
    place: str
    seen_within: float = 1.0
    unplug: Callable[[], None] | None = None

    def change(self, wet: bool) -> tuple[str, bool]:
        """Wet or dry the place; the place and state of the only event that follows."""
        self.wet(wet)
        end = time.monotonic() + self.seen_within + AT_ONCE
        while not (events := self.driver.events()) and time.monotonic() < end:
            time.sleep(0.01)
        assert len(events) == 1, f"one change is one event, and there were {len(events)}"
        assert abs(events[0].time - time.time()) < self.seen_within + AT_ONCE, "its time is seconds since 1970"
        return events[0].place, events[0].wet


class SpillSensorContract:
    """Derive a test class from this, with a name that begins with Test and a fixture `bench`."""

    def test_a_dry_table_gives_no_event(self, bench: SpillRig) -> None:
        """Otherwise no pour would begin."""
        assert bench.driver.connect().strip()
        assert bench.driver.events() == []

    def test_each_change_is_one_event_with_its_place(self, bench: SpillRig) -> None:
        """The question to the operator names that place, and the answer is checked."""
        bench.driver.connect()
        assert bench.change(True) == (bench.place, True)
        assert bench.driver.events() == []
        assert bench.change(False) == (bench.place, False)
        assert bench.change(True) == (bench.place, True)

    def test_a_table_that_is_wet_before_is_reported(self, bench: SpillRig) -> None:
        """The first call reports the wet places, so that no pour begins over an old spill."""
        bench.wet(True)
        bench.driver.connect()
        assert [(event.place, event.wet) for event in bench.driver.events()] == [(bench.place, True)]

    def test_a_look_does_not_wait(self, bench: SpillRig) -> None:
        """It is called ten times a second while liquid flows."""
        bench.driver.connect()
        begun = time.monotonic()
        for _ in range(5):
            bench.driver.events()
        assert time.monotonic() - begun < AT_ONCE

    def test_a_silent_sensor_is_an_error(self, bench: SpillRig) -> None:
        """A sensor that does not answer must not count as a dry table."""
        bench.driver.connect()
        if bench.unplug is None:
            pytest.skip("the bench can't unplug the sensor")
        bench.unplug()
        with pytest.raises(LaboratoryError):
            bench.driver.events()
        bench.driver.close()
        bench.driver.close()
