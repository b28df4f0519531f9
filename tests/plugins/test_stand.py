"""The example's arm does what every arm has to do, and the contract finds arms that do not."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from decant.plugins import (
    Action,
    ArmLostError,
    ArmStoppedError,
    ExecutedMotion,
    InvalidActionError,
    Liquid,
    MotionPath,
    Scene,
    cylinder,
)
from decant.plugins.testing import ArmBench, ArmContract
from tests.plugins.decant_example.arm import Drive, Stand, StandKind, StandSettings, poses_of

DEG = math.pi / 180.0

SCENE = Scene(
    name="tumbler",
    pourer=cylinder("beaker", inner_radius=0.035, inner_height=0.1),
    receiver=cylinder("tumbler", inner_radius=0.04, inner_height=0.1),
    liquid=Liquid(mass=0.2),
)
ACTION = Action(angular_velocity=60 * DEG, x_offset=0.09, height=0.05, max_angle=100 * DEG, hold_time=0.5)


def bench_of(cls: type[Stand], *, witness: bool = True, time_scale: float = 4.0) -> ArmBench:
    """A stand on its bench: its drive is the witness, its cable is cut, its belt slips."""
    spec = StandSettings(time_scale=time_scale)
    drive = Drive(time_scale)
    path = StandKind(spec).plan(SCENE, ACTION)

    def true_poses(since: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        drive.tick()
        seen = np.array([reading for reading in drive.readings if reading[0] > since])
        return seen[:, 0], poses_of(path, seen[:, 1], seen[:, 2])

    def plug(plugged: bool) -> None:
        drive.plugged = plugged

    return ArmBench(
        cls(spec, drive),
        path,
        time_scale,
        jog=("z", 0.005, 0.05),
        true_poses=true_poses if witness else None,
        tool_speed=0.5,
        tilt_speed=spec.fastest,
        disturb=lambda: setattr(drive, "slip", 0.2),
        cut=lambda: plug(False),
        restore=lambda: plug(True),
        lost_within=5.0,
    )


class TestStand(ArmContract):
    @pytest.fixture
    def bench(self) -> Iterator[ArmBench]:
        bench = bench_of(Stand, time_scale=2.0)
        yield bench
        bench.arm.close()


def test_a_pour_too_fast_for_the_motor_is_refused_with_the_key_that_allows_it() -> None:
    with pytest.raises(InvalidActionError, match=r"30 deg/s \(arm.fastest\), 90 deg/s are asked for"):
        StandKind(StandSettings(fastest=30 * DEG)).plan(SCENE, ACTION)


# -- arms that the contract finds --------------------------------------------------------------------------------------


class JumpsInThePour(Stand):
    """The slide falls by 207 mm within a pour, and says so."""

    def _turn(self, duration, phase, tilt, height):  # type: ignore[no-untyped-def]
        if phase(0.0) != "tilt":
            return super()._turn(duration, phase, tilt, height)
        return super()._turn(duration, phase, tilt, lambda t: height(t) - (0.207 if t > 0.5 * duration else 0.0))


class JumpsOnTheWay(Stand):
    """The slide jumps by 207 mm and back on the way to the pour, of which no report is made."""

    def _turn(self, duration, phase, tilt, height):  # type: ignore[no-untyped-def]
        if phase(0.0) != "approach":
            return super()._turn(duration, phase, tilt, height)

        def jumping(t: float) -> float:
            return height(t) + (0.207 if 0.3 * duration < t < 0.7 * duration else 0.0)

        return super()._turn(duration, phase, tilt, jumping)


class UntiltsOnPaper(Stand):
    """Reports an upright pourer without turning it."""

    def untilt(self, path: MotionPath | None = None) -> None:
        self._consent()
        self._free = False
        self._state = replace(self._state, tilt=0.0)


class StaysAtThePour(Stand):
    """Returns from retreat without moving."""

    def retreat(self, path: MotionPath) -> None:
        self._consent()
        self._free = False


class ReportsThePlan(Stand):
    """Reports the poses that it was commanded."""

    def execute(self, path: MotionPath) -> ExecutedMotion:
        done = super().execute(path)
        return replace(done, poses=path.poses(done.times))


class ReportsThePlanWhenStopped(Stand):
    """Reports a stopped pour as if it had been made to its end."""

    def execute(self, path: MotionPath) -> ExecutedMotion:
        try:
            return super().execute(path)
        except ArmStoppedError as error:
            times = np.linspace(0.0, path.pour_time, 200)
            done = ExecutedMotion(times, path.poses(times), completed=False)
            raise ArmStoppedError(error.text, error.kind, error.phase, error.time, error.tilt, done) from None


class PoursOnPaper(Stand):
    """Pretends that a pour whose connection was cut went on to its end."""

    def execute(self, path: MotionPath) -> ExecutedMotion:
        try:
            return super().execute(path)
        except ArmLostError:
            times = np.linspace(0.0, path.pour_time, 200)
            return ExecutedMotion(times, path.poses(times), completed=True)


class WaitsForItsCable(Stand):
    """Waits until the connection is back."""

    def execute(self, path: MotionPath) -> ExecutedMotion:
        try:
            return super().execute(path)
        except ArmLostError:
            while not self._drive.plugged and not self._halt.wait(0.02):
                pass
            raise


class CallsALossAStop(Stand):
    """Takes a lost connection for a stop by the operator."""

    def execute(self, path: MotionPath) -> ExecutedMotion:
        try:
            return super().execute(path)
        except ArmLostError:
            raise ArmStoppedError("stopped", "operator", "tilt", 0.5, 0.1) from None


class NeedsNoCable(Stand):
    """Moves to the start over a line that is cut."""

    def facts(self):  # type: ignore[no-untyped-def]
        plugged, self._drive.plugged = self._drive.plugged, True
        try:
            return super().facts()
        finally:
            self._drive.plugged = plugged


class RunsOn(Stand):
    """Raises the right error, while what it moves goes on to the end."""

    def execute(self, path: MotionPath) -> ExecutedMotion:
        try:
            return super().execute(path)
        except ArmLostError:
            self._drive.plugged = True
            begun, tilt = self._drive.read()[:2]
            while tilt > 0.0:
                now, _, height = self._drive.read()
                tilt = max(tilt - 0.5 * self._spec.fastest * (now - begun), 0.0)
                begun = now
                self._drive.go(tilt, height)
                time.sleep(0.002)
            self._drive.plugged = False
            raise


class KeepsConsent(Stand):
    """Consent outlives a lost connection."""

    def _lost(self, error: ConnectionError) -> ArmLostError:
        lost = super()._lost(error)
        self._free = True
        return lost


class Coasts(Stand):
    """Returns from stop while what it moves goes on for 0.2 s."""

    def stop(self) -> float:
        took = super().stop()
        if took > 0.0:
            threading.Thread(target=self._coast, daemon=True).start()
        return took

    def _coast(self) -> None:
        begun, tilt, height = self._drive.read()
        while (now := self._drive.read()[0]) < begun + 0.2 * self._spec.time_scale:
            self._drive.go(tilt + 0.5 * (now - begun), height)
            time.sleep(0.002)


pytestmark = pytest.mark.realtime
"""The stand turns by the clock: a machine that stalls for a whole tilt has neither seen it nor a jump in it."""

WHOLE = "test_a_whole_pour_is_made_as_planned_and_ends_consent"
AS_REPORTED = "test_it_moves_as_it_reports_and_goes_home"
MEASURED = "test_the_poses_it_reports_are_measured"
AFTER_A_STOP = "test_after_a_stop_it_comes_upright_goes_home_and_pours_again"
BROKEN_OFF = "test_a_stop_breaks_the_pour_off_and_tells_how_far_it_came"
STANDS = "test_it_stands_soon_after_a_stop"
LOST = "test_a_connection_lost_during_a_pour_is_an_error_and_the_arm_stands"
LOST_AT_REST = "test_a_connection_lost_at_rest_is_an_error_of_the_next_call"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("cls", "witness", "found_by", "message"),
    [
        (JumpsInThePour, False, WHOLE, r"moved by 2\d\d mm in \d+ ms, \d.\d\d s after the begin: that is a jump"),
        (JumpsInThePour, True, AS_REPORTED, r"by the witness, the pourer moved by 2\d\d mm"),
        (JumpsOnTheWay, True, AS_REPORTED, r"by the witness, the pourer moved by (19|20|21)\d mm"),
        (UntiltsOnPaper, True, AFTER_A_STOP, r"untilt returned and the witness measures a tilt of \d\d"),
        (UntiltsOnPaper, False, AFTER_A_STOP, r"without a tilt between them in state\(\)"),
        (StaysAtThePour, True, AFTER_A_STOP, r"after retreat the pourer is 50.0 mm and 0.0° away from home"),
        (StaysAtThePour, True, AS_REPORTED, r"after retreat the pourer is 50.0 mm and 0.0° away from home"),
        (StaysAtThePour, False, AFTER_A_STOP, r"state\(\) never showed it moving; the plan takes 1.0 s"),
        (ReportsThePlan, True, MEASURED, r"away from where the witness measured the pourer; report measured poses"),
        (ReportsThePlan, False, MEASURED, r"the same poses for a disturbed pour .* it reports commanded poses"),
        (ReportsThePlanWhenStopped, True, BROKEN_OFF, r"away from where the witness measured the pourer"),
        (Coasts, True, STANDS, r"by the witness the pourer still moved 0\.\d\d s .* after stop\(\) had returned"),
        (PoursOnPaper, True, LOST, r"execute returned as if all were well although the connection was cut"),
        (PoursOnPaper, False, LOST, r"execute returned as if all were well although the connection was cut"),
        (WaitsForItsCable, False, LOST, r"execute still waits 5 s after the connection was cut"),
        (CallsALossAStop, False, LOST, r"execute raised ArmStoppedError \(stopped\) although the connection was cut"),
        (NeedsNoCable, False, LOST_AT_REST, r"facts returned as if all were well although the connection was cut"),
        (KeepsConsent, True, LOST, r"move_to_start returned as if all were well without consent"),
        (RunsOn, True, LOST, r"the pourer went on to a tilt of 0.0° after the connection was cut"),
    ],
)
def test_an_arm_that_does_not_do_what_it_reports_is_found(
    cls: type[Stand], witness: bool, found_by: str, message: str
) -> None:
    bench = bench_of(cls, witness=witness)
    try:
        with pytest.raises(AssertionError, match=message):
            getattr(ArmContract(), found_by)(bench)
    finally:
        bench.arm.close()


def test_without_a_witness_the_contract_names_what_it_does_not_check() -> None:
    bench = replace(bench_of(Stand, witness=False), disturb=None, cut=None)
    for name, unchecked in [
        (AS_REPORTED, "true_poses is missing; not checked: whether the arm moves as it reports"),
        (MEASURED, "disturb is missing; not checked: whether reported poses are measured"),
        (LOST, "cut is missing; not checked: what happens when the connection is lost"),
        (LOST_AT_REST, "cut is missing; not checked: what happens when the connection is lost"),
    ]:
        with pytest.raises(pytest.skip.Exception, match=unchecked):
            getattr(ArmContract(), name)(bench)
