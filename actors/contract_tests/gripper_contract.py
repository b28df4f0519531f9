"""The contract of grippers, as tests. The author of a driver derives a class and runs pytest::

    class TestMyGripper(GripperContract):
        @pytest.fixture
        def bench(self) -> Iterator[GripperRig]:
            settings = MyGripperSettings(address="192.168.0.10")
            driver = MyGripper(settings)
            yield GripperRig(driver, settings, put=ask_me_to_hold_it, width=0.06)
            driver.close()

`put` holds an object between the fingers without the driver; with a real gripper it asks a person, who keeps the own
fingers away. Tests for features that a bench lacks are skipped, and pytest shows them.
"""

from __future__ import annotations

import contextlib
import math
import pickle
import time
from collections.abc import Callable
from dataclasses import dataclass

import pytest

from actors.contract_tests.contract_calls import EVENT_TIMEOUT
from actors.grippers.gripper_interface import GripLimits, Gripper, GripperError, GripperSettings, GripperState


@dataclass(frozen=True)
class GripperRig:
    """A gripper under test, ready, with nothing between its fingers.

    Attributes:
        driver: not yet connected.
        settings: of the driver.
        put: holds an object of a width between the fingers [m], or takes it away with None.
        width: of the object [m].
        unplug: disconnects the gripper; None: not tested.
        switch_off: takes its power away; None: not tested.
    """

    driver: Gripper
    settings: GripperSettings
    put: Callable[[float | None], None]
    width: float
    unplug: Callable[[], None] | None = None
    switch_off: Callable[[], None] | None = None

    @property
    def limits(self) -> GripLimits:
        """Of a grasp of the object."""
        return GripLimits("object", self.width, 1e-3 + self.settings.accuracy)

    def gripped(self) -> GripperState:
        """Open the gripper, put the object in, and grip it."""
        self.driver.connect()
        self.driver.open(min(self.width + self.settings.clearance, self.settings.widest))
        self.put(self.width)
        return self.driver.grip(0.8 * self.width, self.settings.applied)

    def until(self, expected: Callable[[GripperState], bool]) -> GripperState:
        """The first state that is as expected."""
        end = time.monotonic() + EVENT_TIMEOUT
        while not expected(state := self.driver.state()):
            assert time.monotonic() < end, f"not seen within {EVENT_TIMEOUT:g} s; last {state}"
            time.sleep(0.02)
        return state


class GripperContract:
    """Derive a test class from this, with a name that begins with Test and a fixture `bench`."""

    def test_it_says_who_it_is_and_nothing_moves(self, bench: GripperRig) -> None:
        """Connecting moves no finger, also the second time: something may be held."""
        assert bench.driver.connect().strip()
        before = bench.driver.state()
        assert bench.driver.connect().strip()
        assert bench.driver.state() == before
        assert before.problem == ""
        assert not before.moving

    def test_it_opens_to_the_requested_width_and_holds_nothing(self, bench: GripperRig) -> None:
        """A gripper that opens next to another vessel must not open farther than requested."""
        bench.driver.connect()
        state = bench.driver.open(bench.width)
        assert not state.detected
        assert not state.moving
        assert math.isnan(state.width) or state.width == pytest.approx(bench.width, abs=4.0 * bench.settings.accuracy)

    def test_a_grasp_has_the_width_of_the_object(self, bench: GripperRig) -> None:
        """The width tells one vessel from another, and a straight grasp from a crooked one."""
        state = bench.gripped()
        assert bench.limits.problem(state) == ""
        assert state.detected is not False
        assert bench.driver.state() == state

    def test_fingers_that_close_on_nothing_hold_nothing(self, bench: GripperRig) -> None:
        """The arm must not leave without its vessel."""
        bench.driver.connect()
        bench.driver.open(min(bench.width + bench.settings.clearance, bench.settings.widest))
        state = bench.driver.grip(0.8 * bench.width, bench.settings.applied)
        if state.detected is None:
            pytest.skip("the gripper cannot detect an object")
        assert bench.limits.problem(state) != ""

    def test_a_lost_object_is_seen(self, bench: GripperRig) -> None:
        """The arm is stopped as soon as its vessel is lost."""
        if bench.gripped().detected is None:
            pytest.skip("the gripper cannot detect an object")
        bench.put(None)
        assert bench.limits.problem(bench.until(lambda state: bool(bench.limits.problem(state))))

    def test_a_held_object_stays_held_when_the_driver_ends(self, bench: GripperRig) -> None:
        """A program that ends must not drop a vessel."""
        state = bench.gripped()
        bench.driver.stop()
        bench.driver.close()
        bench.driver.close()
        bench.driver.connect()
        assert bench.limits.problem(bench.driver.state()) == bench.limits.problem(state) == ""

    def test_it_can_let_go(self, bench: GripperRig) -> None:
        """The pourer is weighed again after the pour."""
        bench.gripped()
        assert not bench.driver.open(min(bench.width + bench.settings.clearance, bench.settings.widest)).detected

    def test_a_gripper_without_power_is_no_grasp(self, bench: GripperRig) -> None:
        """Its brake may hold the object, and nothing tells whether it does."""
        if bench.switch_off is None:
            pytest.skip("the bench can't switch the gripper off")
        bench.gripped()
        bench.switch_off()
        with contextlib.suppress(GripperError):
            assert bench.limits.problem(bench.driver.state())

    def test_a_lost_connection_is_an_error(self, bench: GripperRig) -> None:
        """No state counts as read if the gripper does not answer."""
        if bench.unplug is None:
            pytest.skip("the bench can't unplug the gripper")
        bench.gripped()
        bench.unplug()
        with pytest.raises(GripperError):
            bench.driver.state()
        bench.driver.close()

    def test_it_goes_to_another_process(self, bench: GripperRig) -> None:
        """The driver runs in a process of its own."""
        cls, arguments = bench.settings.driver()
        again, values = pickle.loads(pickle.dumps((cls, arguments)))
        assert again is cls
        assert values == arguments
