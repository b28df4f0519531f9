"""`decant physics`: what a person sees of the solver's cases, and the page that it writes."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from orchestrator.cli import app
from orchestrator.report import physics as report
from orchestrator.report.style import INK, new_figure
from sim_engine.validation import suite
from sim_engine.validation.result import CaseResult, Figure, Measurement, Series, reported, within

ROOT = Path(__file__).parents[3]
runner = CliRunner()

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
def test_a_criterion_that_is_not_met_is_shown_and_ends_with_code_1() -> None:
    result = runner.invoke(app, ["physics"])
    assert result.exit_code == 1
    rows = [line for line in result.stdout.splitlines() if "height" in line]
    assert ["39.7 mm" in rows[0], "pass" in rows[0]] == [True, True]
    assert ["50 mm" in rows[1], "FAIL" in rows[1]] == [True, True]
    assert "1 of 2 criteria are not met" in result.stderr


@pytest.mark.usefixtures("two_cases")
def test_a_case_alone_passes_and_its_json_is_valid() -> None:
    result = runner.invoke(app, ["physics", "good", "--json"])
    assert result.exit_code == 0
    data = json.loads(result.stdout.splitlines()[-1])
    assert list(data["cases"]) == ["good"]
    measured, spread = data["cases"]["good"]["measurements"]
    assert measured["value"] == 0.0397
    assert spread["value"] is None


@pytest.mark.usefixtures("two_cases")
def test_the_page_keeps_other_cases_and_marks_those_that_another_solver_measured(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    runner.invoke(app, ["physics", "bad", "--write", str(tmp_path)])
    runner.invoke(app, ["physics", "good", "--write", str(tmp_path)])
    page = (tmp_path / report.PAGE_NAME).read_text(encoding="utf-8")
    assert page.index("## Good") < page.index("## Bad")
    assert "1 of 2 criteria are met" in page
    assert "| height | 2,000 | 50 mm | 39.8 mm | within 2 % | **fails** |" in page
    assert (tmp_path / "images" / "validation-good.png").read_bytes()[:4] == b"\x89PNG"
    monkeypatch.setattr(suite, "solver_fingerprint", lambda: "another")
    runner.invoke(app, ["physics", "good", "--write", str(tmp_path)])
    good, bad = (tmp_path / report.PAGE_NAME).read_text(encoding="utf-8").partition("## Bad")[::2]
    assert "Measured before" not in page
    assert "Measured before" not in good
    assert "Measured before" in bad


def test_a_wrong_name_and_a_missing_folder_are_refused_before_anything_runs(tmp_path: Path) -> None:
    wrong = runner.invoke(app, ["physics", "slosh"])
    assert wrong.exit_code == 2
    assert "no case 'slosh'; there are rest," in wrong.stderr
    missing = runner.invoke(app, ["physics", "rest", "--write", str(tmp_path / "nowhere")])
    assert missing.exit_code == 2
    assert "there is no such folder" in missing.stderr


def test_cases_are_listed_by_name() -> None:
    result = runner.invoke(app, ["physics", "--list"])
    assert result.exit_code == 0
    assert [line.split()[0] for line in result.stdout.splitlines()] == [case.name for case in suite.CASES]


def test_a_long_case_tells_how_far_it_is_and_a_case_without_criteria_is_judged_by_nothing(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def work(simulator: object, effort: suite.Effort) -> tuple[list[Measurement], None]:
        assert effort.progress is not None
        for done in range(4):
            effort.progress(done, 3)
        return [reported("slope", 0.1, particles=500)], None

    monkeypatch.setattr(suite, "CASES", (suite.Case("long", "Long", "It takes its time.", work),))
    result = runner.invoke(app, ["physics"])
    assert (result.exit_code, result.stderr.splitlines()[-1]) == (0, "nothing was judged")


def test_many_panels_go_into_rows_and_spreads_are_bands(tmp_path: Path) -> None:
    from matplotlib.image import imread

    def picture(panels: int, spread: tuple[float, ...] = ()) -> Any:
        curves = tuple(
            Series("fast pour", (100.0, 1000.0, 4000.0), (0.1, 0.2, 0.15), panel=panel, spread=spread)
            for panel in range(panels)
        )
        logs = tuple(panel == 0 for panel in range(panels))
        words = tuple(f"panel {panel}" for panel in range(panels))
        path = report.draw(Figure(words, words, words, curves, log_x=logs), tmp_path / "figure.png")
        return imread(path)

    three, four = picture(3), picture(4)
    assert four.shape[1] == pytest.approx(three.shape[1], rel=0.1)
    assert four.shape[0] > 1.8 * three.shape[0]
    plain, banded = picture(1), picture(1, (0.05, 0.05, 0.05))
    assert banded.mean() < plain.mean() - 0.003  # a band darkens


def test_references_can_be_told_apart_and_have_their_curve_s_colour() -> None:
    few, many = (1.0, 2.0, 3.0), tuple(float(i) for i in range(30))
    curves = (
        Series("cone, 2,000 particles", many, many),
        Series("cone, 5,000 particles", many, many),
        Series("cone, experiment", few, few, "reference"),
        Series("jug, 2,000 particles", many, many),
        Series("jug, experiment", few, few, "reference"),
        Series("theory, C_d 1", many, many, "reference"),
        Series("theory, C_d 0.61", many, many, "reference"),
    )
    axes = new_figure(size=(3, 2))[1]
    report._panel(axes, Figure(("",), ("",), ("",), curves), 0)
    drawn = {line.get_label(): line for line in axes.get_lines()}
    for subject in ("cone", "jug"):
        curve, points = drawn[f"{subject}, 2,000 particles"], drawn[f"{subject}, experiment"]
        assert (points.get_color(), points.get_linestyle()) == (curve.get_color(), "None")
    assert drawn["cone, experiment"].get_marker() != drawn["jug, experiment"].get_marker()
    theories = [drawn[f"theory, C_d {c}"] for c in ("1", "0.61")]
    assert {line.get_color() for line in theories} == {INK}
    assert len({line.get_linestyle() for line in theories}) == 2


def test_a_fault_of_the_solver_does_not_pass() -> None:
    def work(simulator: object, effort: suite.Effort) -> tuple[list[Measurement], None]:
        raise ArithmeticError("at 0.1 s: diverged")

    result: CaseResult = suite.Case("x", "X", "", work).run(None, suite.Effort())  # type: ignore[arg-type]
    assert not result.passed


def test_the_shipped_page_is_made_from_its_data() -> None:
    data = json.loads((ROOT / "docs" / report.DATA_NAME).read_text(encoding="utf-8"))
    page = (ROOT / "docs" / report.PAGE_NAME).read_text(encoding="utf-8")
    assert page == report.page_text(data["cases"], data["theta"], data["solver"])
