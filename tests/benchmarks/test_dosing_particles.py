"""`benchmarks/dosing_particles.py` makes no series twice, also if it was interrupted while it wrote one."""

from __future__ import annotations

from pathlib import Path
from types import ModuleType

import pytest

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"


@pytest.fixture
def benchmark_of_doses(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    import dosing_particles

    return dosing_particles


def test_finished_series_are_kept_and_a_line_that_was_cut_off_is_made_again(
    benchmark_of_doses: ModuleType, tmp_path: Path
) -> None:
    file, doses = tmp_path / "series.jsonl", benchmark_of_doses
    assert doses.finished(file) == doses.finished(None) == {}
    dose = doses.Dose(7000, 0, 50.0, 0.3, 0.0, 9.0, "reached", True, 0.125)
    doses.append(file, "mug", 7000, [dose, dose])
    doses.append(file, "cone", 7000, [])
    whole = file.read_text()
    file.write_text(whole + whole[: len(whole) // 2 - 9].splitlines()[0][:30])
    expected = {("mug", 7000): [dose, dose], ("cone", 7000): []}
    assert doses.finished(file) == expected
    doses.append(file, "bowl", 7000, [dose])
    assert doses.finished(file) == expected | {("bowl", 7000): [dose]}
