"""Plans from flat keywords: a strategy's settings take those that they have; other strategies' keys are left out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from orchestrator.learning.calibration.calibration_base import Calibrated, CalibratedTheta
from orchestrator.learning.calibration.posterior_summary import PosteriorFound, RemainingDiscrepancy
from orchestrator.learning.campaign_plan import CalibrationPlan, DeploymentPlan
from orchestrator.learning.strategy_registry import STRATEGIES
from orchestrator.runs.strategy_harness import ACTIONS, CALIBRATION_ACTIONS, PARAMETERS, SCENE
from sim_engine.action import Action
from sim_engine.liquids import SimulationParameters
from sim_engine.outcome import Loss
from sim_engine.search_space import Space

CALM: dict[str, dict[str, Any]] = {"D3": {"model": "residual", "simulations_per_pour": 0}}
"""What tests have otherwise than campaigns, unless they say it."""


def calibration(strategy: str = "C4", **values: Any) -> CalibrationPlan:
    """A calibration by one strategy."""
    settings, rest = _settings(strategy, values)
    return CalibrationPlan(settings, **rest)


def deployment(strategy: str = "D3", **values: Any) -> DeploymentPlan:
    """A deployment by one strategy."""
    settings, rest = _settings(strategy, values)
    return DeploymentPlan(settings, **rest)


def calibration_plan(**changes: Any) -> CalibrationPlan:
    """A calibration of the harness's example."""
    values: dict[str, Any] = {
        "scene": SCENE,
        "actions": CALIBRATION_ACTIONS,
        "parameters": PARAMETERS,
        "fixed_parameters": {"friction": 0.1},
        "pour_count": 32,
        "holdout": 4,
    }
    if changes.get("strategy", "C4") == "C4":
        values["simulations"] = 60
    return calibration(**values | changes)


def deployment_plan(**changes: Any) -> DeploymentPlan:
    """A deployment of the harness's example."""
    values: dict[str, Any] = {"scenes": (SCENE,), "actions": ACTIONS, "loss": Loss(), "pours": 8}
    if changes.get("strategy", "D3") == "D3":
        values["prior_simulations"] = 20
    return deployment(**values | changes)


def unit(action: Action, space: Space = ACTIONS) -> np.ndarray:
    """An action as a point of the unit cube."""
    return space.encode({name: getattr(action, name) for name in space.names})


def calibrated(
    theta: SimulationParameters, rows: Sequence[Mapping[str, float]] = (), searched: tuple[str, ...] = ("cohesion",)
) -> Calibrated:
    """What a calibration has found, with draws of a posterior or without."""
    posterior = PosteriorFound(
        level=0.9,
        mean={},
        region={},
        open=(),
        correlation=(),
        directions=(),
        remaining_discrepancy=RemainingDiscrepancy(low=0.0, median=0.0, high=0.0),
        effective=float(len(rows)),
        thetas=tuple(dict(row) for row in rows),
    )
    found = CalibratedTheta(
        theta=theta,
        searched=searched,
        predicted_discrepancy=0.0,
        predicted_deviation=0.0,
        hyperparameters=None,
        map=None,
        posterior=posterior if rows else None,
    )
    return Calibrated(strategy="C4", simulations=0, lost=0, undefined=0, training_pours=2, trials=(), found=found)


def _settings(strategy: str, values: dict[str, Any]) -> tuple[Any, dict[str, Any]]:
    kind = STRATEGIES.get(strategy)
    own = CALM.get(strategy, {}) | {name: value for name, value in values.items() if name in kind.model_fields}
    others = {name for settings in STRATEGIES.all.values() for name in settings.model_fields}
    return kind(**own), {name: value for name, value in values.items() if name not in others}
