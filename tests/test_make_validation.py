"""docs/make_validation.py: the page and the pictures of the solver's validation."""

from __future__ import annotations

import contextlib
import itertools
import json
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from matplotlib.text import Text

from benchmarks.validation import cases as suite
from benchmarks.validation.__main__ import case_record
from benchmarks.validation.__main__ import main as validate
from benchmarks.validation.case_result import CaseEffort, Figure, Measurement, Series, reported, within
from orchestrator.reports import figure_style as style
from orchestrator.reports.figure_style import INK
from tests.benchmarks.validation.test_main import FIGURE, a_case, height, two_cases  # noqa: F401
from tests.support.example_results import strays

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT / "docs"))

import make_validation  # noqa: E402


@pytest.mark.slow
@pytest.mark.usefixtures("two_cases")
def test_the_page_keeps_other_cases_and_marks_those_that_another_solver_measured(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def measure(case: str) -> None:
        results = tmp_path / "results.json"
        with results.open("w", encoding="utf-8") as written, contextlib.redirect_stdout(written):
            validate([case, "--json"])
        make_validation.main([str(results)], tmp_path)

    monkeypatch.setattr(make_validation, "CASES", suite.CASES)
    measure("bad")
    measure("good")
    page = (tmp_path / make_validation.PAGE_NAME).read_text(encoding="utf-8")
    assert page.index("## Good") < page.index("## Bad")
    assert "1 of 2 criteria are met" in page
    assert "| height | 2,000 | 50 mm (**fails**) | 39.8 mm | within 2 % | **0 of 1** |" in page
    assert (tmp_path / "images" / "validation-good.png").read_bytes()[:4] == b"\x89PNG"
    monkeypatch.setattr("benchmarks.validation.__main__.solver_fingerprint", lambda: "another")
    measure("good")
    marked = (tmp_path / make_validation.PAGE_NAME).read_text(encoding="utf-8")
    assert "†" not in page
    assert "† Measured before the solver's sources last changed" in marked
    assert "## Good\n\nLiquid stands.\n" in marked
    assert "## Bad\n\nLiquid stands. †\n" in marked


def test_the_page_has_one_row_for_all_numbers_of_particles_and_no_quantity_without_a_criterion() -> None:
    coarse = within("height", 0.05, 0.0398, 0.0008, unit="m", criterion="within 2 %", particles=500)
    spread = reported("spread", 0.1, particles=500)
    found = [measurement.as_json() for measurement in (coarse, height(0.0397), spread)]
    record = {"title": "Rest", "about": "Liquid stands.", "solver": "same", "image": None, "measurements": found}
    page = make_validation.page_text({"rest": record}, "", "same")
    assert "1 of 2 criteria are met" in page
    assert "| height | 500; 2,000 | 50 (**fails**); 39.7 mm | 39.8 mm | within 2 % | **1 of 2** |" in page
    assert "spread" not in page
    assert "|" not in make_validation.page_text({"rest": {**record, "measurements": found[2:]}}, "", "same")


def test_quantities_that_differ_in_one_word_share_a_row_with_the_values_that_fail() -> None:
    angles = {"kept at 60°, slowly": (0.0399, 0.0398), "kept at 70°, slowly": (0.031, 0.030)}
    found = [
        within(name, value, reference, 0.0008, unit="m", criterion="within 2 %", particles=500).as_json()
        for name, (value, reference) in angles.items()
    ]
    record = {"title": "Kept", "about": "Liquid.", "solver": "same", "image": None, "measurements": found}
    page = make_validation.page_text({"kept": record}, "", "same")
    assert "| kept at 60°, 70°, slowly | 500 | 31 mm (70°, 500) | 30 mm | within 2 % | **1 of 2** |" in page
    found[1]["passed"] = True
    page = make_validation.page_text({"kept": record}, "", "same")
    assert "| kept: kept | kept at 60°, 70°, slowly | 500 | 31 mm (70°, 500) | 30 mm | within 2 % | 2 of 2 |" in page
    found[1]["name"] = "left at 80°, slowly"
    page = make_validation.page_text({"kept": record}, "", "same")
    assert "kept at 60°, slowly, and 1 more | 500 | 39.9 mm | 39.8 mm | within 2 % | 2 of 2 |" in page


def test_a_mirrored_liquid_that_passes_is_counted_next_to_the_whole_one_and_its_curve_has_the_same_colour(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def work(simulator: object, effort: CaseEffort) -> tuple[list[Measurement], Figure]:
        return [height(0.05 if effort.mirrored else 0.0397), replace(height(0.04), name="depth", criterion="")], FIGURE

    case = suite.Case("kept", "Kept", "Liquid.", work)
    record = case_record(case, case.run(None, *case.efforts(full=True)))  # type: ignore[arg-type]
    page = make_validation.page_text({"kept": {**record, "solver": "same", "image": None}}, "", "same")
    rows = [line.split(" | ")[1:] for line in page.splitlines() if line.startswith("| [kept]")]
    assert [(row[0], row[2], *row[5:]) for row in rows] == [
        ("height, and 1 more", "39.7 mm", "2 of 2", "1 of 1 |"),
        ("height, mirrored", "50 mm (**fails**)", "**0 of 1**", "  |"),
    ]
    assert "3 of 4 criteria are met" in page
    drawn = saved(make_validation.figure_of(record), monkeypatch).axes[0].get_lines()
    assert [line.get_label() for line in drawn] == ["2,000 particles", "theory", "2,000 particles, mirrored"]
    whole, _, mirrored = drawn
    assert (mirrored.get_color(), mirrored.get_linestyle()) == (whole.get_color(), "--")
    assert whole.get_linestyle() == "-"


@pytest.mark.slow
def test_many_panels_go_into_rows(tmp_path: Path) -> None:
    from matplotlib.image import imread

    def picture(panels: int) -> Any:
        curves = tuple(
            Series("fast pour", (100.0, 1000.0, 4000.0), (0.1, 0.2, 0.15), panel=panel) for panel in range(panels)
        )
        words = tuple(f"panel {panel}" for panel in range(panels))
        path = make_validation.draw(Figure(words, words, words, curves, log_x=True), tmp_path / "figure.png")
        return imread(path)

    three, four = picture(3), picture(4)
    assert four.shape[1] == pytest.approx(three.shape[1], rel=0.1)
    assert four.shape[0] > 1.8 * three.shape[0]


def saved(figure: Figure, monkeypatch: pytest.MonkeyPatch) -> Any:
    drawn: list[Any] = []
    monkeypatch.setattr(style, "save", lambda canvas, path: drawn.append(canvas) or path)
    make_validation.draw(figure, Path("figure.png"))
    return drawn[0]


@pytest.mark.slow
@pytest.mark.parametrize("panels", [1, 6])
def test_the_legend_lies_on_no_curve_and_no_number_is_tiny(panels: int, monkeypatch: pytest.MonkeyPatch) -> None:
    names = ("slow pour", "standard pour", "fast pour")
    curves = tuple(
        Series(name, (250.0, 435.0, 757.0, 1_000.0, 1_320.0, 4_000.0), (0.3, 0.2, 0.15, 0.1, 0.1, 0.1), panel=panel)
        for panel in range(panels)
        for name in names
    )
    words = tuple(f"panel {panel}" for panel in range(panels))
    canvas = saved(Figure(words, words, words, curves, log_x=True), monkeypatch)
    long = Series("a = 28.6 mm, experiment of others", (1.0, 2.0), (0.1, 0.2), "reference")
    assert strays(canvas) == []
    several = (*curves, *(replace(long, name=f"{long.name} {i}") for i in range(3)))
    assert strays(saved(Figure(words, words, words, several), monkeypatch)) == []
    assert [axes.get_legend() for axes in canvas.axes] == [None] * panels
    (legend,) = canvas.legends
    assert [text.get_text() for text in legend.get_texts()] == list(names)
    below = legend.get_window_extent().y1
    assert all(axes.get_window_extent().y0 > below for axes in canvas.axes)
    smallest = min(text.get_fontsize() for text in canvas.findobj(Text) if text.get_text())
    assert smallest / 72 / canvas.get_figwidth() > 0.01  # of the picture's width: 8 pixels on a page 800 wide
    ticks = canvas.axes[0].get_xticklabels()
    boxes = [tick.get_window_extent() for tick in ticks]
    assert all(left.x1 < right.x0 for left, right in itertools.pairwise(boxes))


def test_a_figure_is_drawn_again_from_what_is_kept_of_it() -> None:
    case = a_case("good", height(0.0397), figure=FIGURE)
    record = case_record(case, case.run(None, CaseEffort()))  # type: ignore[arg-type]
    assert make_validation.figure_of(json.loads(json.dumps(record))) == FIGURE
    assert make_validation.figure_of({**record, "figure": None}) is None


def test_references_can_be_told_apart_and_have_their_curve_s_colour(monkeypatch: pytest.MonkeyPatch) -> None:
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
    (axes,) = saved(Figure(("",), ("",), ("",), curves), monkeypatch).axes
    drawn = {line.get_label(): line for line in axes.get_lines()}
    for subject in ("cone", "jug"):
        curve, points = drawn[f"{subject}, 2,000 particles"], drawn[f"{subject}, experiment"]
        assert (points.get_color(), points.get_linestyle()) == (curve.get_color(), "None")
    assert drawn["cone, experiment"].get_marker() != drawn["jug, experiment"].get_marker()
    theories = [drawn[f"theory, C_d {c}"] for c in ("1", "0.61")]
    assert {line.get_color() for line in theories} == {INK}
    assert len({line.get_linestyle() for line in theories}) == 2


def test_the_shipped_page_is_made_from_its_data() -> None:
    data = json.loads((ROOT / "docs" / make_validation.DATA_NAME).read_text(encoding="utf-8"))
    page = (ROOT / "docs" / make_validation.PAGE_NAME).read_text(encoding="utf-8")
    assert page == make_validation.page_text(data["cases"], data["theta"], data["solver"])
