"""What every arm has to do, as tests. A driver's author derives a class from `ArmContract` and runs pytest.

    class TestMyArm(ArmContract):
        @pytest.fixture
        def bench(self) -> Iterator[ArmBench]:
            spec = MySpec(time_scale=10.0)
            arm = MyArm(spec)
            yield ArmBench(arm, spec.plan(SCENE, ACTION), time_scale=10.0)
            arm.close()

The arm stands at home, holds an empty pourer, and has not been connected. It moves in most of these tests: try a
stand-in first, and stand beside a real one with a finger on the emergency stop. What a bench lacks (`jog`, `trip`) is
left out, and pytest says what was skipped.
"""

from __future__ import annotations

import json
import math
import pickle
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

from actors.arm.errors import ArmNotReleasedError, ArmRefusedError, ArmStoppedError
from actors.arm.protocol import Arm, Executed, PlannedPour
from sim_engine.sampled_motion import SampledMotion

AT_ONCE = 2.0
"""Longest time that an answer may take which should come at once [s]; a starved machine needs a part of it."""

PATIENCE = 60.0
"""After which something that should have happened has not [s]."""

CLOSE = math.radians(3.0)
"""How far a tilt may be from the one that was planned [rad]."""


@dataclass(frozen=True)
class ArmBench:
    """An arm to be tried.

    Attributes:
        arm: the driver, not yet connected.
        path: a pour that its settings have planned; its tilt lasts a second of the clock or more.
        time_scale: bench seconds per second of the clock.
        jog: axis, amount and speed of a step that it may make; None: not to be tried.
        trip: has something stop the arm that nobody ordered, as a protective stop would; None: not to be tried.
        mend: puts right what `trip` did, as far as a person has to.
    """

    arm: Arm
    path: PlannedPour
    time_scale: float = 1.0
    jog: tuple[str, float, float] | None = None
    trip: Callable[[], object] | None = None
    mend: Callable[[], object] = lambda: None


class Call(threading.Thread):
    """A blocking call that goes on in a thread."""

    def __init__(self, call: Callable[..., Any], *arguments: Any) -> None:
        super().__init__(daemon=True)
        self._call, self._arguments = call, arguments
        self.value: Any = None
        self.error: Exception | None = None
        self.start()

    def run(self) -> None:
        """See `threading.Thread.run`."""
        try:
            self.value = self._call(*self._arguments)
        except Exception as error:
            self.error = error

    def ended(self) -> Exception | None:
        """Wait for its end; what it raised."""
        self.join(PATIENCE)
        assert not self.is_alive(), "the motion does not come back"
        return self.error


class ArmContract:
    """Derive from this, in a class whose name begins with Test, with a fixture `bench`."""

    # Tests are skipped for what a bench can't do, never for what a driver can't: beside a real one nobody may be there
    # who trips it or pulls its plug, and its author is to see what was not tried. Ours leave out as little as they can.

    # ---- nothing moves without consent

    def test_it_says_who_it_is(self, bench: ArmBench) -> None:
        """People read it in records, and before they arm it."""
        facts = bench.arm.connect()
        assert facts.model.strip()
        assert facts.problem == ""
        assert bench.arm.facts().model == facts.model

    def test_nothing_moves_before_somebody_has_released_it(self, bench: ArmBench) -> None:
        """Neither after connecting nor after hands were invited in."""
        bench.arm.connect()
        self._refuses_everything(bench)
        bench.arm.release()
        bench.arm.hands_in()
        self._refuses_everything(bench)
        assert not bench.arm.state().moving

    def test_a_stop_takes_consent_back_also_where_nothing_moves(self, bench: ArmBench) -> None:
        """And says that there was nothing to stop."""
        bench.arm.connect()
        bench.arm.release()
        assert bench.arm.stop() == 0.0
        assert bench.arm.state().stopped
        self._refuses_everything(bench)

    # ---- a pour

    def test_a_whole_pour_is_made_as_planned_and_ends_consent(self, bench: ArmBench) -> None:
        """Out, pour, home; what the arm read back is the motion that was planned."""
        executed = self._poured(bench)
        path = bench.path
        assert executed.completed
        times = executed.times
        assert times[0] >= 0.0
        assert np.all(np.diff(times) > 0.0)
        assert times[-1] == pytest.approx(path.pour_time, rel=0.1, abs=0.5)
        assert executed.poses.shape == (len(times), 7)
        tilts = SampledMotion(times, executed.poses).tilt(times)
        assert abs(float(tilts.max()) - path.report.tilt) < CLOSE
        assert abs(float(tilts[0])) < CLOSE
        self._refuses_everything(bench)

    def test_the_record_of_a_pour_is_small_and_can_be_written_down(self, bench: ArmBench) -> None:
        """It goes into the journal."""
        assert len(json.dumps(self._poured(bench).record())) < 100_000

    def test_it_pours_again(self, bench: ArmBench) -> None:
        """From home to home, as often as somebody lets it."""
        self._poured(bench)
        bench.arm.hands_in()
        self._cycle(bench)

    def test_it_tells_where_it_is_while_it_pours(self, bench: ArmBench) -> None:
        """At once, in the plan's own words."""
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
        assert {state.phase for state in moving} <= {name for name, _, _ in bench.path.phases}
        assert [state.fraction for state in moving] == sorted(state.fraction for state in moving)
        assert max(state.tilt for state in moving) > 0.3 * bench.path.report.tilt

    def test_it_does_one_thing_at_a_time(self, bench: ArmBench) -> None:
        """A second motion is refused, and the first one goes on."""
        self._to_start(bench)
        pouring = Call(bench.arm.execute, bench.path)
        self._await(bench, lambda: bench.arm.state().moving, "it never moves")
        with pytest.raises(ArmRefusedError):
            bench.arm.move_to_start(bench.path)
        assert pouring.ended() is None

    # ---- stops

    def test_a_stop_breaks_the_pour_off_and_tells_how_far_it_came(self, bench: ArmBench) -> None:
        """The pourer stays where it is until somebody has it brought upright."""
        error = self._broken_off(bench, bench.arm.stop)
        assert error.kind == "operator"
        assert 0.0 < error.time < bench.path.pour_time
        assert error.phase in {name for name, _, _ in bench.path.phases}
        assert error.tilt > 0.0
        if error.executed is not None:
            assert not error.executed.completed
        state = bench.arm.state()
        assert state.stopped
        assert not state.moving
        self._refuses_everything(bench)

    def test_it_stands_soon_after_a_stop(self, bench: ArmBench) -> None:
        """The call comes back when the arm stands."""
        self._tilting(bench)
        asked = time.monotonic()
        assert bench.arm.stop() < AT_ONCE
        assert time.monotonic() - asked < 2.0 * AT_ONCE
        assert not bench.arm.state().moving

    def test_after_a_stop_it_comes_upright_goes_home_and_pours_again(self, bench: ArmBench) -> None:
        """Each of it after somebody's word."""
        self._broken_off(bench, bench.arm.stop)
        self._brought_home(bench)
        bench.arm.hands_in()
        self._cycle(bench)

    def test_what_stops_it_from_outside_is_told_and_mended(self, bench: ArmBench) -> None:
        """Nobody here ordered it; the arm recovers when its cause was seen to."""
        if bench.trip is None:
            pytest.skip("nothing stops this arm from outside")
        error = self._broken_off(bench, bench.trip)
        assert error.kind != "operator"
        bench.mend()
        self._brought_home(bench)

    def test_errors_and_answers_travel_between_processes(self, bench: ArmBench) -> None:
        """The driver's process is not the campaign's."""
        error = self._broken_off(bench, bench.arm.stop)
        again = pickle.loads(pickle.dumps(error))
        assert (str(again), again.kind, again.phase, again.tilt) == (str(error), error.kind, error.phase, error.tilt)
        for value in (bench.path, bench.arm.state()):
            pickle.loads(pickle.dumps(value))

    # ---- by hand, and the end

    def test_a_step_by_hand_needs_a_word_each(self, bench: ArmBench) -> None:
        """And the arm says where it stands."""
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
        """Whoever ends a bench closes everything."""
        bench.arm.connect()
        bench.arm.close()
        bench.arm.close()

    # ---- how

    def _refuses_everything(self, bench: ArmBench) -> None:
        for motion in (bench.arm.move_to_start, bench.arm.execute, bench.arm.retreat):
            with pytest.raises(ArmNotReleasedError):
                motion(bench.path)

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
        pouring = Call(bench.arm.execute, bench.path)
        least = 0.1 * bench.path.report.tilt
        self._await(bench, lambda: bench.arm.state().moving and bench.arm.state().tilt > least, "it never tilts")
        return pouring

    def _broken_off(self, bench: ArmBench, stop: Callable[[], object]) -> ArmStoppedError:
        pouring = self._tilting(bench)
        stop()
        error = pouring.ended()
        assert isinstance(error, ArmStoppedError), f"it should have been stopped; it came to {error!r}"
        return error

    def _brought_home(self, bench: ArmBench) -> None:
        bench.arm.release()
        bench.arm.recover()
        with pytest.raises(ArmNotReleasedError):
            bench.arm.untilt(bench.path)
        bench.arm.release()
        bench.arm.untilt(bench.path)
        assert abs(bench.arm.state().tilt) < CLOSE
        bench.arm.release()
        bench.arm.retreat(bench.path)

    @staticmethod
    def _await(bench: ArmBench, condition: Callable[[], bool], otherwise: str) -> None:
        end = time.monotonic() + PATIENCE
        while not condition():
            assert time.monotonic() < end, otherwise
            time.sleep(0.005)
