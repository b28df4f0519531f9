"""Results to report on, and what a report looks like to those who read it."""

from __future__ import annotations

import io
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.collections import PathCollection
from matplotlib.text import Text
from rich.console import Console

from orchestrator.learning.calibration.calibration_scores import Evaluation, ScoredPour, random_parameters
from orchestrator.learning.calibration.continuous_calibration import ContinuousBayesianCalibration
from orchestrator.learning.campaign_plan import MeasuredPour
from orchestrator.learning.deployment.d3 import Hybrid
from orchestrator.learning.stage_result import StageResult
from sim_engine.action import DEG, Action
from sim_engine.liquids import SimulationParameters
from tests.support import example_run


def spilled(action: Action, parameters: SimulationParameters) -> float:
    """Least at 60 deg/s and 110 mm; cohesion spills."""
    miss = ((action.angular_velocity - 60 * DEG) / DEG / 100) ** 2 + ((action.x_offset - 0.11) / 0.05) ** 2
    return min(0.02 + 0.3 * miss + 2.0 * abs(parameters.cohesion - 0.02), 0.9)


def played_results() -> dict[str, StageResult]:
    """Results of the real strategies, in a world whose spillage is a formula."""
    plan = example_run.campaign(pours=4)
    assert plan.calibration is not None
    assert plan.deployment is not None
    rng = np.random.default_rng(3)
    pours = []
    for number in range(8):
        values = example_run.ACTIONS.draw(rng)
        action = Action(height=0.05, **values)
        split = "test" if number >= 6 else "train"
        pours.append(MeasuredPour(action, spilled(action, SimulationParameters()), 0.98, split))
    calibrated = example_run.played(ContinuousBayesianCalibration(_with_height(plan.calibration), pours, 1), spilled)
    thetas = {"calibrated": calibrated.found.theta}
    thetas |= random_parameters(example_run.THETA, {}, 3, 2)
    evaluated = example_run.played(Evaluation(thetas, [ScoredPour("tumbler", pour) for pour in pours], 3), spilled)
    poured = example_run.played(Hybrid(plan.deployment, example_run.NARROW, SimulationParameters(), 4), spilled)
    return {"calibration": calibrated, "evaluation": evaluated, "narrow cup": poured}


def _with_height(plan: Any) -> Any:
    return replace(plan, scene=replace(plan.scene, fixed={"height": 0.05}))


def changed(part: Any, **updates: Any) -> Any:
    """A result, or a piece of one, with other values."""
    return type(part).model_validate({**dict(part), **updates})


def shown(renderable: Any, width: int = 160) -> str:
    """What the terminal would show, 160 columns wide unless told otherwise."""
    console = Console(file=io.StringIO(), width=width)
    console.print(renderable)
    return console.file.getvalue()  # type: ignore[attr-defined, no-any-return]


def is_picture(path: Path) -> bool:
    """A PNG with something on it."""
    from matplotlib.image import imread

    pixels = imread(path)
    return path.suffix == ".png" and pixels.shape[0] > 300 and len(np.unique(pixels[::7, ::7, :3])) > 20


def strays(figure: Any) -> list[str]:
    """Texts that leave a figure, and marks that their axes cut off."""
    figure.draw_without_rendering()
    renderer, whole, found = figure.canvas.get_renderer(), figure.bbox, []
    for text in figure.findobj(Text):
        if not text.get_text().strip() or not text.get_visible() or text in _out_of_view(figure):
            continue
        box = text.get_window_extent(renderer)
        if box.x0 < whole.x0 - 1 or box.y0 < whole.y0 - 1 or box.x1 > whole.x1 + 1 or box.y1 > whole.y1 + 1:
            found.append(f"'{text.get_text()}' leaves the figure")
    for axes in figure.axes:
        for marks in axes.collections:
            if isinstance(marks, PathCollection) and len(marks.get_offsets()) and marks.get_clip_on():
                radius = float(np.sqrt(marks.get_sizes().max())) / 2 * figure.dpi / 72
                found += _cut_off(axes, np.ma.getdata(marks.get_offsets()), radius)
        for line in axes.lines:
            if line.get_marker() not in ("None", None, "", "_") and line.get_clip_on() and len(line.get_xdata()):
                radius = line.get_markersize() / 2 * figure.dpi / 72
                found += _cut_off(axes, np.column_stack(line.get_data()).astype(float), radius)
    return found


def _cut_off(axes: Any, places: Any, radius: float) -> list[str]:
    inner = axes.bbox.padded(-radius)
    whole = all(inner.contains(x, y) for x, y in axes.transData.transform(places))
    return [] if whole else [f"marks of '{axes.get_title(loc='left')}' are cut off"]


def _out_of_view(figure: Any) -> set[Text]:
    """Labels of ticks that are not shown."""
    hidden: set[Text] = set()
    for axes in figure.axes:
        for axis in (axes.xaxis, axes.yaxis):
            low, high = sorted(axis.get_view_interval())
            for tick in [*axis.get_major_ticks(), *axis.get_minor_ticks()]:
                if not axes.get_visible() or not low <= tick.get_loc() <= high:
                    hidden |= {tick.label1, tick.label2}
    return hidden
