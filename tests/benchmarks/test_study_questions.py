"""What the script says of a study is what its cells say."""

from __future__ import annotations

from pathlib import Path
from types import ModuleType

import pytest

from orchestrator.learning.calibration.calibration_scores import UNCALIBRATED
from orchestrator.study.study_statistics import LEVEL, RANDOM, Final, Gathered, Key, StrategyScores

LEVELS, CUPS = ["bench1", "bench2"], ["cone"]


@pytest.fixture
def questions(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(Path(__file__).parents[2] / "benchmarks"))
    import study_questions

    return study_questions


def found(ours: float, active: float) -> Gathered:
    """Two benches, one repetition each: D2 finds what D3 has at once with its third pour."""
    scores = {UNCALIBRATED: 0.2, RANDOM: 0.3, "C4": ours, "C4-active": active}
    made = Gathered()
    for name, score in scores.items():
        made.calibrated[name] = StrategyScores(test=[[score], [score + 0.01]], numbers=[1, 1 + LEVEL])
    for level in LEVELS:
        for strategy, losses in {"D2": [0.9, 0.5, 0.1], "D3": [0.1, 0.1, 0.1]}.items():
            key = Key(level, CUPS[0], strategy)
            made.losses[key], made.numbers[key] = [losses], [1]
            made.finals[key] = {1: [Final(0.1, 0.1, True)]}
    return made


@pytest.mark.parametrize(
    ("ours", "active", "no"), [(0.1, 0.1, None), (0.25, 0.1, "1. C4 less uncalibrated"), (0.1, 0.2, "3. C4 on 6")]
)
def test_questions_are_answered_by_differences_of_benches(
    questions: ModuleType, ours: float, active: float, no: str | None
) -> None:
    rows = [answer.row() for answer in questions.answers(found(ours, active), LEVELS, CUPS)]
    said_no = [row for row in rows if row.endswith("| no |")]
    assert all(row.startswith(f"| {no}") for row in said_no)
    assert len(said_no) == (no is not None)
    assert "-40.00 (-40.00 … -40.00) points | 2 of 2" in rows[3]
    assert "-2.00 (-2.00 … -2.00) pours | 2 of 2" in rows[4]


def test_a_study_that_has_not_been_run_says_what_to_do(
    questions: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("sys.argv", ["study_questions.py", str(tmp_path)])
    with pytest.raises(SystemExit) as ended:
        questions.main()
    assert ended.value.code == 2
    assert "too few cells are finished; first: decant study" in capsys.readouterr().err
