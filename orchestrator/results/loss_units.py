"""A loss as people read it: fractions in percent, masses in grams."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import cast, get_args

from orchestrator.requests import Pour, Prediction
from orchestrator.strategies.campaign_plan import CampaignPlan, DeploymentPlan
from orchestrator.strategies.deployment.costing import Costing
from sim_engine.outcome import Loss, LossName, PourMeasurement, normalised_spillage


@dataclass(frozen=True)
class LossUnit:
    """How a loss is shown.

    Attributes:
        label: what an axis says, with the unit.
        unit: '%', 'g' or 'particles'.
        factor: shown value over the loss' own value.
    """

    label: str
    unit: str
    factor: float

    def text(self, value: float, deviation: float | None = None) -> str:
        """A value for people, from the loss' own unit: '1.2 %', or as a prediction '1.2 ± 0.9 %'."""
        if deviation is None:
            return f"{self.factor * value:.{self.decimals}f} {self.unit}"
        number = f"{self.factor * at_least_nothing(value):.{self.decimals}f}"
        number += f" ± {self.factor * deviation:.{self.decimals}f}"
        return f"{number} {self.unit}"

    def prediction(self, predicted: Prediction) -> str:
        """'1.2 ± 0.9 %, a pour ± 0.5 %': how well the mean is known, and how much a single pour differs from it.

        Where its band is known: '1.2 ± 0.9 %, a pour: 0.0 … 3.1 %'.
        """
        expected = self.text(predicted.mean, predicted.deviation)
        if predicted.band is None:
            return expected + self.scatter(predicted.scatter)
        low, high = (f"{self.factor * end:.{self.decimals}f}" for end in predicted.band)
        return f"{expected}, a pour: {low} … {high} {self.unit}"

    def scatter(self, deviation: float | None) -> str:
        """The end of a prediction: ', a pour ± 0.5 %'; empty if nobody knows."""
        if deviation is None:
            return ""
        return f", a pour ± {self.factor * deviation:.{self.decimals}f} {self.unit}"

    @property
    def meaning(self) -> str:
        """The label without the unit: 'spilled / poured'."""
        return self.label.removesuffix(f" [{self.unit}]")

    @property
    def decimals(self) -> int:
        """Places after the point that mean something: 0.01 % or g (20 mg of 200 g), whole particles."""
        return 0 if self.unit == "particles" else 2


def at_least_nothing(predicted: float) -> float:
    """A predicted loss or discrepancy as it is shown. None is negative; a surrogate, which doesn't know, may say so."""
    return max(predicted, 0.0)


def loss_unit(loss: Loss) -> LossUnit:
    """How to show a deployment loss."""
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
    """How to show a loss of which only the name is known; what isn't one is a share."""
    names: tuple[str, ...] = get_args(LossName)
    return loss_unit(Loss(cast("LossName", name))) if name in names else SPILLAGE


def deployment_unit(plan: DeploymentPlan) -> LossUnit:
    """How to show what a deployment minimises, a loss or a weighted sum of objectives."""
    if plan.objectives is None:
        return loss_unit(plan.loss)
    weights = [(part.weight, part.name.replace("_", " ")) for part in plan.objectives.parts]
    return LossUnit(f"{' + '.join(n if w == 1.0 else f'{w:g} × {n}' for w, n in weights)} [%]", "%", 100.0)


def largest_loss(plan: DeploymentPlan) -> float:
    """What a deployment's loss can be at most, in its own unit; infinite where that depends on the load."""
    if plan.objectives is not None or plan.loss.name in ("grams", "particles"):
        return math.inf
    return max(plan.loss.retained_weight, 1.0) if plan.loss.name == "spilled_and_retained" else 1.0


DISCREPANCY = LossUnit("|measured − simulated| spillage [%]", "%", 100.0)
"""How a discrepancy Δ is shown."""

SPILLAGE = LossUnit("spilled / poured [%]", "%", 100.0)
"""How a calibration pour's spillage r is shown."""


def is_calibration(plan: CampaignPlan, pour: Pour) -> bool:
    """Whether a pour serves calibration: it is compared with simulations, not minimised."""
    deployed = {scene.name for scene in plan.deployment.scenes} if plan.deployment is not None else set()
    return pour.purpose == "calibration" or pour.scene not in deployed


def unit_of_pour(plan: CampaignPlan, pour: Pour) -> LossUnit:
    """How the loss of a pour is shown."""
    if plan.deployment is None or is_calibration(plan, pour):
        return SPILLAGE
    return deployment_unit(plan.deployment)


def loss_of_pour(plan: CampaignPlan, pour: Pour, measured: PourMeasurement) -> float | None:
    """Measured loss of a pour in its own unit; None where it is undefined (too little poured)."""
    if plan.deployment is None or is_calibration(plan, pour):
        return normalised_spillage(measured.fractions)
    if plan.deployment.objectives is not None:
        scene = next(scene for scene in plan.deployment.scenes if scene.name == pour.scene)
        costing = Costing.of(plan.deployment, scene, plan.parameters)
        return costing.total(costing.poured(measured, pour.action))
    return plan.deployment.loss(measured.fractions, loaded_mass=measured.loaded, particles=plan.parameters.particles)
