"""A campaign that is struck again while it continues ends as if nothing had happened (docs/evidence/reliability.md)."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from actors.runtime.child_process import child_environment
from tests.reliability import strikes
from tests.reliability.case import FULL, KILLED, KILLED_AFTER, STOPPED
from tests.reliability.fault_sequences import PROGRAM, Fault, ProgramSequences, faults_of, sequence

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def rig(tmp_path_factory: pytest.TempPathFactory) -> ProgramSequences:
    return ProgramSequences(tmp_path_factory.mktemp("sequences"))


def test_a_program_killed_while_it_resumes_and_while_a_person_answers_asks_about_the_same_pour(
    rig: ProgramSequences,
) -> None:
    faults = (struck_at_a_pour(rig), Fault(PROGRAM, KILLED, 0), Fault(PROGRAM, KILLED, 2))
    outcome = rig.play_sequence(faults)
    assert outcome["wrong"] == []
    assert outcome["asked"] >= 2
    assert len(outcome["ended"]) == 4


def struck_at_a_pour(rig: ProgramSequences) -> Fault:
    """Killed right after the journal says that a pour has begun."""
    first = (faults_of(rig, seed)[0] for seed in range(200))
    return next(fault for fault in first if fault.fault == KILLED_AFTER and begins_a_pour(rig, fault))


def begins_a_pour(rig: ProgramSequences, fault: Fault) -> bool:
    return rig.points[fault.write - 1][0].endswith("pour.started")


def test_a_disk_that_is_full_during_the_restart_after_a_kill_loses_nothing(rig: ProgramSequences) -> None:
    if not strikes.can_mount(rig.folder):
        pytest.skip("only root may mount a small disk")
    outcome = rig.play_sequence((Fault(PROGRAM, KILLED, 60), Fault(PROGRAM, FULL, 1), Fault(PROGRAM, STOPPED, 3)))
    assert outcome["wrong"] == []
    assert "came to rest: paused" in outcome["ended"]


@pytest.mark.parametrize("seed", [2, 10])
def test_a_sample_of_sequences(rig: ProgramSequences, seed: int) -> None:
    assert rig.play_sequence(faults_of(rig, seed))["wrong"] == []


def test_a_failing_sequence_is_seen_and_shortened(rig: ProgramSequences, monkeypatch: pytest.MonkeyPatch) -> None:
    """A person who types another weight makes the campaign end differently; the other fault is left out."""
    pour = struck_at_a_pour(rig)
    monkeypatch.setattr(ProgramSequences, "answer", lambda self, question: "weighed 40 1 100")
    failing = (pour, Fault(PROGRAM, STOPPED, 5))
    (wrong,) = rig.play_sequence(failing)["wrong"]
    assert wrong.startswith("other requests, decisions or results than undisturbed")
    monkeypatch.setattr(rig, "play_sequence", lambda faults: {"wrong": ["other"] if pour in faults else []})
    assert rig.shortest(failing) == (pour,)


def test_sequences_strike_restarts_questions_and_devices() -> None:
    drawn = [sequence(seed, 200, [13, 69], protocols=True) for seed in range(300)]
    assert {len(faults) for faults in drawn} == {2, 3, 4}
    assert {fault.target for faults in drawn for fault in faults} == {"program", "worker", "controller", "balance"}
    assert any(fault.write == 0 for faults in drawn for fault in faults)
    assert sum(0 < faults[1].write <= 8 for faults in drawn) > 50


@pytest.mark.slow
@pytest.mark.realtime
@pytest.mark.parametrize("bench", ["protocols", "daemon"])
def test_a_sample_over_protocols_and_with_two_clients(bench: str, tmp_path: Path) -> None:
    results = tmp_path / "results.jsonl"
    command = [sys.executable, "-m", "tests.reliability.fault_sequences", "--results", str(results)]
    command += ["--bench", bench, "--count", "4", "--jobs", "1"]
    ended = subprocess.run(command, cwd=ROOT, env=child_environment(), capture_output=True, text=True, check=False)
    rows = [json.loads(line) for line in results.read_text("utf-8").splitlines()]
    assert [(row["faults"], row["wrong"]) for row in rows if row["wrong"]] == []
    assert ended.returncode == 0, ended.stderr[-4000:]
    assert len(rows) == 4
