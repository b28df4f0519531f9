"""The contract of arm drivers, as tests. The author of a driver derives a class from `ArmContract` and runs pytest::

    class TestMyArm(ArmContract):
        @pytest.fixture
        def bench(self) -> Iterator[ArmBench]:
            spec = MySpec(time_scale=10.0)
            arm = MyArm(spec)
            yield ArmBench(arm, MyKind(spec).plan(SCENE, ACTION), 10.0, true_poses=camera.poses, cut=line.unplug)
            arm.close()

The arm stands at home, holds an empty pourer, and is not connected yet. It moves in most of these tests: use an
emulator first, and stand next to a real arm with a finger on the emergency stop.

Tests for features that a bench lacks are skipped, and pytest shows them. Without `true_poses` the contract reads the
driver's own reports only. It then cannot check that the arm moves at all, that it moves as it reports, that it returns
home, or that it stands still after a stop or a lost connection. Without `disturb` it cannot check that reported poses
are measured, and without `cut` it cannot check a lost connection.
"""

from __future__ import annotations

import itertools
import json
import math
import pickle
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from actors.arm.arm_interface import (
    NEWS_TIMEOUT,
    Arm,
    ArmError,
    ArmLostError,
    ArmNotReleasedError,
    ArmRefusedError,
    ArmState,
    ArmStoppedError,
    Executed,
    PlannedPour,
)
from actors.contract_tests.contract_calls import EVENT_TIMEOUT, Call
from sim_engine.scene import SampledMotion

FloatArray = NDArray[np.float64]

AT_ONCE = 2.0
"""Time limit for calls that return immediately [s]; a fully loaded machine stays well below it."""

CLOSE = math.radians(3.0)
"""Largest difference of a tilt from the planned or independently measured one [rad]."""

NEAR = 5e-3
"""Largest difference of a position from the independently measured one [m]."""

SPEED_MARGIN = 1.25
"""Factor by which a step between two poses may exceed the distance at the stated speed."""

STEP_NOISE, TURN_NOISE = 2e-3, math.radians(1.0)
"""Added to the longest step between two poses, for noise of both readings [m], [rad]."""

REST_TIME = 0.2
"""An arm stands once its true pose has not changed for this time [s of bench time]."""

REST_MOVE, REST_TURN = 5e-4, math.radians(0.3)
"""Changes of a true pose that count as none [m], [rad]."""


@dataclass(frozen=True)
class ArmBench:
    """An arm under test.

    Attributes:
        arm: the driver, not yet connected.
        path: a pour planned from its settings; its tilt takes at least a second of the clock.
        time_scale: bench seconds per second of the clock.
        jog: axis, amount and speed of a permitted step; None: not tested.
        trip: stops the arm from outside, as a protective stop does; None: not tested.
        mend: fixes the effect of `trip`, as far as a person has to.
        true_poses: the independent witness: poses of the pourer measured by another source than the driver, such as the
            joints of an emulator or a camera. Takes a time of its own clock [s of bench time]; returns the times after
            it, shape (T,), increasing up to now, and poses in the world, shape (T, 7): x y z [m] qw qx qy qz. None:
            there is no witness.
        tool_speed: largest speed of the pourer that the arm's settings allow [m/s]; None: that of the path's report.
        tilt_speed: largest angular velocity of the pourer likewise [rad/s].
        disturb: called before a pour's first movement. The arm then executes that pour differently from the command (by
            a brake, another speed or a slipping belt), by more than 5 mm or 3°, and still completes it. None: not
            tested.
        cut: cuts the connection to the arm, by closing its socket or killing the remote process; None: not tested.
        restore: makes connections possible again after `cut`; None: returning home after a loss is not tested.
        lost_within: the longest time from `cut` to the `ArmLostError` of the running call [s of the clock].
        stops_within: the longest time from the call of `stop` to standstill [s of the clock].
    """

    arm: Arm
    path: PlannedPour
    time_scale: float = 1.0
    jog: tuple[str, float, float] | None = None
    trip: Callable[[], object] | None = None
    mend: Callable[[], object] = lambda: None
    true_poses: Callable[[float], tuple[FloatArray, FloatArray]] | None = None
    tool_speed: float | None = None
    tilt_speed: float | None = None
    disturb: Callable[[], object] | None = None
    cut: Callable[[], object] | None = None
    restore: Callable[[], object] | None = None
    lost_within: float = 30.0
    stops_within: float = AT_ONCE


# More than 25 methods: one test for each promise of an arm.
class ArmContract:
    """Derive a test class from this, with a name that begins with Test and a fixture `bench`."""

    # Tests are skipped if the bench lacks a feature, never if the driver does. With a real arm there may be no one to
    # trip it or to pull its plug, and the author must see which tests were skipped. The project's own benches skip as
    # few tests as possible.

    # ---- no motion without consent

    def test_it_says_who_it_is(self, bench: ArmBench) -> None:
        """Records and operators need the identification before the arm may move."""
        facts = bench.arm.connect()
        assert facts.model.strip()
        assert facts.problem == ""
        assert bench.arm.facts().model == facts.model

    def test_nothing_moves_before_somebody_has_released_it(self, bench: ArmBench) -> None:
        """Not after connecting, and not after hands were invited into the cell."""
        bench.arm.connect()
        self._refuses_everything(bench)
        bench.arm.release()
        bench.arm.hands_in()
        self._refuses_everything(bench)
        assert not bench.arm.state().moving

    def test_a_stop_takes_consent_back_also_where_nothing_moves(self, bench: ArmBench) -> None:
        """The stop reports that there was nothing to stop."""
        bench.arm.connect()
        bench.arm.release()
        assert bench.arm.stop() == 0.0
        assert bench.arm.state().stopped
        self._refuses_everything(bench)

    # ---- a pour

    def test_a_whole_pour_is_made_as_planned_and_ends_consent(self, bench: ArmBench) -> None:
        """Approach, pour, return home; the motion as read back is the planned one."""
        executed = self._poured(bench)
        path = bench.path
        assert executed.completed, "execute returned an incomplete pour; a motion that was broken off raises an error"
        times = executed.times
        assert times[0] >= 0.0, f"the first reading is {times[0]:.3f} s before the pour; times count from its begin"
        assert np.all(np.diff(times) > 0.0), "times of the readings do not increase"
        assert times[-1] == pytest.approx(path.pour_time, rel=0.1, abs=0.5), (
            f"the last reading is {times[-1]:.2f} s after the pour's begin; the plan takes {path.pour_time:.2f} s"
        )
        assert executed.poses.shape == (len(times), 7), (
            f"poses have shape {executed.poses.shape}; {len(times)} times need ({len(times)}, 7)"
        )
        self._keeps_to_its_speeds(bench, times, executed.poses, "by the poses that execute reports")
        tilts = SampledMotion(times, executed.poses).tilt(times)
        assert abs(float(tilts.max()) - path.report.tilt) < CLOSE, (
            f"the largest tilt that execute reports is {_deg(tilts.max())}; the plan has {_deg(path.report.tilt)}"
        )
        assert abs(float(tilts[0])) < CLOSE, (
            f"the pour begins at a tilt of {_deg(tilts[0])}; the pourer is upright then"
        )
        self._refuses_everything(bench)

    def test_it_moves_as_it_reports_and_goes_home(self, bench: ArmBench) -> None:
        """The arm's reports agree with an independent witness during a whole cycle, and contain no jumps."""
        self._needs_witness(bench, "whether the arm moves as it reports, without jumps, and gets home")
        bench.arm.connect()
        bench.arm.hands_in()
        home, begin = self._rest(bench), self._true_time(bench)
        bench.arm.release()
        bench.arm.move_to_start(bench.path)
        start, poured = self._rest(bench), self._true_time(bench)
        executed = bench.arm.execute(bench.path)
        during = self._seen(bench, poured)
        bench.arm.retreat(bench.path)
        back = self._rest(bench)
        self._keeps_to_its_speeds(bench, *self._seen(bench, begin), "by the witness")
        self._same(start, executed.poses[0], "before execute the pourer", "the first pose that execute reports")
        self._reports_what_was_seen(executed, during)
        self._same(back, home, "after retreat the pourer", "home, where it was before move_to_start")

    def test_the_poses_it_reports_are_measured(self, bench: ArmBench) -> None:
        """A pour that is executed differently from the command is reported as executed."""
        if bench.disturb is None:
            pytest.skip("ArmBench.disturb is missing; not checked: whether reported poses are measured or commanded")
        before = self._poured(bench)
        self._to_start(bench)
        bench.disturb()
        began = self._true_time(bench)
        executed = bench.arm.execute(bench.path)
        if bench.true_poses is not None:
            seen = self._seen(bench, began)
            way, turned, _ = _apart(before.times, before.poses, *seen)
            assert way > NEAR or turned > CLOSE, (
                f"ArmBench.disturb changed what the witness measured by {1e3 * way:.1f} mm and {_deg(turned)} only; "
                f"it disturbs the pour by more than {1e3 * NEAR:g} mm or {_deg(CLOSE)}"
            )
            self._reports_what_was_seen(executed, seen)
        way, turned, _ = _apart(before.times, before.poses, executed.times, executed.poses)
        assert way > NEAR or turned > CLOSE, (
            "execute reports the same poses for a disturbed pour as for an undisturbed one, to "
            f"{1e3 * way:.1f} mm and {_deg(turned)}: it reports commanded poses; report what the encoders read"
        )

    def test_the_record_of_a_pour_is_small_and_can_be_written_down(self, bench: ArmBench) -> None:
        """The record goes into the journal."""
        assert len(json.dumps(self._poured(bench).record())) < 100_000

    def test_it_pours_again(self, bench: ArmBench) -> None:
        """From home to home, each time after a release."""
        self._poured(bench)
        bench.arm.hands_in()
        self._cycle(bench)

    def test_it_tells_where_it_is_while_it_pours(self, bench: ArmBench) -> None:
        """The state is available at once, with the phase names of the plan."""
        self._to_start(bench)
        pouring = Call(bench.arm.execute, bench.path)
        self._await(bench, lambda: bench.arm.state().moving, "it never moves")
        seen = []
        while pouring.is_alive():
            asked = time.monotonic()
            seen.append(bench.arm.state())
            assert time.monotonic() - asked < AT_ONCE
            time.sleep(0.02)
        assert pouring.ended() is None
        moving = [state for state in seen if state.moving]
        phases = {name for name, _, _ in bench.path.phases}
        strange = {state.phase for state in moving} - phases
        assert not strange, f"state() names the phases {sorted(strange)}; this pour has {sorted(phases)}"
        fractions = [state.fraction for state in moving]
        assert fractions == sorted(fractions), "state().fraction goes back during the pour; it increases from 0 to 1"
        largest = max(state.tilt for state in moving)
        assert largest > 0.3 * bench.path.report.tilt, (
            f"state() shows a tilt of {_deg(largest)} at most; the plan tilts by {_deg(bench.path.report.tilt)}"
        )
        self._states_keep_to_speeds(bench, moving)

    def test_a_dose_keeps_to_its_last_command_by_itself(self, bench: ArmBench) -> None:
        """However late the next command is, the tilt does not pass the largest one, and the cup comes back upright."""
        arm: Any = bench.arm
        if not hasattr(arm, "dose"):
            pytest.skip("it pours no wanted amounts (DosingArm)")
        self._to_start(bench)
        dosing = Call(arm.dose, bench.path, EVENT_TIMEOUT * bench.time_scale)
        self._await(bench, lambda: arm.state().phase == "dose" or not dosing.is_alive(), "no dose begins")
        upright, began = arm.state().tilt, self._true_time(bench)
        highest = upright + 0.3 * bench.path.report.tilt
        end = time.monotonic() + EVENT_TIMEOUT
        # a command that would pass the largest tilt before the arm turns back by itself
        while arm.drive(bench.path.report.tilt_speed, highest, NEWS_TIMEOUT).tilt < highest - CLOSE:
            assert dosing.is_alive(), f"the dose {_ended_with(dosing.ended())} while commands came"
            assert time.monotonic() < end, "the arm does not tilt as drive() says"
        seen = []
        while dosing.is_alive():
            seen.append(arm.state().tilt)
            time.sleep(0.005)
        assert dosing.ended() is None
        if bench.true_poses is not None:
            seen += [_tilt(pose) for pose in self._seen(bench, began)[1]]
            assert _tilt(self._rest(bench)) < upright + CLOSE, "without commands the cup does not come back upright"
        assert max(seen) < highest + CLOSE, (
            f"a dose tilts by {_deg(max(seen))} while no command comes; the last one said {_deg(highest)} at most"
        )

    def test_it_does_one_thing_at_a_time(self, bench: ArmBench) -> None:
        """A second motion is refused, and the first one continues."""
        self._to_start(bench)
        pouring = Call(bench.arm.execute, bench.path)
        self._await(bench, lambda: bench.arm.state().moving, "it never moves")
        with pytest.raises(ArmRefusedError):
            bench.arm.move_to_start(bench.path)
        assert pouring.ended() is None

    # ---- stops

    def test_a_stop_breaks_the_pour_off_and_tells_how_far_it_came(self, bench: ArmBench) -> None:
        """The pourer keeps its pose until the operator releases the motion back to upright."""
        self._to_start(bench)
        began = self._true_time(bench)
        error = self._stopped_by(bench, bench.arm.stop)
        assert error.kind == "operator", f"stop() ended the pour with kind '{error.kind}'; the kind is 'operator'"
        assert 0.0 < error.time < bench.path.pour_time, (
            f"the error puts the stop {error.time:.2f} s after the begin of a pour of {bench.path.pour_time:.2f} s"
        )
        phases = {name for name, _, _ in bench.path.phases}
        assert error.phase in phases, f"the error names the phase '{error.phase}'; this pour has {sorted(phases)}"
        assert error.tilt > 0.0, "the error reports an upright pourer; it was stopped while it tilted"
        if error.executed is not None:
            assert not error.executed.completed, "the stopped pour is reported as completed"
        state = bench.arm.state()
        assert state.stopped, "state().stopped is False after stop()"
        assert not state.moving, "state() shows a moving arm after stop()"
        self._refuses_everything(bench)
        if bench.true_poses is not None:
            left = _tilt(self._rest(bench))
            assert abs(left - error.tilt) < CLOSE, (
                f"the error reports a tilt of {_deg(error.tilt)} after stop(); the witness measures {_deg(left)}"
            )
            if error.executed is not None and len(error.executed.times) > 1:
                self._reports_what_was_seen(error.executed, self._seen(bench, began))

    def test_it_stands_soon_after_a_stop(self, bench: ArmBench) -> None:
        """The call returns when the arm stands, in the stated time."""
        self._tilting(bench)
        asked, begun = time.monotonic(), self._true_time(bench)
        took = bench.arm.stop()
        returned, ended = time.monotonic() - asked, self._true_time(bench)
        most = bench.stops_within
        assert took < most, f"stop() reports {took:.2f} s to standstill; {most:g} s are stated (ArmBench.stops_within)"
        assert returned < 2.0 * most, f"stop() returned after {returned:.2f} s; {most:g} s are stated"
        assert not bench.arm.state().moving
        if bench.true_poses is not None:
            left = self._rest(bench)
            times, poses = self._seen(bench, begun)
            ways, turns = _differences(poses, left[None])
            moved = times[(ways > REST_MOVE) | (turns > REST_TURN)]
            late = float(moved[-1] - ended) if len(moved) else 0.0
            assert late <= 0.0, (
                f"by the witness the pourer still moved {late:.2f} s (bench time) after stop() had returned; stop() "
                "returns once the arm stands"
            )

    def test_after_a_stop_it_comes_upright_goes_home_and_pours_again(self, bench: ArmBench) -> None:
        """Each motion needs a release."""
        home = self._home(bench)
        self._broken_off(bench, bench.arm.stop)
        self._brought_home(bench, home)
        bench.arm.hands_in()
        self._cycle(bench)

    def test_what_stops_it_from_outside_is_told_and_mended(self, bench: ArmBench) -> None:
        """The stop was not ordered; the arm recovers after its cause is fixed."""
        if bench.trip is None:
            pytest.skip("nothing stops this arm from outside")
        home = self._home(bench)
        error = self._broken_off(bench, bench.trip)
        assert error.kind != "operator", "the error names the operator; something else stopped the arm"
        bench.mend()
        self._brought_home(bench, home)

    # ---- a lost connection

    def test_a_connection_lost_during_a_pour_is_an_error_and_the_arm_stands(self, bench: ArmBench) -> None:
        """The running call ends within the stated time; consent ends; after a new connection the arm returns home."""
        if bench.cut is None:
            pytest.skip("ArmBench.cut is missing; not checked: what happens when the connection is lost")
        home = self._home(bench)
        pouring = self._tilting(bench)
        bench.cut()
        self._lost(bench, pouring, "execute")
        assert not bench.arm.state().moving, "state() shows a moving arm after its connection was lost"
        self._refuses_everything(bench, ArmError)
        if bench.true_poses is not None:
            left = _tilt(self._rest(bench))
            assert left > CLOSE, (
                f"the pourer went on to a tilt of {_deg(left)} after the connection was cut; it stands where it was"
            )
        bench.arm.release()
        self._lost(bench, Call(bench.arm.untilt, bench.path), "untilt, after release() without a connection,")
        if bench.restore is not None:
            bench.restore()
            self._refuses_everything(bench, ArmError)  # the loss ended the consent, not `connect`
            bench.arm.connect()
            self._refuses_everything(bench)
            self._brought_home(bench, home)

    def test_a_connection_lost_at_rest_is_an_error_of_the_next_call(self, bench: ArmBench) -> None:
        """No call reports success over a cut connection."""
        if bench.cut is None:
            pytest.skip("ArmBench.cut is missing; not checked: what happens when the connection is lost")
        bench.arm.connect()
        bench.arm.hands_in()
        bench.cut()
        self._lost(bench, Call(bench.arm.facts), "facts")
        bench.arm.release()
        self._lost(bench, Call(bench.arm.move_to_start, bench.path), "move_to_start")
        assert not bench.arm.state().moving, "state() shows a moving arm after its connection was lost"
        bench.arm.close()

    def test_errors_and_answers_travel_between_processes(self, bench: ArmBench) -> None:
        """The driver runs in another process than the campaign."""
        error = self._broken_off(bench, bench.arm.stop)
        again = pickle.loads(pickle.dumps(error))
        assert (str(again), again.kind, again.phase, again.tilt) == (str(error), error.kind, error.phase, error.tilt)
        for value in (bench.path, bench.arm.state()):
            pickle.loads(pickle.dumps(value))

    # ---- jogging, and the end

    def test_a_step_by_hand_needs_a_word_each(self, bench: ArmBench) -> None:
        """Each step needs a release, and the arm reports its pose."""
        if bench.jog is None:
            pytest.skip("this arm makes no steps")
        bench.arm.connect()
        axis, amount, speed = bench.jog
        with pytest.raises(ArmNotReleasedError):
            bench.arm.jog(axis, amount, speed)
        before = bench.arm.where()
        bench.arm.release()
        bench.arm.jog(axis, amount, speed)
        after = bench.arm.where()
        assert before.tool != after.tool
        with pytest.raises(ArmNotReleasedError):
            bench.arm.jog(axis, -amount, speed)
        bench.arm.release()
        with pytest.raises(ArmRefusedError):
            bench.arm.jog(axis, 1e3, speed)

    def test_it_is_let_go_of_twice_without_harm(self, bench: ArmBench) -> None:
        """Several parts of a bench may close the arm."""
        bench.arm.connect()
        bench.arm.close()
        bench.arm.close()

    # ---- helpers

    def _refuses_everything(self, bench: ArmBench, with_error: type[Exception] = ArmNotReleasedError) -> None:
        for motion in (bench.arm.move_to_start, bench.arm.execute, bench.arm.retreat):
            error = Call(motion, bench.path).ended()
            assert isinstance(error, with_error), (
                f"{motion.__name__} {_ended_with(error)} without consent; it raises {with_error.__name__} before "
                "anything moves"
            )

    def _to_start(self, bench: ArmBench) -> None:
        bench.arm.connect()
        bench.arm.hands_in()
        bench.arm.release()
        bench.arm.move_to_start(bench.path)

    def _cycle(self, bench: ArmBench) -> Executed:
        bench.arm.release()
        bench.arm.move_to_start(bench.path)
        executed = bench.arm.execute(bench.path)
        bench.arm.retreat(bench.path)
        return executed

    def _poured(self, bench: ArmBench) -> Executed:
        bench.arm.connect()
        bench.arm.hands_in()
        return self._cycle(bench)

    def _tilting(self, bench: ArmBench) -> Call:
        self._to_start(bench)
        return self._tilts(bench)

    def _tilts(self, bench: ArmBench) -> Call:
        pouring = Call(bench.arm.execute, bench.path)
        least = 0.1 * bench.path.report.tilt
        self._await(bench, lambda: bench.arm.state().moving and bench.arm.state().tilt > least, "it never tilts")
        return pouring

    def _broken_off(self, bench: ArmBench, stop: Callable[[], object]) -> ArmStoppedError:
        self._to_start(bench)
        return self._stopped_by(bench, stop)

    def _stopped_by(self, bench: ArmBench, stop: Callable[[], object]) -> ArmStoppedError:
        pouring = self._tilts(bench)
        stop()
        error = pouring.ended()
        assert isinstance(error, ArmStoppedError), (
            f"execute {_ended_with(error)} after the arm was stopped; it raises ArmStoppedError"
        )
        return error

    def _lost(self, bench: ArmBench, call: Call, name: str) -> None:
        call.join(bench.lost_within)
        assert not call.is_alive(), (
            f"{name} still waits {bench.lost_within:g} s after the connection was cut (ArmBench.lost_within); "
            "it raises ArmLostError in that time"
        )
        assert isinstance(call.error, ArmLostError), (
            f"{name} {_ended_with(call.error)} although the connection was cut; it raises ArmLostError"
        )

    def _brought_home(self, bench: ArmBench, home: FloatArray | None) -> None:
        bench.arm.release()
        bench.arm.recover()
        with pytest.raises(ArmNotReleasedError):
            bench.arm.untilt(bench.path)
        tilt = bench.arm.state().tilt if home is None else _tilt(self._rest(bench))
        bench.arm.release()
        began = self._true_time(bench)
        states = self._watched(bench, bench.arm.untilt)
        left = bench.arm.state().tilt
        assert abs(left) < CLOSE, f"state() shows a tilt of {_deg(left)} after untilt; the pourer is upright then"
        if home is not None:
            left = _tilt(self._rest(bench))
            assert abs(left) < CLOSE, (
                f"untilt returned and the witness measures a tilt of {_deg(left)}, {_deg(tilt)} before it; "
                "untilt returns once the pourer is upright"
            )
        elif tilt > CLOSE:
            assert any(0.1 * tilt < state.tilt < 0.9 * tilt for state in states), (
                f"untilt went from {_deg(tilt)} to {_deg(left)} without a tilt between them in state(); "
                "it turns the pourer upright at a finite speed"
            )
        bench.arm.release()
        states = self._watched(bench, bench.arm.retreat)
        if home is not None:
            self._same(self._rest(bench), home, "after retreat the pourer", "home, where it was before move_to_start")
            self._keeps_to_its_speeds(bench, *self._seen(bench, began), "on the way home, by the witness")
        elif bench.path.retreat_time > 0.0:
            assert states, (
                f"retreat returned and state() never showed it moving; the plan takes {bench.path.retreat_time:.1f} s"
            )

    def _watched(self, bench: ArmBench, motion: Callable[[Any], object]) -> list[ArmState]:
        """Run a motion; return the states during it."""
        going, seen = Call(motion, bench.path), []
        while going.is_alive():
            state = bench.arm.state()
            if state.moving:
                seen.append(state)
            time.sleep(0.005)
        error = going.ended()
        if error is not None:
            raise error
        return seen

    # ---- the witness

    @staticmethod
    def _needs_witness(bench: ArmBench, unchecked: str) -> None:
        if bench.true_poses is None:
            pytest.skip(f"ArmBench.true_poses is missing; not checked: {unchecked}")

    def _home(self, bench: ArmBench) -> FloatArray | None:
        """True pose of the pourer before the first motion, shape (7,); None without a witness."""
        return None if bench.true_poses is None else self._rest(bench)

    @staticmethod
    def _seen(bench: ArmBench, since: float) -> tuple[FloatArray, FloatArray]:
        assert bench.true_poses is not None
        times, poses = bench.true_poses(since)
        assert len(times) > 1, "ArmBench.true_poses has fewer than two measurements of a motion"
        return times, poses

    @staticmethod
    def _true_time(bench: ArmBench) -> float:
        """Now, by the clock of the witness [s]; 0 without one. Waits for its first measurement."""
        if bench.true_poses is None:
            return 0.0
        end = time.monotonic() + EVENT_TIMEOUT
        while not len(times := bench.true_poses(-math.inf)[0]):
            assert time.monotonic() < end, f"ArmBench.true_poses has had no measurement for {EVENT_TIMEOUT:g} s"
        return float(times[-1])

    def _rest(self, bench: ArmBench) -> FloatArray:
        """Wait until the arm truly stands; return the pose of the pourer, shape (7,)."""
        assert bench.true_poses is not None
        since, end = self._true_time(bench), time.monotonic() + EVENT_TIMEOUT
        while True:
            times, poses = bench.true_poses(since)
            if len(times) and times[-1] - since >= REST_TIME:
                lately = poses[times >= times[-1] - REST_TIME]
                ways, turns = _differences(lately, poses[-1:])
                if ways.max() < REST_MOVE and turns.max() < REST_TURN:
                    return np.asarray(poses[-1])
                since = float(times[-1]) - REST_TIME
            assert time.monotonic() < end, (
                f"by the witness the arm has moved for {EVENT_TIMEOUT:g} s in which it should have come to rest"
            )
            time.sleep(0.01)

    @staticmethod
    def _same(pose: FloatArray, wanted: FloatArray, what: str, where: str) -> None:
        ways, turns = _differences(pose[None], wanted[None])
        assert max(ways[0] / NEAR, turns[0] / CLOSE) < 1.0, (
            f"{what} is {1e3 * ways[0]:.1f} mm and {_deg(turns[0])} away from {where}; "
            f"at most {1e3 * NEAR:g} mm and {_deg(CLOSE)} are allowed"
        )

    @staticmethod
    def _reports_what_was_seen(executed: Executed, seen: tuple[FloatArray, FloatArray]) -> None:
        way, turned, when = _apart(executed.times, executed.poses, *seen)
        assert max(way / NEAR, turned / CLOSE) < 1.0, (
            f"{when:.2f} s after the pour's begin the pose that execute reports is {1e3 * way:.1f} mm and "
            f"{_deg(turned)} away from where the witness measured the pourer; report measured poses, not commanded "
            f"ones (at most {1e3 * NEAR:g} mm and {_deg(CLOSE)} are allowed)"
        )

    # ---- speeds

    @staticmethod
    def _limits(bench: ArmBench) -> tuple[float, float]:
        report = bench.path.report
        return (
            report.tool_speed if bench.tool_speed is None else bench.tool_speed,
            report.tilt_speed if bench.tilt_speed is None else bench.tilt_speed,
        )

    def _keeps_to_its_speeds(self, bench: ArmBench, times: FloatArray, poses: FloatArray, source: str) -> None:
        """Check that no step between two poses is longer than the stated speeds allow."""
        tool_speed, tilt_speed = self._limits(bench)
        ways, turns = _differences(poses[1:], poses[:-1])
        took = np.diff(times)
        for name, steps, speed, noise in (
            ("moved", ways, tool_speed, STEP_NOISE),
            ("turned", turns, tilt_speed, TURN_NOISE),
        ):
            allowed = SPEED_MARGIN * speed * took + noise
            worst = int(np.argmax(steps - allowed))
            assert steps[worst] <= allowed[worst], (
                f"{source}, the pourer {name} by {_shown(name, steps[worst])} in {1e3 * took[worst]:.0f} ms, "
                f"{times[worst] - times[0]:.2f} s after the begin: that is a jump; at the stated "
                f"{_shown(name, speed)}/s it is at most {_shown(name, allowed[worst])}"
            )

    def _states_keep_to_speeds(self, bench: ArmBench, states: Sequence[ArmState]) -> None:
        tool_speed, tilt_speed = self._limits(bench)
        for a, b in itertools.pairwise(states):
            took = b.time - a.time
            allowed = SPEED_MARGIN * tilt_speed * took + TURN_NOISE
            assert abs(b.tilt - a.tilt) <= allowed, (
                f"state().tilt goes from {_deg(a.tilt)} to {_deg(b.tilt)} in {1e3 * took:.0f} ms, {a.time:.2f} s after "
                f"the begin: that is a jump; at the stated {_deg(tilt_speed)}/s it changes by {_deg(allowed)} at most"
            )
            if len(a.pourer) >= 3 and len(b.pourer) >= 3:
                way, most = math.dist(a.pourer[:3], b.pourer[:3]), SPEED_MARGIN * tool_speed * took + STEP_NOISE
                assert way <= most, (
                    f"state().pourer moves by {1e3 * way:.0f} mm in {1e3 * took:.0f} ms, {a.time:.2f} s after the "
                    f"begin: that is a jump; at the stated {1e3 * tool_speed:.0f} mm/s it moves by {1e3 * most:.0f} mm "
                    "at most"
                )

    @staticmethod
    def _await(bench: ArmBench, condition: Callable[[], bool], otherwise: str) -> None:
        end = time.monotonic() + EVENT_TIMEOUT
        while not condition():
            assert time.monotonic() < end, otherwise
            time.sleep(0.005)


def _differences(a: FloatArray, b: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Distances [m] and angles [rad] between poses (T, 7) and (T, 7) or (1, 7), both of shape (T,)."""
    ways: FloatArray = np.linalg.norm(a[:, :3] - b[:, :3], axis=-1)
    cosines = np.abs(np.sum(a[:, 3:] * b[:, 3:], axis=-1))
    turns: FloatArray = 2.0 * np.arccos(np.clip(cosines, 0.0, 1.0))
    return ways, turns


def _apart(
    times: FloatArray, poses: FloatArray, other_times: FloatArray, other_poses: FloatArray
) -> tuple[float, float, float]:
    """Largest difference between two motions whose clocks differ by an unknown shift.

    Returns:
        Distance [m], angle [rad] and time [s] of the largest difference, for the shift with the smallest differences.
    """
    other = SampledMotion(other_times, other_poses)

    def differences(shift: float) -> tuple[FloatArray, FloatArray, FloatArray]:
        ways, turns = _differences(poses, other.sample(times + shift))
        return ways, turns, np.maximum(ways / NEAR, turns / CLOSE)

    low = float(other_times[0]) - 1.0
    high = max(float(other_times[-1] - times[-1]), float(other_times[0])) + 1.0
    for _ in range(4):
        shifts = np.linspace(low, high, 101)
        best = int(np.argmin([float(np.mean(differences(shift)[2] ** 2)) for shift in shifts]))
        low, high = float(shifts[max(best - 1, 0)]), float(shifts[min(best + 1, 100)])
    ways, turns, both = differences(0.5 * (low + high))
    worst = int(np.argmax(both))
    return float(ways[worst]), float(turns[worst]), float(times[worst])


def _tilt(pose: FloatArray) -> float:
    """Tilt of a pose (7,) from upright [rad]."""
    _, x, y, _ = pose[3:] / np.linalg.norm(pose[3:])
    return math.acos(float(np.clip(1.0 - 2.0 * (x * x + y * y), -1.0, 1.0)))


def _ended_with(error: Exception | None) -> str:
    return "returned as if all were well" if error is None else f"raised {type(error).__name__} ({error})"


def _deg(angle: float) -> str:
    return f"{math.degrees(angle):.1f}°"


def _shown(name: str, value: float) -> str:
    return _deg(value) if name == "turned" else f"{1e3 * value:.0f} mm"
