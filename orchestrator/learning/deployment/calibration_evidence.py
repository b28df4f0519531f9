"""What the weighed pours of calibrations show about the simulator, as evidence for D3 in another scene.

`calibration_evidence` selects the pours of the same campaign that say something about a deployment and pairs each with
its simulation, `memory_evidence` those of earlier campaigns. The optimiser weighs its hypotheses with them
(`actors.optimizer.model_discrepancy`).

The pours enter with three corrections:

- A fitted θ flatters its training pours. Their differences are divided by 1 − p / n, with p parameters and n pours, as
  generalised cross-validation does instead of leaving out each pour.
- Errors in another receiver are larger, see `TRANSFER`.
- A calibration can mislead altogether; the optimiser keeps a share of its prior without any calibration.

Source: Golub, Heath & Wahba, Generalized cross-validation as a method for choosing a good ridge parameter,
Technometrics 1979.
Limitations: a simulated spillage is converted to a cost with the liquid that the weighed pour retained. Of training
pours into the receiver that is deployed into, the simulator's error is overstated by the same factor. Offsets that
the posterior of θ has determined from the same pours enter the hypotheses separately.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from actors.optimizer.questions import SceneEvidence
from orchestrator.learning.calibration.calibration_scores import (
    CALIBRATED,
    UNCALIBRATED,
    ScoredPair,
    ScoredPour,
    Scores,
)
from orchestrator.learning.calibration.campaign_memory import RELIANCE, CampaignMemory, WeighedPair
from orchestrator.learning.campaign_plan import CalibrationEvidence, CalibrationPlan, DeploymentPlan
from orchestrator.learning.deployment.costing import Costing
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


def weighed_pairs(weighed: Sequence[ScoredPour], pairs: Sequence[ScoredPair], fitted: int) -> list[WeighedPair]:
    """The weighed pours of an evaluation, each with the simulation of a θ that was fitted without it.

    Args:
        weighed: all weighed pours that were evaluated, in the order in which the evaluation received them.
        pairs: of one θ, in the evaluation's order.
        fitted: number of parameters that were fitted to the training pours, which are left out if they are no more.
    """
    usable = [scored for scored in weighed if scored.pour.spillage is not None]
    usable.sort(key=lambda scored: scored.pour.split == "train")  # the order of the evaluation: unseen pours first
    train = sum(pair.split == "train" and pair.simulated is not None for pair in pairs)
    matched = []
    for scored, pair in zip(usable, pairs, strict=True):
        if pair.measured is None or pair.simulated is None or (pair.split == "train" and train <= fitted):
            continue
        shrunk = 1.0 - fitted / train if pair.split == "train" else 1.0  # the fit has reduced the difference by it
        simulated = min(max(pair.measured + (pair.simulated - pair.measured) / shrunk, 0.0), 1.0)
        matched.append(WeighedPair(scored.scene, scored.pour.action, scored.pour.poured, pair.measured, simulated))
    return matched


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
        weighed: see `weighed_pairs`.
        scores: result of the evaluation.
        searched: number of parameters that were fitted.
    """
    plain = scores.gain is not None and scores.gain.recommended == UNCALIBRATED and UNCALIBRATED in scores.thetas
    chosen = [pair for pair in scores.pairs if pair.theta == (UNCALIBRATED if plain else CALIBRATED)]
    train = sum(pair.split == "train" and pair.simulated is not None for pair in chosen)
    evidence = CalibrationEvidence()
    if not plain and 0 < train <= searched:
        text = f"not used: {train} training pours of the calibration, to which {searched} parameters were fitted"
        evidence = CalibrationEvidence(lines=(text,))
    pairs = weighed_pairs(weighed, chosen, 0 if plain else searched)
    scenes = {place.name: place for place in calibration.poured}
    scenes |= {records.scene.name: records.scene for records in (calibration.records, calibration.transfer) if records}
    for name in dict.fromkeys(pair.into for pair in pairs):
        at, rows = scenes[name], [pair for pair in pairs if pair.into == name]
        into = f"calibration pours into {at.receiver.name}"
        if at.liquid.model_copy(update={"name": scene.liquid.name}) != scene.liquid:
            evidence += CalibrationEvidence(lines=(f"not used: {len(rows)} {into}: another liquid or amount",))
        elif at.pourer.shape != scene.pourer.shape:
            evidence += CalibrationEvidence(lines=(f"not used: {len(rows)} {into}: poured from another vessel",))
        else:
            same = (digest := scene_digest(at)) is not None and digest == scene_digest(scene)
            costing = Costing.of(deployment, at, parameters)
            evidence += _evidence(deployment.actions, costing, rows, into, 1.0 if same else TRANSFER)
    return evidence


def memory_evidence(
    deployment: DeploymentPlan, scene: Scene, parameters: SimulationParameters, memory: CampaignMemory
) -> CalibrationEvidence:
    """The weighed pours of earlier campaigns, each with its simulation by the θ* of its own campaign.

    Everything was set up again since then. So the errors of all are those of another receiver, and with the probability
    1 − `RELIANCE`, with which a calibration doubts a memory, too, they say nothing.
    """
    evidence, pours = CalibrationEvidence(), memory.pours or ()
    costing = Costing.of(deployment, scene, parameters)
    for name in dict.fromkeys(pair.into for pair in pours):
        rows = [pair for pair in pours if pair.into == name]
        evidence += _evidence(deployment.actions, costing, rows, f"pours of {name}", TRANSFER, 1.0 - RELIANCE)
    return evidence


def _evidence(
    actions: Space, costing: Costing, pairs: Sequence[WeighedPair], into: str, power: float, misled: float | None = None
) -> CalibrationEvidence:
    """The pours of one scene that are close to the deployment's actions."""
    near = []
    for pair in pairs:
        values = {name: getattr(pair.action, name) for name in actions.names}
        if None not in values.values():
            point = tuple(float(u) for u in actions.encode(values))
            if all(-BEYOND <= u <= 1.0 + BEYOND for u in point):
                near.append((point, *(_cost(costing, pair, spillage) for spillage in (pair.measured, pair.simulated))))
    if len(near) < LEAST_POURS:
        text = f"only {len(near)} are close to the deployment's actions, and {LEAST_POURS} are needed"
        return CalibrationEvidence(lines=(f"not used: {len(pairs)} {into}: {text}",))
    count = min(len(near), MOST_POURS)
    points, costs, simulated = zip(*(near[i * len(near) // count] for i in range(count)), strict=True)
    error = math.fsum(abs(a - b) for a, b in zip(costs, simulated, strict=True)) / count / costing.worst
    missed = f"the simulator misses {count} {into} by {100 * error:.1f} % of the largest loss on average"
    lines = [f"{missed}; the first predictions are based on this"]
    if count < len(near):
        lines.append(f"not used: {len(near) - count} {into}: {MOST_POURS} of them are enough")
    if outside := len(pairs) - len(near):
        lines.append(f"not used: {outside} {into}: far from the deployment's actions")
    return CalibrationEvidence((SceneEvidence(points, costs, simulated, power, misled),), tuple(lines))


def _cost(costing: Costing, pair: WeighedPair, spillage: float) -> float:
    """Cost of a pour if it had spilled this fraction of the liquid that left the pourer."""
    measurement = PourMeasurement(1.0, spillage * pair.poured, 1.0 - pair.poured)
    return costing.poured(measurement, pair.action)
