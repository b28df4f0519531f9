"""With what a verb foretells pours: what was asked for, θ, draws of its posterior, what calibration left over."""

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
    """What `simulate` is given on the command line beside its campaign."""

    assignments: list[str] | None = None
    """Values of the action, `name=value`."""
    source: Path | None = None
    """CSV of weighed pours, in place of an action."""
    parameters: Path | None = None
    """theta.json; None: the campaign's θ."""
    receiver: Path | None = None
    """In place of the scene's."""
    thetas: int | None = None
    """Draws of the posterior that a pour's simulations take turns with; None: as many as `seeds`, if there is one."""
    seed: int = 0
    seeds: int = 3
    """Simulations of each pour; as many as `thetas` where those are more."""
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
        theta: that of the file, or the campaign's.
        drawn: draws of the posterior that simulations take turns with; empty: θ alone.
        discrepancy: shift that the calibration left (`sim_engine.prediction_band`); None where nobody knows.
    """

    theta: SimulationParameters
    drawn: tuple[SimulationParameters, ...] = ()
    discrepancy: float | None = None

    @property
    def thetas(self) -> tuple[SimulationParameters, ...]:
        """What simulations take turns with."""
        return self.drawn or (self.theta,)

    def tasks(self, scene: Scene, action: Action, seed: int, seeds: int, record_rate: float = 0.0) -> list[PourTask]:
        """The simulations of one pour: θ take turns, and vessels whose shape may be off have another each time.

        Args:
            seed: of the first one.
            seeds: how many; as many as θ where those are more.
            record_rate: frames of the first one [1/s].
        """
        from sim_engine.scene import PourTask

        turns, count = self.thetas, max(seeds, len(self.thetas))
        return [
            PourTask(scene.drawn(seed + i), action, turns[i % len(turns)], seed + i, 0.0 if i else record_rate)
            for i in range(count)
        ]

    def said(self, scene: Scene) -> str:
        """What the bands of a scene's pours hold, for people."""
        among = f"{len(self.drawn)} θ of the posterior" if self.drawn else "one θ"
        parts = ["seeds", among, f"{self.theta.particles} particles' resolution"]
        if scene.uncertain:
            parts.insert(1, "shapes that the vessels may have")
        if self.discrepancy is not None:
            parts.append("what calibration left over")
            return f"bands of {', '.join(parts[:-1])} and {parts[-1]}"
        return f"bands of {', '.join(parts[:-1])} and {parts[-1]} alone (no calibration says what it left over)"

    def as_json(self) -> dict[str, Any]:
        """The shifts behind the bands, JSON-ready."""
        from sim_engine.prediction_band import resolution_shift

        return {"discrepancy_shift": self.discrepancy, "resolution_shift": resolution_shift(self.theta.particles)}


def foretelling(plan: CampaignPlan, parameters: Path | None, thetas: int | None, seeds: int) -> PredictionInputs:
    """What the command line asks for.

    Args:
        plan: whose θ has what the file does not name.
        parameters: theta.json of a calibration, or somebody's own file; None: the campaign's θ.
        thetas: draws of the posterior; None: as many as `seeds` where the file has a posterior and recommends
            the calibrated θ; 0: θ alone.
        seeds: simulations of a pour.

    Raises:
        RefusalError: something is wrong with the file, or it has no posterior that was asked for (exit code 2).
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
