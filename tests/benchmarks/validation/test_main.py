"""`python -m benchmarks.validation`: what a person sees of the solver's cases."""

from __future__ import annotations

import json
import math

import pytest

from benchmarks.validation import cases as suite
from benchmarks.validation.__main__ import main
from benchmarks.validation.case_result import CaseEffort, CaseResult, Figure, Measurement, Series, reported, within

FIGURE = Figure(
    ("Heights",),
    ("time [s]",),
    ("height [mm]",),
    (
        Series("2,000 particles", (0.0, 1.0, 2.0), (41.0, 40.0, 39.8)),
        Series("theory", (0.0, 2.0), (39.8, 39.8), "reference"),
    ),
)


def height(value: float) -> Measurement:
    return within("height", value, 0.0398, 0.0008, unit="m", criterion="within 2 %", particles=2_000)


def a_case(name: str, *measurements: Measurement, figure: Figure | None = None) -> suite.Case:
    return suite.Case(name, name.title(), "Liquid stands.", lambda simulator, effort: (list(measurements), figure))


@pytest.fixture
def two_cases(monkeypatch: pytest.MonkeyPatch) -> None:
    good = a_case("good", height(0.0397), reported("spread", math.nan, particles=500), figure=FIGURE)
    monkeypatch.setattr(suite, "CASES", (good, a_case("bad", height(0.05))))


@pytest.mark.usefixtures("two_cases")
def test_a_criterion_that_is_not_met_is_shown_and_ends_with_code_1(capsys: pytest.CaptureFixture[str]) -> None:
    assert main([]) == 1
    shown = capsys.readouterr()
    rows = [line for line in shown.out.splitlines() if "height" in line]
    assert ["39.7 mm" in rows[0], "pass" in rows[0]] == [True, True]
    assert ["50 mm" in rows[1], "FAIL" in rows[1]] == [True, True]
    assert "1 of 2 criteria are not met" in shown.err


@pytest.mark.usefixtures("two_cases")
def test_a_case_alone_passes_and_its_json_has_no_nan(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert main(["good", "--json"]) == 0
    data = json.loads(capsys.readouterr().out, parse_constant=pytest.fail)
    assert list(data["cases"]) == ["good"]
    measured, spread = data["cases"]["good"]["measurements"]
    assert measured["value"] == 0.0397
    assert spread["value"] is None


@pytest.mark.parametrize("repeated", [False, True])
def test_a_full_run_repeats_the_case_with_the_mirrored_liquid(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], repeated: bool
) -> None:
    def work(simulator: object, effort: CaseEffort) -> tuple[list[Measurement], None]:
        return [height(0.05 if effort.mirrored else 0.0397)], None

    monkeypatch.setattr(suite, "CASES", (suite.Case("rest", "Rest", "Liquid stands.", work, repeated),))
    assert main([]) == 0
    capsys.readouterr()
    code, shown = main(["--full"]), capsys.readouterr()
    assert ("height, mirrored" in shown.out, code) == (repeated, int(repeated))
    assert f"{1 + repeated} criteria" in shown.err


def test_a_wrong_name_is_refused_before_anything_runs(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["slosh"])
    assert ended.value.code == 2
    assert "no case 'slosh'; there are rest," in capsys.readouterr().err


def test_a_case_without_criteria_is_judged_by_nothing(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def work(simulator: object, effort: CaseEffort) -> tuple[list[Measurement], None]:
        return [reported("slope", 0.1, particles=500)], None

    monkeypatch.setattr(suite, "CASES", (suite.Case("long", "Long", "It takes its time.", work),))
    assert main([]) == 0
    assert capsys.readouterr().err.splitlines()[-1] == "nothing was judged"


def test_a_fault_of_the_solver_does_not_pass() -> None:
    def work(simulator: object, effort: CaseEffort) -> tuple[list[Measurement], None]:
        raise ArithmeticError("at 0.1 s: diverged")

    result: CaseResult = suite.Case("x", "X", "", work).run(None, CaseEffort())  # type: ignore[arg-type]
    assert not result.passed
