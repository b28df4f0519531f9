"""A real pour as a deployment remembers it, and how far pours were from what was predicted."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from actors.optimizer.core.problem import Point
from orchestrator.plan import ExistingPours
from orchestrator.requests import Prediction
from orchestrator.strategies.deployment.costs import Costing
from orchestrator.strategies.deployment.objectives import Vector
from orchestrator.strategies.display import displayed_action
from sim_engine.losses import normalised_spillage
from sim_engine.outcome import PourMeasurement
from sim_engine.space import Space
from sim_engine.task import Scene

TRUST_POURS = 5
TRUST_LIMIT = 3.0
"""Mean |z| of the first pours above which the predictions are called untrustworthy."""


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
    status: str = "pouring"
    reason: str = ""
    mishap: bool = False
    measurement: PourMeasurement | None = None
    vector: Vector | None = None

    def row(self, objectives: tuple[str, ...]) -> dict[str, object]:
        """As results have it; `objectives` are their names, where there are any."""
        weighed = self.measurement
        values = {} if self.vector is None else dict(zip(objectives, self.vector, strict=False))
        return {
            "number": self.number,
            "status": self.status,
            "reason": self.reason,
            "action": displayed_action(self.values),
            "action_si": self.values,
            "predicted": None if self.predicted is None else self.predicted.mean,
            "predicted_deviation": None if self.predicted is None else self.predicted.deviation,
            "predicted_scatter": None if self.predicted is None else self.predicted.scatter,
            "loss": self.cost,
            **({"objectives": values} if objectives else {}),
            "spillage": None if weighed is None else normalised_spillage(weighed.fractions),
            "spilled_g": None if weighed is None else weighed.spilled * 1e3,
            "retained_g": None if weighed is None else weighed.retained * 1e3,
        }


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


def trust(weighed: Sequence[PourTrial]) -> dict[str, object]:
    """How far the first pours were from what was predicted, in predicted deviations (noise included).

    A prior from an untrustworthy simulation makes D3 worse than no prior at all, so people should be told.
    """
    scores = []
    for trial in weighed[:TRUST_POURS]:
        if trial.predicted is not None and trial.cost is not None:
            spread = math.hypot(trial.predicted.deviation, trial.noise)
            scores.append((trial.cost - trial.predicted.mean) / max(spread, 1e-9))
    mean = sum(map(abs, scores)) / len(scores) if scores else None
    return {"z_scores": scores, "alarm": bool(len(scores) >= 3 and mean is not None and mean > TRUST_LIMIT)}
