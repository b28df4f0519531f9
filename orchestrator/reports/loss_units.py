"""Display units of losses: fractions in percent, masses in grams."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import cast, get_args

from orchestrator.learning.campaign_plan import CampaignPlan, DeploymentPlan
from orchestrator.learning.deployment.costing import Costing
from orchestrator.learning.requests import Pour, Prediction
from orchestrator.records.run_record import RunPour
from sim_engine.outcome import Loss, LossName, PourMeasurement


@dataclass(frozen=True)
class LossUnit:
    """Display unit of a loss.

    Attributes:
        label: axis label, with the unit.
        unit: '%', 'g' or 'particles'.
        factor: displayed value over the loss's own value.
    """

    label: str
    unit: str
    factor: float

    def text(self, value: float, deviation: float | None = None) -> str:
        """A displayed value, from the loss's own unit: '1.2 %', or as a prediction '1.2 ± 0.9 %'."""
        if deviation is None:
            return f"{self.factor * value:.{self.decimals}f} {self.unit}"
        number = f"{self.factor * at_least_nothing(value):.{self.decimals}f}"
        number += f" ± {self.factor * deviation:.{self.decimals}f}"
        return f"{number} {self.unit}"

    def prediction(self, predicted: Prediction) -> str:
        """'1.2 ± 0.9 %, a pour ± 0.5 %': deviation of the mean, and deviation of a single pour.

        If its prediction interval is known: '1.2 ± 0.9 %, a pour: 0.0 … 3.1 %'. A mean that is less certain than the
        interval is wide depends on pours outside of it: '1.2 ± 4.3 %, a pour: 0.0 … 3.1 %, seldom far more'.
        """
        expected = self.text(predicted.mean, predicted.deviation)
        if predicted.band is None:
            return expected + self.scatter(predicted.scatter)
        low, high = (f"{self.factor * end:.{self.decimals}f}" for end in predicted.band)
        tail = ", seldom far more" if predicted.deviation > predicted.band[1] - predicted.band[0] else ""
        return f"{expected}, a pour: {low} … {high} {self.unit}{tail}"

    def scatter(self, deviation: float | None) -> str:
        """The end of a prediction: ', a pour ± 0.5 %'; empty if unknown."""
        if deviation is None:
            return ""
        return f", a pour ± {self.factor * deviation:.{self.decimals}f} {self.unit}"

    @property
    def meaning(self) -> str:
        """The label without the unit: 'spilled / poured'."""
        return self.label.removesuffix(f" [{self.unit}]")

    @property
    def decimals(self) -> int:
        """Significant decimal places: 0.01 % or g (20 mg of 200 g), whole particles."""
        return 0 if self.unit == "particles" else 2


def at_least_nothing(predicted: float) -> float:
    """A predicted loss or discrepancy for display. These are never negative, but a surrogate can predict negative
    values."""
    return max(predicted, 0.0)


def loss_unit(loss: Loss) -> LossUnit:
    """Display unit of a deployment loss."""
    match loss.name:
        case "spilled_and_retained":
            retained = "retained" if loss.retained_weight == 1.0 else f"{loss.retained_weight:g} × retained"
            return LossUnit(f"(spilled + {retained}) / loaded [%]", "%", 100.0)
        case "normalised":
            return LossUnit("spilled / poured [%]", "%", 100.0)
        case "grams":
            return LossUnit("spilled [g]", "g", 1.0)
        case "particles":
            return LossUnit("spilled [particles]", "particles", 1.0)


def named_loss_unit(name: str) -> LossUnit:
    """Display unit of a loss that is known only by name; other names are shares."""
    names: tuple[str, ...] = get_args(LossName)
    return loss_unit(Loss(name=cast("LossName", name))) if name in names else SPILLAGE


def deployment_unit(plan: DeploymentPlan) -> LossUnit:
    """Display unit of a deployment's loss, or of its objective."""
    if plan.objective is None:
        return loss_unit(plan.loss)
    return LossUnit(f"{plan.objective.name.replace('_', ' ')} [%]", "%", 100.0)


def largest_loss(plan: DeploymentPlan) -> float:
    """Maximum of a deployment's loss, in its own unit; infinite if it depends on the load."""
    if plan.objective is not None or plan.loss.name in ("grams", "particles"):
        return math.inf
    return max(plan.loss.retained_weight, 1.0) if plan.loss.name == "spilled_and_retained" else 1.0


DISCREPANCY = LossUnit("|measured − simulated| spillage [%]", "%", 100.0)
"""Display unit of a discrepancy Δ."""

SPILLAGE = LossUnit("spilled / poured [%]", "%", 100.0)
"""Display unit of a calibration pour's spillage r."""


DOSE = LossUnit("|received − wanted| [g]", "g", 1e3)
"""Display unit of a dose's error."""


def is_calibration(plan: CampaignPlan, pour: Pour) -> bool:
    """Whether a pour of a campaign serves calibration, see `Pour.calibrates`."""
    return plan.pour is None and pour.calibrates(
        () if plan.deployment is None else [scene.name for scene in plan.deployment.scenes]
    )


def unit_of_pour(plan: CampaignPlan, pour: Pour) -> LossUnit:
    """Display unit of a pour's loss."""
    if pour.dose is not None:
        return DOSE
    if plan.deployment is None or is_calibration(plan, pour):
        return SPILLAGE
    return deployment_unit(plan.deployment)


def minimised_loss(plan: CampaignPlan, pour: RunPour) -> float | None:
    """Measured loss of a pour that a deployment minimises; None for others, and if it is undefined."""
    if pour.measured is None or pour.request.dose is not None or is_calibration(plan, pour.request):
        return None
    return loss_of_pour(plan, pour.request, pour.measured)


def loss_of_pour(plan: CampaignPlan, pour: Pour, measured: PourMeasurement) -> float | None:
    """Measured loss of a pour in its own unit; None if it is undefined (too little poured)."""
    if pour.dose is not None:
        return abs(measured.delivered - pour.dose.amount)
    if plan.deployment is None or is_calibration(plan, pour):
        return measured.fractions.spillage
    if plan.deployment.objective is not None:
        scene = next(scene for scene in plan.deployment.scenes if scene.name == pour.scene)
        costing = Costing.of(plan.deployment, scene, plan.parameters)
        return costing.poured(measured, pour.action)
    return plan.deployment.loss(measured.fractions, loaded_mass=measured.loaded, particles=plan.parameters.particles)
