"""A campaign that is struck anywhere ends as if nothing had happened (docs/evidence/reliability.md)."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

from actors.runtime.child_process import child_environment
from tests.reliability import strikes
from tests.reliability.case import (
    BACK,
    FAULTS,
    FULL,
    KILLED,
    KILLED_AFTER,
    NO_MEANING,
    TARGETS,
    Case,
    first_and_last,
    first_in_stages,
    first_of_kind,
)
from tests.reliability.page import RIGS, found
from tests.reliability.program import ProgramRig

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def rig(tmp_path_factory: pytest.TempPathFactory) -> ProgramRig:
    return ProgramRig(tmp_path_factory.mktemp("matrix"))


def test_the_program_meets_every_fault_at_every_write_of_calibration_and_deployment(rig: ProgramRig) -> None:
    cases = rig.cases()
    assert len(cases) == len(set(cases)) == 6 * len(rig.points) > 600
    written = {at.partition(":")[0] for at, _ in rig.points}
    assert {"campaign", "pours", "calibration", "evaluation", "deployment"} <= written


def test_a_pour_that_nobody_knows_of_is_asked_about_once_and_not_made_again(rig: ProgramRig) -> None:
    begun = [point for point in rig.points if point[0].endswith("pour.started")]
    assert len(begun) == 5
    outcome = rig.play(Case("program", KILLED_AFTER, *begun[-1]))
    assert (outcome.asked, outcome.lives, outcome.wrong) == (1, 2, ())


@pytest.mark.parametrize(
    ("fault", "at", "number"),
    [
        (KILLED, "evaluation: finished", 1),
        (FULL, "deployment:narrow: told", 3),
        (BACK, "calibration: asked", 7),
    ],
)
def test_a_sample_of_it(rig: ProgramRig, fault: str, at: str, number: int) -> None:
    if fault == FULL and not strikes.can_mount(rig.folder):
        pytest.skip("only root may mount a small disk")
    assert rig.play(Case("program", fault, at, number)).wrong == ()


def test_what_goes_wrong_is_seen(rig: ProgramRig, monkeypatch: pytest.MonkeyPatch) -> None:
    """With a person who types another weight the campaign ends otherwise, and that is said."""
    monkeypatch.setattr(rig, "answer", lambda question: "weighed 40 1 100")
    (wrong,) = rig.play(Case("program", KILLED_AFTER, "pours: pour.started", 2)).wrong
    assert wrong.startswith("other requests, decisions or results than undisturbed")


def test_every_combination_is_tried_or_has_a_reason_why_not() -> None:
    assert set(RIGS) == set(TARGETS)
    for (target, fault), reason in NO_MEANING.items():
        assert target in TARGETS
        assert fault in FAULTS
        assert reason


STAMPED = ("line_recording.py", "liquid_devices.py", "liquid_device_contracts.py", "night_consent.py")
"""Files that record the time of day of raw lines and of events, and the one with the end of a consent."""


def test_what_has_no_clock_reads_none() -> None:
    """The reason why clocks that jump are not tried on arm, balance, simulators and optimiser.

    A spill sensor stamps its events with the time of day, which is recorded; nothing is decided by it.
    A consent for a night ends at a time of day; a clock that is set back does not lengthen it (`test_places`).
    """
    clock = re.compile(r"\btime\.time\(|datetime|time_ns\(|localtime|gmtime")
    files = [path for floor in ("actors", "sim_engine") for path in (ROOT / floor).rglob("*.py")]
    assert len(files) > 100
    stamped = [path.name for path in files if path.name in STAMPED]
    assert [path.name for path in files if clock.search(path.read_text("utf-8"))] == stamped


def test_points_are_chosen_by_kind_and_stage() -> None:
    points = [("a: x", 1), ("a: y", 1), ("a: x", 2), ("a: x", 3), ("b: x", 1)]
    assert first_and_last(points) == [("a: x", 1), ("a: y", 1), ("a: x", 3), ("b: x", 1)]
    assert first_in_stages(points) == [("a: x", 1), ("a: y", 1), ("b: x", 1)]
    assert first_of_kind(points) == [("a: x", 1), ("a: y", 1)]


def test_a_line_that_is_cut_is_cut_at_both_ends_and_a_threads_own_is_not() -> None:
    """In a process of its own: this one has lines to whoever runs the tests."""
    subprocess.run([sys.executable, "-c", CUT], check=True, cwd=ROOT, env=child_environment())


CUT = """
import os, socket
from tests.reliability import strikes

ours, theirs = socket.socketpair()
listening = socket.create_server(("127.0.0.1", 0))
far = socket.create_connection(listening.getsockname())
near, _ = listening.accept()
assert strikes.cut([os.getpid()]) >= 2
assert far.recv(1) == near.recv(1) == b""
ours.send(b"x")
assert theirs.recv(1) == b"x"
socket.create_connection(listening.getsockname()).close()
"""


@pytest.mark.slow
@pytest.mark.ray
@pytest.mark.realtime
@pytest.mark.parametrize("target", [target for target in TARGETS if target != "program"])
def test_a_sample_of_what_else_is_struck(target: str, tmp_path: Path) -> None:
    """In a process of its own: its lives are forked from it, and Ray does not start in a fork of what has used it."""
    results = tmp_path / "results.jsonl"
    command = [sys.executable, "-m", "tests.reliability.page", "--results", str(results), "--limit", "4"]
    ended = subprocess.run(
        [*command, "--share", target, "0", "1"],
        check=False,
        cwd=ROOT,
        env=child_environment(),
        capture_output=True,
        text=True,
    )
    assert ended.returncode == 0, ended.stderr[-4000:]
    rows = found(results).values()
    assert len(rows) == 4
    assert [(row["case"], row["wrong"]) for row in rows if row["wrong"]] == []
