"""What the weighed pours of a calibration show about the simulator, as evidence for D3 in another scene.

`calibration_evidence` selects the pours that say something about a deployment and pairs each with its simulation. The
optimiser weighs its hypotheses with them (`actors.optimizer.model_discrepancy`).

The pours enter with three corrections:

- A fitted θ flatters its training pours. Their differences are divided by 1 − p / n, with p parameters and n pours, as
  generalised cross-validation does instead of leaving out each pour.
- Errors in another receiver are larger, see `TRANSFER`.
- A calibration can mislead altogether; the optimiser keeps a share of its prior without any calibration.

Source: Golub, Heath & Wahba, Generalized cross-validation as a method for choosing a good ridge parameter,
Technometrics 1979.
Limitations: a simulated spillage is converted to a cost with the liquid that the weighed pour retained. Offsets that
the posterior of θ has determined from the same pours enter the hypotheses separately.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from actors.optimizer.questions import CalibrationPours, Point
from orchestrator.learning.calibration.calibration_scores import (
    CALIBRATED,
    UNCALIBRATED,
    ScoredPair,
    ScoredPour,
    Scores,
)
from orchestrator.learning.campaign_plan import CalibrationEvidence, CalibrationPlan, DeploymentPlan, MeasuredPour
from orchestrator.learning.deployment.costing import Costing
from sim_engine.action import Action
from sim_engine.liquids import SimulationParameters
from sim_engine.outcome import PourMeasurement
from sim_engine.prediction_band import scene_digest
from sim_engine.scene import Scene
from sim_engine.search_space import Space

TRANSFER = 1.09**-2
"""Exponent of the likelihood of pours into another receiver. Errors there are 1.09 times as large: the ratio of the
root mean square shifts (`sim_engine.prediction_band`) between recorded and predicted spillages of 240 pours into
another receiver and of 60 test pours, by 15 calibrations in docs/data/recorded-predictions.json. A normal likelihood of
errors that much wider is the likelihood to this power, up to its normalisation (power prior: Ibrahim & Chen,
Statistical Science 2000)."""

LEAST_POURS = 2
"""Number of pours in a scene from which they are used; their simulations need a surrogate."""

MOST_POURS = 40
"""Number of pours in a scene that are used at most, evenly spread: every hypothesis factorises their covariance."""

BEYOND = 1.0
"""Distance from the deployment's actions up to which a pour is used, in units of their range."""


@dataclass(frozen=True)
class _Pair:
    """A weighed pour at a point of the deployment's actions, with both costs."""

    point: Point
    cost: float
    simulated: float


def calibration_evidence(
    deployment: DeploymentPlan,
    scene: Scene,
    parameters: SimulationParameters,
    calibration: CalibrationPlan,
    weighed: Sequence[ScoredPour],
    scores: Scores,
    searched: int,
) -> CalibrationEvidence:
    """The weighed pours of an evaluated calibration, each with its simulation by the recommended θ.

    Args:
        deployment: whose cost and searched actions the pours are converted to.
        scene: of the deployment.
        parameters: the recommended θ.
        calibration: plan of the calibration, with the scenes of its pours.
        weighed: all weighed pours that were evaluated, in the order in which the evaluation received them.
        scores: result of the evaluation.
        searched: number of parameters that were fitted.
    """
    plain = scores.gain is not None and scores.gain.recommended == UNCALIBRATED and UNCALIBRATED in scores.thetas
    usable = [scored for scored in weighed if scored.pour.spillage is not None]
    usable.sort(key=lambda scored: scored.pour.split == "train")  # the order of the evaluation: unseen pours first
    pairs = [pair for pair in scores.pairs if pair.theta == (UNCALIBRATED if plain else CALIBRATED)]
    both = [rows for rows in zip(usable, pairs, strict=True) if rows[1].simulated is not None]
    train, fitted = sum(pair.split == "train" for _, pair in both), 0 if plain else searched
    lines: list[str] = []
    if 0 < train <= fitted:
        lines.append(f"not used: {train} training pours of the calibration, to which {fitted} parameters were fitted")
        both = [(scored, pair) for scored, pair in both if pair.split != "train"]
    scenes = {place.name: place for place in calibration.poured}
    scenes |= {records.scene.name: records.scene for records in (calibration.records, calibration.transfer) if records}
    groups: list[CalibrationPours] = []
    for name in dict.fromkeys(scored.scene for scored, _ in both):
        at, rows = scenes[name], [(scored.pour, pair) for scored, pair in both if scored.scene == name]
        costing, shrunk = Costing.of(deployment, at, parameters), 1.0 - fitted / max(train, 1)
        near = [known for pour, pair in rows if (known := _pair(deployment.actions, costing, pour, pair, shrunk))]
        into, outside = f"calibration pours into {at.receiver.name}", len(rows) - len(near)
        count = min(len(near), MOST_POURS)
        used = [near[i * len(near) // count] for i in range(count)]
        if at.liquid.model_copy(update={"name": scene.liquid.name}) != scene.liquid:
            lines.append(f"not used: {len(rows)} {into}: another liquid or amount")
        elif at.pourer.shape != scene.pourer.shape:
            lines.append(f"not used: {len(rows)} {into}: poured from another vessel")
        elif len(near) < LEAST_POURS:
            text = f"only {len(near)} are close to the deployment's actions, and {LEAST_POURS} are needed"
            lines.append(f"not used: {len(rows)} {into}: {text}")
        else:
            same = (digest := scene_digest(at)) is not None and digest == scene_digest(scene)
            groups.append(
                CalibrationPours(
                    tuple(known.point for known in used),
                    tuple(known.cost for known in used),
                    tuple(known.simulated for known in used),
                    1.0 if same else TRANSFER,
                )
            )
            error = math.fsum(abs(known.cost - known.simulated) for known in used) / len(used) / costing.worst
            missed = f"the simulator misses {len(used)} {into} by {100 * error:.1f} % of the largest loss on average"
            lines.append(f"{missed}; the first predictions are based on this")
            if count < len(near):
                lines.append(f"not used: {len(near) - count} {into}: {MOST_POURS} of them are enough")
            if outside:
                lines.append(f"not used: {outside} {into}: far from the deployment's actions")
    return CalibrationEvidence(tuple(groups), tuple(lines))


def _pair(actions: Space, costing: Costing, pour: MeasuredPour, pair: ScoredPair, shrunk: float) -> _Pair | None:
    """A pour as evidence; None if its action is far from the space, or has no value along an axis.

    Args:
        shrunk: factor by which the fit has reduced the differences of training pours.
    """
    values = {name: getattr(pour.action, name) for name in actions.names}
    if pair.measured is None or pair.simulated is None or None in values.values():
        return None
    point = tuple(float(u) for u in actions.encode(values))
    if not all(-BEYOND <= u <= 1.0 + BEYOND for u in point):
        return None
    difference = (pair.simulated - pair.measured) / (shrunk if pair.split == "train" else 1.0)
    simulated = min(max(pair.measured + difference, 0.0), 1.0)
    return _Pair(point, *(_cost(costing, pour.action, pour.poured, r) for r in (pair.measured, simulated)))


def _cost(costing: Costing, action: Action, poured: float, spillage: float) -> float:
    """Cost of a pour of which a fraction `poured` has left the pourer, `spillage` of it spilled."""
    return costing.total(costing.poured(PourMeasurement(1.0, spillage * poured, 1.0 - poured), action))
