"""`urscript_writer`: the program of a dose on the emulated controller: it tilts as told, within its limits, and
back without news.
"""

from __future__ import annotations

import math

import numpy as np
import pytest

from actors.arm.ur.urscript_writer import TiltLimits, tilt_program
from actors.arm.ur.worker_messages import (
    CLOCK,
    DONE,
    GO,
    STATUS,
    STOP_ORDER,
    STOPPED,
    TILT_COUNTER,
    TILT_HIGHEST,
    TILT_PATIENCE,
    TILT_SPEED,
    MotionSettings,
)
from actors.emulators.ur_controller.controller import RuntimeState
from actors.emulators.ur_controller.robot import HOME
from actors.emulators.ur_controller.safety_system import SafetyMode
from tests.actors.emulators.ur_controller.conftest import Bench

TILTS = np.radians(np.arange(0.0, 101.0, 2.0))
NUMBER, REGISTERS = 7, 43
LIMITS = TiltLimits(math.radians(115.0), math.radians(600.0))


class Dose(Bench):
    """A controller with a running dose; the sixth joint tilts, a little faster than evenly."""

    def __init__(self) -> None:
        super().__init__()
        joints = np.tile(np.array(HOME), (len(TILTS), 1))
        joints[:, 5] += TILTS + 0.05 * np.sin(TILTS)
        settings = MotionSettings((0.0,) * 6, 1.0, (0.0, 0.0, 0.1), REGISTERS)
        self.controller.upload(tilt_program(TILTS, joints, LIMITS, settings, NUMBER, cb3=False))
        self.controller.registers.input_int[REGISTERS + GO] = NUMBER
        self.tick(0.1)

    @property
    def tilt(self) -> float:
        """As the program reports it [deg]."""
        return math.degrees(self.controller.registers.output_double[CLOCK])

    @property
    def playing(self) -> bool:
        return self.controller.runtime is RuntimeState.PLAYING

    def order(self, speed: float, highest: float = 100.0, patience: float = 0.2) -> None:
        """Write an order: speed [deg/s], largest tilt [deg], and patience [s]."""
        inputs = self.controller.registers.input_double
        inputs[REGISTERS + TILT_SPEED], inputs[REGISTERS + TILT_HIGHEST] = math.radians(speed), math.radians(highest)
        inputs[REGISTERS + TILT_PATIENCE] = patience
        inputs[REGISTERS + TILT_COUNTER] += 1

    def drive(self, speed: float, seconds: float, highest: float = 100.0) -> None:
        """Write an order 20 times a second."""
        for _ in range(round(seconds / 0.05)):
            self.order(speed, highest)
            self.tick(0.05)


def test_the_cup_tilts_at_the_speed_in_the_register() -> None:
    dose = Dose()
    dose.drive(30.0, 1.0)
    assert dose.tilt == pytest.approx(30.0, abs=1.5)  # it accelerates first
    dose.drive(-10.0, 1.0)
    assert dose.tilt == pytest.approx(20.0, abs=2.0)
    angle = math.radians(dose.tilt)
    assert dose.joints[-1][5] - HOME[5] == pytest.approx(angle + 0.05 * math.sin(angle), abs=0.01)


def test_without_news_the_cup_is_upright_within_a_second() -> None:
    dose = Dose()
    dose.drive(60.0, 1.05)
    dose.drive(3.0, 0.4)
    assert dose.tilt > 60.0
    dose.tick(1.0)
    assert dose.tilt == 0.0
    assert dose.joints[-1][5] == pytest.approx(HOME[5], abs=math.radians(3.0))  # the servo follows a little later
    assert dose.playing  # a computer that paused may pour on
    dose.tick(0.8)
    assert not dose.playing
    assert dose.controller.registers.output_int[STATUS] == DONE
    assert dose.controller.safety.mode is SafetyMode.NORMAL


def test_after_a_pause_the_dose_goes_on() -> None:
    dose = Dose()
    dose.drive(30.0, 1.0)
    dose.tick(1.0)
    assert dose.tilt == 0.0
    dose.drive(30.0, 1.0)
    assert dose.tilt == pytest.approx(30.0, abs=1.5)


def test_a_short_gap_does_not_turn_it_back() -> None:
    dose = Dose()
    dose.drive(20.0, 1.0)
    before = dose.tilt
    dose.tick(0.15)
    assert dose.tilt > before
    dose.drive(0.0, 0.3)
    assert dose.playing


def test_the_cup_stops_at_the_largest_tilt_however_late_the_next_command_is() -> None:
    dose = Dose()
    dose.drive(50.0, 0.5, highest=30.0)
    seen = []
    for _ in range(10):  # no command for 0.2 s, at 50° per second
        dose.tick(0.02)
        seen.append(dose.tilt)
    assert max(seen) == pytest.approx(30.0, abs=0.05)
    dose.drive(50.0, 1.0, highest=20.0)  # a tilt above the largest one does not grow, and no order turns it back
    assert dose.tilt == pytest.approx(30.0, abs=0.5)


def test_a_command_may_ask_for_an_earlier_return() -> None:
    dose = Dose()
    dose.drive(50.0, 1.0, highest=30.0)
    for patience in (0.06, 9.0):  # never later than 0.2 s
        dose.order(0.0, 30.0, patience)
        dose.tick(min(patience, 0.2) - 0.02)
        assert dose.tilt > 29.5
        dose.tick(0.15)
        assert dose.tilt < 28.0
        dose.drive(50.0, 0.5, highest=30.0)


def test_range_and_speed_are_limited_whatever_is_written() -> None:
    dose = Dose()
    dose.drive(1e9, 2.0)
    assert dose.tilt == pytest.approx(100.0, abs=0.1)
    assert np.abs(dose.speeds).max() < 1.1 * LIMITS.speed * 1.05
    dose.drive(-1e9, 2.0)
    assert dose.tilt == 0.0
    assert dose.controller.safety.mode is SafetyMode.NORMAL


def test_an_order_to_stop_stops_it_where_it_is() -> None:
    dose = Dose()
    dose.drive(40.0, 1.0)
    dose.controller.registers.input_int[REGISTERS + STOP_ORDER] = NUMBER
    dose.tick(0.3)
    held = dose.joints[-1][5]
    dose.tick(0.5)
    assert dose.joints[-1][5] == pytest.approx(held)
    assert dose.controller.registers.output_int[STATUS] == STOPPED


def test_a_program_that_gets_no_command_at_all_ends_by_itself() -> None:
    dose = Dose()
    dose.tick(5.0)
    assert not dose.playing
    assert np.abs(np.array(dose.joints) - HOME).max() < 1e-3
