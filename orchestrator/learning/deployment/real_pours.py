"""Real pours of a deployment: their records, their conversion to data, and a check of their predictions.

- `DeploymentTrial` is a pour with its prediction and outcome; `DeploymentRow` is its form in results.
- `prior_pours` converts pours from before the campaign.
- `trust` compares the first pours with their predictions.
- `scaled_interval` corrects the width of a prediction interval by the deviations of earlier pours.

The module requests no pours.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from actors.optimizer.questions import Point
from orchestrator.learning.campaign_plan import ExistingPours
from orchestrator.learning.deployment.costing import Costing
from orchestrator.learning.requests import Decision, Failed, Outcome, Poured, Prediction
from orchestrator.learning.stage_result import ResultPart, WeighedMasses, displayed_action, weighed_masses
from orchestrator.learning.strategy import is_sound
from sim_engine.action import Action
from sim_engine.liquids import Liquid
from sim_engine.outcome import PourMeasurement
from sim_engine.scene import Scene
from sim_engine.search_space import Space

TRUST_POURS = 5
TRUST_LIMIT = 3.0
"""Mean |z| of the first pours above which the predictions are reported as unreliable."""

PRIOR_POURS = 2.0
"""Number of pours with the predicted deviation that `scaled_interval` adds to those made."""

LARGEST_Z = 3.0
"""Largest |z| that counts in `scaled_interval`: one pour outside does not make all later intervals useless."""


Status = Literal["pouring", "weighed", "refused", "failed", "added"]


class DeploymentRow(WeighedMasses):
    """A real pour of a deployment: its action, its prediction and its outcome."""

    number: int
    """Number from 1 among the requested pours, refused ones included. 0: added by hand."""

    status: Status
    """'refused': an invalid action, nothing was poured. 'failed': an error occurred during the pour or the weighing.
    'added': made and weighed without being asked for."""

    reason: str
    """Reason of the refusal or failure."""

    action: dict[str, float | None]
    """Searched dimensions in display units."""

    action_si: dict[str, float]
    """Searched dimensions in SI units."""

    predicted: float | None
    """Expected loss, in the unit of the loss; None without a prediction."""

    predicted_deviation: float | None
    """Standard deviation of the expected loss."""

    predicted_scatter: float | None
    """Scatter of a single pour around the expected loss."""

    predicted_interval: tuple[float, float] | None = None
    """Interval that should contain nine pours in ten; None without a prediction."""

    loss: float | None
    """Loss in its own unit; the worst loss for a failed pour that is penalised."""

    delivered_ml: float | None = None
    """The delivered mass as a volume [ml], from the liquid's density."""


class PredictionCheck(ResultPart):
    """Deviation of the first pours from their predictions."""

    z_scores: tuple[float, ...]
    """Weighed minus predicted loss, in standard deviations."""

    alarm: bool
    """Whether the deviation is so large that the predictions are unreliable."""


@dataclass
class DeploymentTrial:
    """A real pour: its action, its prediction and its outcome.

    Attributes:
        cost: value for the data; None: the pour adds no data.
        status: 'pouring', 'weighed', 'refused' (an invalid action: nothing was poured), 'failed', or 'added' (not
            asked for).
        mishap: whether the pour failed during its execution, for example because the vessels touched.
    """

    number: int
    point: Point
    values: dict[str, float]
    predicted: Prediction | None
    noise: float
    cost: float | None = None
    status: Status = "pouring"
    reason: str = ""
    mishap: bool = False
    measurement: PourMeasurement | None = None

    def take(self, outcome: Outcome, scene: Scene, costing: Costing, *, penalised: bool) -> None:
        """Record the outcome; it replaces an earlier one.

        Args:
            outcome: answer to the request.
            scene: scene of the pour.
            costing: converts the outcome to a cost.
            penalised: whether a failed pour enters the data with the worst cost; otherwise it adds no data.

        Raises:
            ValueError: the outcome is not one of a pour.
        """
        self.cost = self.measurement = None
        self.reason, self.mishap = "", False
        match outcome:
            case Poured(measurement) if not is_sound(measurement.fractions):
                self.status, self.reason = "failed", "weighing: the balance gave no numbers"
            case Poured(measurement):
                self.cost, self.status = costing.poured(measurement, scene.action(self.values)), "weighed"
                self.measurement = measurement
            case Failed("invalid_action", reason):
                self.status, self.reason = "refused", reason
            case Failed(kind, reason):
                self.status, self.reason = "failed", f"{kind}: {reason}"
                self.mishap = kind == "pour_failed"
            case _:
                raise ValueError(f"a pour can't be answered by {type(outcome).__name__}")
        if self.status == "failed" and penalised:
            self.cost = costing.worst

    def row(self, liquid: Liquid) -> DeploymentRow:
        """The pour's form in results."""
        weighed, predicted = self.measurement, self.predicted
        return DeploymentRow(
            number=self.number,
            status=self.status,
            reason=self.reason,
            action=displayed_action(self.values),
            action_si=self.values,
            predicted=None if predicted is None else predicted.mean,
            predicted_deviation=None if predicted is None else predicted.deviation,
            predicted_scatter=None if predicted is None else predicted.scatter,
            predicted_interval=None if predicted is None else predicted.of_a_pour(),
            loss=self.cost,
            **weighed_masses(weighed).model_dump(),
            delivered_ml=None if weighed is None else liquid.millilitres(weighed.delivered),
        )


def expecting(text: str, prediction: Prediction) -> Decision:
    """A decision with its prediction as text and numbers."""
    expected = {"mean": prediction.mean, "sd": prediction.deviation}
    text += f"  predicted {max(prediction.mean, 0.0):.4g} ± {prediction.deviation:.2g}"
    if prediction.scatter is not None:
        expected["scatter"] = prediction.scatter
        text += f", a pour scatters by {prediction.scatter:.2g}"
    if prediction.band is not None:
        expected["low"], expected["high"] = prediction.band
        text += f", nine pours in ten lie between {prediction.band[0]:.2g} and {prediction.band[1]:.2g}"
    return Decision(text, expected)


def prior_pours(data: ExistingPours, scene: Scene, actions: Space, costing: Costing) -> tuple[tuple[Point, float], ...]:
    """Points and costs of the pours from before the campaign in a scene."""
    pours = []
    for pour in data.pours.get(scene.name, ()):
        measured = PourMeasurement(pour.poured + pour.retained, pour.spilled, pour.retained)
        pours.append((point_of(pour.action, actions), costing.poured(measured, pour.action)))
    return tuple(pours)


def point_of(action: Action, actions: Space) -> Point:
    """An action inside the search space, up to rounding, as a point."""
    unit = actions.encode({name: getattr(action, name) for name in actions.names})
    return tuple(min(max(float(u), 0.0), 1.0) for u in unit)


def scaled_interval(prediction: Prediction, earlier: Sequence[DeploymentTrial], worst: float) -> tuple[float, float]:
    """The prediction interval of a pour, scaled by the deviations of the campaign's earlier pours.

    The factor is the root mean square of their z, (loss − predicted mean) / predicted standard deviation (of a single
    pour). It begins at 1 and tends to the measured value as pours are made. An interval that begins at 0 or ends at the
    largest loss still does: a pour may lose nothing, or everything, with a probability of its own.

    Args:
        prediction: prediction of the pour, with its interval.
        earlier: pours with their predictions; those without an outcome do not count.
        worst: largest possible loss.
    """
    low, high = prediction.of_a_pour()
    squares = [min(abs(z), LARGEST_Z) ** 2 for z in _z_scores(earlier)]
    factor = math.sqrt((PRIOR_POURS + sum(squares)) / (PRIOR_POURS + len(squares)))
    mean = min(max(prediction.mean, low), high)
    begin = 0.0 if low <= 0.0 else max(mean - factor * (mean - low), 0.0)
    return begin, worst if high >= worst else min(mean + factor * (high - mean), worst)


def _z_scores(pours: Sequence[DeploymentTrial]) -> list[float]:
    """Loss minus predicted mean of the pours that have both, in standard deviations of a single pour."""
    return [
        (trial.cost - trial.predicted.mean) / max(math.hypot(trial.predicted.deviation, trial.noise), 1e-9)
        for trial in pours
        if trial.predicted is not None and trial.cost is not None
    ]


def trust(weighed: Sequence[DeploymentTrial]) -> PredictionCheck:
    """Compare the first pours with their predictions, in predicted standard deviations (noise included).

    An inaccurate simulator makes D3 worse than no prior at all. The user is therefore warned.
    """
    scores = _z_scores(weighed[:TRUST_POURS])
    mean = sum(map(abs, scores)) / len(scores) if scores else None
    return PredictionCheck(z_scores=tuple(scores), alarm=len(scores) >= 3 and mean is not None and mean > TRUST_LIMIT)
