"""A real pour as a deployment remembers it, and how far pours were from what was predicted."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from actors.optimizer.questions import Point
from orchestrator.requests import Decision, Failed, Outcome, Poured, Prediction
from orchestrator.strategies.campaign_plan import ExistingPours
from orchestrator.strategies.deployment.costing import Costing
from orchestrator.strategies.deployment.objectives import Vector
from orchestrator.strategies.stage_result import ResultPart, displayed_action
from orchestrator.strategies.strategy import is_sound
from sim_engine.liquids import Liquid
from sim_engine.outcome import PourMeasurement, normalised_spillage
from sim_engine.scene import Scene
from sim_engine.search_space import Space

TRUST_POURS = 5
TRUST_LIMIT = 3.0
"""Mean |z| of the first pours above which the predictions are called untrustworthy."""


Status = Literal["pouring", "weighed", "refused", "failed"]


class PourRow(ResultPart):
    """A real pour of a deployment: what was chosen and expected, and what came of it."""

    number: int
    """From 1; a refused one does not count, and the next one bears its number."""

    status: Status
    """'refused': an invalid action, nothing was poured. 'failed': something went wrong under way."""

    reason: str
    """Why it was refused or failed."""

    action: dict[str, float | None]
    """Searched dimensions in display units."""

    action_si: dict[str, float]
    """The same in SI."""

    predicted: float | None
    """Expected loss, in the loss' own unit; None where nothing was known."""

    predicted_deviation: float | None
    """How well that mean is known."""

    predicted_scatter: float | None
    """How much a single pour differs from it."""

    predicted_band: tuple[float, float] | None = None
    """Where nine pours in ten should lie; None where nothing was expected."""

    loss: float | None
    """In its own unit; of a failed pour the worst, where it counts."""

    objectives: dict[str, float]
    """Each by its name, where there are several."""

    spillage: float | None
    """r = spilled / poured; None below 5 % poured, and where nothing was weighed."""

    spilled_g: float | None
    """Beside the receiver."""

    retained_g: float | None
    """Left in the pourer."""

    delivered_g: float | None = None
    """In the receiver: what is neither beside it nor left in the pourer."""

    delivered_ml: float | None = None
    """The same by the liquid's density."""


class Foretold(ResultPart):
    """How far the first pours were from what was predicted."""

    z_scores: tuple[float, ...]
    """Weighed minus predicted loss, in standard deviations."""

    alarm: bool
    """They were so far from it that the predictions should not be trusted."""


@dataclass
class PourTrial:
    """A real pour: what was chosen and expected, and what came of it.

    Attributes:
        cost, vector: what enters the data, as one number and as objectives; None: nothing does.
        status: 'pouring', 'weighed', 'refused' (an invalid action: nothing was poured) or 'failed'.
        mishap: it failed under way, as it may where the vessels touch after all.
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
    vector: Vector | None = None

    def take(self, outcome: Outcome, scene: Scene, costing: Costing, *, penalised: bool) -> None:
        """What came of it.

        Args:
            outcome: the answer to its request.
            scene: it was made in.
            costing: says what it cost.
            penalised: a failed one enters the data with the worst cost, else not at all.

        Raises:
            ValueError: no pour is answered so.
        """
        match outcome:
            case Poured(measurement) if not is_sound(measurement.fractions):
                self.status, self.reason = "failed", "weighing: the balance gave no numbers"
            case Poured(measurement):
                self.vector = costing.poured(measurement, scene.action(self.values))
                self.cost, self.status = costing.total(self.vector), "weighed"
                self.measurement = measurement
            case Failed("invalid_action", reason):
                self.status, self.reason = "refused", reason
            case Failed(kind, reason):
                self.status, self.reason = "failed", f"{kind}: {reason}"
                self.mishap = kind == "pour_failed"
            case _:
                raise ValueError(f"a pour can't be answered by {type(outcome).__name__}")
        if self.status == "failed" and penalised:
            self.cost, self.vector = costing.worst, costing.worst_vector

    def row(self, objectives: tuple[str, ...], liquid: Liquid) -> PourRow:
        """As results have it; `objectives` are their names, where there are any, `liquid` is what was poured."""
        weighed, predicted = self.measurement, self.predicted
        return PourRow(
            number=self.number,
            status=self.status,
            reason=self.reason,
            action=displayed_action(self.values),
            action_si=self.values,
            predicted=None if predicted is None else predicted.mean,
            predicted_deviation=None if predicted is None else predicted.deviation,
            predicted_scatter=None if predicted is None else predicted.scatter,
            predicted_band=None if predicted is None else predicted.of_a_pour(),
            loss=self.cost,
            objectives={} if self.vector is None else dict(zip(objectives, self.vector, strict=False)),
            spillage=None if weighed is None else normalised_spillage(weighed.fractions),
            spilled_g=None if weighed is None else weighed.spilled * 1e3,
            retained_g=None if weighed is None else weighed.retained * 1e3,
            delivered_g=None if weighed is None else weighed.delivered * 1e3,
            delivered_ml=None if weighed is None else liquid.millilitres(weighed.delivered),
        )


def expecting(text: str, prediction: Prediction) -> Decision:
    """A decision with what is expected of it, in words and numbers."""
    expected = {"mean": prediction.mean, "sd": prediction.deviation}
    text += f"  predicted {max(prediction.mean, 0.0):.4g} ± {prediction.deviation:.2g}"
    if prediction.scatter is not None:
        expected["scatter"] = prediction.scatter
        text += f", a pour scatters by {prediction.scatter:.2g}"
    if prediction.band is not None:
        expected["low"], expected["high"] = prediction.band
        text += f", nine pours in ten lie between {prediction.band[0]:.2g} and {prediction.band[1]:.2g}"
    return Decision(text, expected)


def former_pours(
    data: ExistingPours, scene: Scene, actions: Space, costing: Costing
) -> tuple[tuple[Point, Vector], ...]:
    """Place and objectives of the pours of before the campaign in a scene."""
    found = []
    for pour in data.pours.get(scene.name, ()):
        unit = actions.encode({name: getattr(pour.action, name) for name in actions.names})
        point = tuple(min(max(float(u), 0.0), 1.0) for u in unit)
        measured = PourMeasurement(pour.poured + pour.retained, pour.spilled, pour.retained)
        found.append((point, costing.poured(measured, pour.action)))
    return tuple(found)


def trust(weighed: Sequence[PourTrial]) -> Foretold:
    """How far the first pours were from what was predicted, in predicted deviations (noise included).

    A prior from an untrustworthy simulation makes D3 worse than no prior at all, so people should be told.
    """
    scores = []
    for trial in weighed[:TRUST_POURS]:
        if trial.predicted is not None and trial.cost is not None:
            spread = math.hypot(trial.predicted.deviation, trial.noise)
            scores.append((trial.cost - trial.predicted.mean) / max(spread, 1e-9))
    mean = sum(map(abs, scores)) / len(scores) if scores else None
    return Foretold(z_scores=tuple(scores), alarm=len(scores) >= 3 and mean is not None and mean > TRUST_LIMIT)
