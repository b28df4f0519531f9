"""Inputs of predictions on the command line: options, θ, draws of its posterior, and the calibration's discrepancy.

`SimulateOptions` holds the options of `decant simulate`; `PredictionInputs` holds θ and makes the simulation tasks of a
pour.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from orchestrator.cli.console import BAD_INPUT, RefusalError, Refused

if TYPE_CHECKING:
    from orchestrator.strategies.campaign_plan import CampaignPlan
    from sim_engine.action import Action
    from sim_engine.liquids import SimulationParameters
    from sim_engine.resources import Backend
    from sim_engine.scene import PourTask, Scene


@dataclass(frozen=True, kw_only=True)
class SimulateOptions:
    """Options of `decant simulate`, without the campaign."""

    assignments: list[str] | None = None
    """Values of the action, `name=value`."""
    source: Path | None = None
    """CSV file of weighed pours, instead of an action."""
    parameters: Path | None = None
    """theta.json; None: the campaign's θ."""
    receiver: Path | None = None
    """Vessel file instead of the scene's receiver."""
    thetas: int | None = None
    """Posterior draws that a pour's simulations cycle through; None: as many as `seeds`, if a posterior exists."""
    seed: int = 0
    seeds: int = 3
    """Simulations of each pour, at least as many as `thetas`."""
    scene: str | None = None
    csv: Path | None = None
    rrd: Path | None = None
    png: Path | None = None
    as_json: bool = False
    backend: Backend = "cpu"


@dataclass(frozen=True)
class PredictionInputs:
    """θ of a prediction.

    Attributes:
        theta: θ of the file, or the campaign's.
        drawn: draws of the posterior that simulations cycle through; empty: θ alone.
        discrepancy: shift that remains after calibration (`sim_engine.prediction_band`); None if it is unknown.
    """

    theta: SimulationParameters
    drawn: tuple[SimulationParameters, ...] = ()
    discrepancy: float | None = None

    @property
    def thetas(self) -> tuple[SimulationParameters, ...]:
        """All θ that simulations cycle through."""
        return self.drawn or (self.theta,)

    def tasks(self, scene: Scene, action: Action, seed: int, seeds: int, frame_rate: float = 0.0) -> list[PourTask]:
        """Return the simulations of one pour. They cycle through θ; uncertain vessel shapes are drawn for each
        simulation.

        Args:
            seed: seed of the first simulation.
            seeds: number of simulations, at least as many as θ.
            frame_rate: frame rate of the first simulation [1/s].
        """
        from sim_engine.scene import PourTask

        turns, count = self.thetas, max(seeds, len(self.thetas))
        return [
            PourTask(scene.drawn(seed + i), action, turns[i % len(turns)], seed + i, 0.0 if i else frame_rate)
            for i in range(count)
        ]

    def said(self, scene: Scene) -> str:
        """Describe the sources of uncertainty in the prediction intervals of a scene's pours."""
        among = f"{len(self.drawn)} θ of the posterior" if self.drawn else "one θ"
        parts = ["seeds", among, f"{self.theta.particles} particles' resolution"]
        if scene.uncertain:
            parts.insert(1, "shapes that the vessels may have")
        if self.discrepancy is not None:
            parts.append("what calibration left over")
            return f"bands of {', '.join(parts[:-1])} and {parts[-1]}"
        return f"bands of {', '.join(parts[:-1])} and {parts[-1]} alone (no calibration says what it left over)"

    def as_json(self) -> dict[str, Any]:
        """Return the shifts in the prediction intervals, JSON-ready."""
        from sim_engine.prediction_band import resolution_shift

        return {"discrepancy_shift": self.discrepancy, "resolution_shift": resolution_shift(self.theta.particles)}


def foretelling(plan: CampaignPlan, parameters: Path | None, thetas: int | None, seeds: int) -> PredictionInputs:
    """Read θ and its posterior as requested on the command line.

    Args:
        plan: campaign with the values of θ that the file does not contain.
        parameters: theta.json of a calibration, or the user's own file; None: the campaign's θ.
        thetas: number of posterior draws; None: as many as `seeds` if the file has a posterior and recommends the
            calibrated θ; 0: θ alone.
        seeds: simulations of a pour.

    Raises:
        RefusalError: the file is invalid, or it lacks the requested posterior (exit code 2).
    """
    from orchestrator.config.file_loading import (
        load_discrepancy,
        load_parameters,
        load_posterior,
        predicts_with_posterior,
    )
    from orchestrator.config.yaml.yaml_errors import ConfigError

    if parameters is None:
        if thetas:
            raise RefusalError(f"--thetas {thetas}: goes with --parameters, the theta.json of a calibration", BAD_INPUT)
        return PredictionInputs(plan.parameters)
    with Refused(ConfigError):
        theta = load_parameters(parameters, plan.parameters)
        if thetas is None:
            thetas = seeds if predicts_with_posterior(parameters) else 0
        drawn = load_posterior(parameters, thetas, plan.parameters) if thetas else ()
        return PredictionInputs(theta, drawn, load_discrepancy(parameters))
