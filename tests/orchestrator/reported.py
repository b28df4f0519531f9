"""Results to report on, and what a report looks like to those who read it."""

from __future__ import annotations

import io
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from orchestrator.strategies.calibration.c4 import ContinuousBayesianCalibration
from orchestrator.strategies.calibration.design import MeasuredPour
from orchestrator.strategies.calibration.evaluation import Evaluation, ScoredPour, random_parameters
from orchestrator.strategies.deployment.d3 import Hybrid
from orchestrator.strategies.learnt import Learnt
from sim_engine.action import DEG, Action
from sim_engine.liquid import SimulationParameters
from tests.orchestrator import watched


def spilled(action: Action, parameters: SimulationParameters) -> float:
    """Least at 60 deg/s and 110 mm; cohesion spills."""
    miss = ((action.angular_velocity - 60 * DEG) / DEG / 100) ** 2 + ((action.x_offset - 0.11) / 0.05) ** 2
    return min(0.02 + 0.3 * miss + 2.0 * abs(parameters.cohesion - 0.02), 0.9)


def played_results() -> dict[str, Learnt]:
    """Results of the real strategies, in a world whose spillage is a formula."""
    plan = watched.campaign(pours=4)
    assert plan.calibration is not None
    assert plan.deployment is not None
    rng = np.random.default_rng(3)
    pours = []
    for number in range(8):
        values = watched.ACTIONS.draw(rng)
        action = Action(height=0.05, **values)
        split = "test" if number >= 6 else "train"
        pours.append(MeasuredPour(action, spilled(action, SimulationParameters()), 0.98, split))
    calibrated = watched.played(ContinuousBayesianCalibration(_with_height(plan.calibration), pours, 1), spilled)
    thetas = {"calibrated": calibrated.found.theta}
    thetas |= random_parameters(watched.THETA, {}, 3, 2)
    evaluated = watched.played(Evaluation(thetas, [ScoredPour("tumbler", pour) for pour in pours], 3), spilled)
    poured = watched.played(Hybrid(plan.deployment, watched.NARROW, SimulationParameters(), 4), spilled)
    return {"calibration": calibrated, "evaluation": evaluated, "narrow cup": poured}


def _with_height(plan: Any) -> Any:
    return replace(plan, scene=replace(plan.scene, fixed={"height": 0.05}))


def changed(part: Any, **updates: Any) -> Any:
    """A result, or a piece of one, with other values."""
    return type(part).model_validate({**dict(part), **updates})


def shown(renderable: Any) -> str:
    """What the terminal would show, 160 columns wide."""
    console = Console(file=io.StringIO(), width=160)
    console.print(renderable)
    return console.file.getvalue()  # type: ignore[attr-defined, no-any-return]


def is_picture(path: Path) -> bool:
    """A PNG with something on it."""
    from matplotlib.image import imread

    pixels = imread(path)
    return path.suffix == ".png" and pixels.shape[0] > 300 and len(np.unique(pixels[::7, ::7, :3])) > 20
