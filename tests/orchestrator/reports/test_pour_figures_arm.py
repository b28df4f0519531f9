"""`pour_figures`: the picture of a planned path shows the arm, the vessels, and all that is written on it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.text import Text
from typer.testing import CliRunner

from orchestrator.cli.app import app
from orchestrator.reports import figure_style as style
from tests.support.example_results import strays

QUICKSTART = Path(__file__).parents[3] / "configs" / "campaigns" / "quickstart.yaml"


@pytest.fixture(scope="module")
def figure(tmp_path_factory: pytest.TempPathFactory) -> Any:
    drawn: list[Any] = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(style, "save", lambda figure, path: drawn.append(figure) or path)
        png = tmp_path_factory.mktemp("path") / "path.png"
        values = ["--set", "angular_velocity=40", "--set", "x_offset=90"]
        result = CliRunner().invoke(app, ["pour", str(QUICKSTART), *values, "--dry-run", "--png", str(png)])
    assert result.exit_code == 0, result.output
    return drawn[0]


def named(axes: Any, label: str) -> Any:
    return next(line for line in axes.lines if line.get_label() == label)


def test_all_that_is_written_stays_on_the_page(figure: Any) -> None:
    assert strays(figure) == []
    said = " ".join(text.get_text() for text in figure.findobj(Text))
    assert "height 110 mm" in " ".join(said.split())  # the end of a line that is longer than the page


def test_the_arm_reaches_from_its_base_to_the_tool(figure: Any) -> None:
    for axes in figure.axes[1:]:
        base, arm = named(axes, "robot's base"), named(axes, "arm, largest tilt")
        x, y = arm.get_data()
        assert (x[0], y[0]) == pytest.approx((base.get_xdata()[0], base.get_ydata()[0]))
        assert len(x) == 10


def test_the_base_does_not_stand_under_the_receiver(figure: Any) -> None:
    for axes in figure.axes[1:]:
        assert abs(named(axes, "robot's base").get_xdata()[0]) + abs(named(axes, "robot's base").get_ydata()[0]) > 500
    front = figure.axes[2]
    assert abs(named(front, "robot's base").get_xdata()[0]) > 500


def test_the_pour_fills_its_panel(figure: Any) -> None:
    near = figure.axes[0]
    tool = named(near, "tool, pour")
    spans = [np.ptp(limits) for limits in (near.get_xlim(), near.get_ylim())]
    assert max(spans) < 600  # mm; the cell is 1 m wide
    assert near.get_xlim()[0] < tool.get_xdata().min()
