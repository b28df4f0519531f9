"""A campaign that is struck anywhere ends as if nothing had happened (docs/reliability.md)."""

from __future__ import annotations

import pytest

from tests.reliability.matrix import FAULTS, LOST, Case, Matrix, can_mount


@pytest.fixture(scope="module")
def matrix(tmp_path_factory: pytest.TempPathFactory) -> Matrix:
    return Matrix(tmp_path_factory.mktemp("matrix"))


def played(matrix: Matrix, cases: list[Case]) -> None:
    if cases and cases[0].fault == "full disk" and not can_mount(matrix.folder):
        pytest.skip("only root may mount a small disk")
    found = [matrix.play(case) for case in cases]
    assert [one for one in found if one.wrong] == []


def test_the_matrix_has_every_fault_at_every_write_of_calibration_and_deployment(matrix: Matrix) -> None:
    assert len(matrix.cases()) == len(FAULTS) * len(matrix.entries) + matrix.questions > 600
    written = {entry.partition(":")[0] for entry in matrix.entries}
    assert {"campaign", "pours", "calibration", "evaluation", "deployment"} <= written


def test_a_pour_that_nobody_knows_of_is_asked_about_and_only_then_repeated(matrix: Matrix) -> None:
    begun = [i for i, entry in enumerate(matrix.entries, start=1) if entry.endswith("pour.started")]
    assert len(begun) == 5
    outcome = matrix.play(Case("killed after", begun[-1]))
    assert outcome.asked == 1
    assert outcome.wrong == ()


@pytest.mark.parametrize(("fault", "point"), [("killed before", 77), ("full disk", 130), ("clock an hour back", 40)])
def test_a_sample_of_it(matrix: Matrix, fault: str, point: int) -> None:
    played(matrix, [Case(fault, point)])


@pytest.mark.slow
@pytest.mark.parametrize("fault", [*FAULTS, LOST])
def test_all_of_it(matrix: Matrix, fault: str) -> None:
    played(matrix, [case for case in matrix.cases() if case.fault == fault])
