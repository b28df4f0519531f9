"""The stages of a campaign: their order, their strategies, and the earlier results that each strategy receives.

`stages_of` returns one `StageDefinition` per stage: designed pours, calibration, evaluation, then deployment and
confirmation for each receiver. `stage_seed` derives each stage's seed. The module does not run stages
(`orchestrator.runs.stage_scheduler`).
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from actors.dosing.dose_estimator import calibrated_knowledge
from actors.interfaces import DoseKnowledge
from orchestrator.campaigns.dose_flows import simulated_knowledge
from orchestrator.learning.calibration.action_prior import Contexts, drawn_worlds
from orchestrator.learning.calibration.active_design import ActiveDesign
from orchestrator.learning.calibration.calibration_base import Calibrated, CalibratedTheta, TriedOnAll
from orchestrator.learning.calibration.calibration_scores import (
    DRAWS,
    UNCALIBRATED,
    CalibrationEvaluation,
    ScoredPour,
    Scores,
    calibration_residual,
    random_parameters,
    recommended_theta,
)
from orchestrator.learning.calibration.pour_design import DesignResult, StratifiedDesign
from orchestrator.learning.campaign_plan import (
    CalibrationEvidence,
    CalibrationPlan,
    CampaignPlan,
    DeploymentPlan,
    DispensePlan,
    KnownSimulation,
    MeasuredPour,
    RecordSet,
)
from orchestrator.learning.deployment.calibration_evidence import calibration_evidence, memory_evidence
from orchestrator.learning.deployment.costing import Costing
from orchestrator.learning.deployment.deployment_result import Deployed
from orchestrator.learning.deployment.model_monitoring import displacement
from orchestrator.learning.dispense import KnownSource, ReadSources, SourcesRead, knowledge_of
from orchestrator.learning.mixtures import dose_strategy
from orchestrator.learning.requests import Simulate
from orchestrator.learning.run_errors import RunError
from orchestrator.learning.single_action import Confirmation, OnePour, RepeatedSimulation
from orchestrator.learning.strategy import Strategy
from orchestrator.records.codec import Results, result_of
from sim_engine.liquids import SimulationParameters
from sim_engine.scene import Scene
from sim_engine.search_space import Space

POURS, CALIBRATION, EVALUATION = "pours", "calibration", "evaluation"
DEPLOYMENT, CONFIRMATION, PREDICTION = "deployment:", "confirmation:", "prediction:"
"""Names of the calibration's stages, and prefixes of the receivers' stage names."""

SOURCES, DOSES = "sources", "doses"
"""Names of the stages of a series of doses."""

POUR = "pour"
"""Name of the stage of a single pour."""

POSTERIOR_DRAWS = 64
"""Number of draws from the posterior of θ that a deployment's simulations use."""


@dataclass(frozen=True)
class StageDefinition:
    """One stage.

    Attributes:
        name: unique in the campaign; part of the stage's seed.
        build: makes the strategy from the earlier stages' results and the stage's seed.
        pours: whether it needs a bench.
        stand_in: placeholder for its result in speculative execution (`orchestrator.runs.request_forecast`).
    """

    name: str
    build: Callable[[Results, int], Strategy]
    pours: bool = False
    stand_in: Calibrated | None = None


def stage_seed(seed: int, stage: str) -> int:
    """The seed of a stage: the same on every machine, and independent of the other stages' seeds."""
    words = np.frombuffer(hashlib.sha256(stage.encode()).digest(), dtype="<u4")
    high, low = np.random.SeedSequence([seed, *(int(w) for w in words)]).generate_state(2, dtype=np.uint32)
    return (int(high) >> 1) << 32 | int(low)


def named_scenes(plan: CampaignPlan) -> dict[str, tuple[Scene, Space]]:
    """Scenes with their searched actions, by the name of the receiver, 'calibration' or 'transfer'; the usual first."""
    scenes: dict[str, tuple[Scene, Space]] = {}
    if plan.deployment is not None:
        scenes |= {scene.receiver.name: (scene, plan.deployment.actions) for scene in plan.deployment.scenes}
    if plan.calibration is not None:
        scenes |= {scene.name: (scene, plan.calibration.actions) for scene in plan.calibration.poured}
        if plan.calibration.transfer is not None:
            scenes["transfer"] = plan.calibration.transfer.scene, plan.calibration.actions
    return scenes


def scenes_of(plan: CampaignPlan) -> dict[str, Scene]:
    """All scenes of a plan by name.

    Raises:
        RunError: two different scenes have the same name.
    """
    every: list[Scene] = []
    if plan.calibration is not None:
        every += plan.calibration.poured
        every += [records.scene for records in (plan.calibration.records, plan.calibration.transfer) if records]
    if plan.deployment is not None:
        every += plan.deployment.scenes
    if plan.dispense is not None:
        every += plan.dispense.scenes
    every += filter(None, [plan.pour])
    scenes: dict[str, Scene] = {}
    for scene in every:
        if scenes.setdefault(scene.name, scene) != scene:
            raise RunError(f"two different scenes are both named '{scene.name}'; give one of the vessels another name")
    return scenes


KnownSources = Callable[[DispensePlan], Mapping[str, KnownSource]]
"""Reads what is known of the sources of a series, by name: called once, when the first stage begins."""


def stages_of(plan: CampaignPlan, sources: KnownSources = lambda plan: {}) -> tuple[StageDefinition, ...]:
    """All stages of a campaign in order: pours, calibration, evaluation, then a deployment for each receiver, or doses.

    Args:
        plan: of the campaign.
        sources: of its doses; nothing is known of them unless given.
    """
    stages: list[StageDefinition] = []
    if plan.calibration is not None:
        stages += calibration_stages(plan.calibration, plan.deployment)
    if plan.deployment is not None:
        stages += deployment_stages(plan, plan.deployment)
    if plan.dispense is not None:
        stages += dispense_stages(plan.dispense, sources, plan.calibration, partial(simulated_knowledge, plan))
    if (scene := plan.pour) is not None:
        stages.append(StageDefinition(POUR, lambda results, seed: OnePour(scene, scene.action({}), seed), pours=True))
    return tuple(stages)


def dispense_stages(
    plan: DispensePlan,
    known_sources: KnownSources,
    calibration: CalibrationPlan | None = None,
    simulated: Callable[[], Mapping[str, DoseKnowledge]] = dict,
) -> list[StageDefinition]:
    """The content of the sources, which is read once, and the doses.

    Args:
        plan: the series.
        known_sources: reads what is known of its sources; OSError: it can't be read.
        calibration: that precedes the doses.
        simulated: returns what simulated doses say about the sources, by name.
    """

    def sources(results: Results, seed: int) -> Strategy:
        try:
            return ReadSources(known_sources(plan), simulated())
        except OSError as error:
            raise RunError(f"the content of the sources is not known: {error}; write 'start: filled'") from error

    def doses(results: Results, seed: int) -> Strategy:
        read = result_of(results, SOURCES, SourcesRead)
        expected = {name: knowledge_of(fields) for name, fields in read.simulated.items()}
        return dose_strategy(plan, seed, read.sources, expected | calibrated_sources(plan, calibration, results))

    return [StageDefinition(SOURCES, sources), StageDefinition(DOSES, doses, pours=True)]


def calibrated_sources(
    plan: DispensePlan, calibration: CalibrationPlan | None, results: Results
) -> dict[str, DoseKnowledge]:
    """What a calibration has shown of the sources of doses, by name: only of the vessel that it poured from.

    There is nothing if it did not search the grip of the pourer, if it has no posterior, or if the weighed pours do not
    justify θ*.
    """
    if calibration is None or CALIBRATION not in results:
        return {}
    theta = calibrated_theta(results)
    if theta.posterior is None or "tilt_zero" not in theta.searched or not _justified(results):
        return {}
    knowledge = calibrated_knowledge([row["tilt_zero"] for row in theta.posterior.thetas])
    pourer = calibration.scene.pourer
    return {scene.pourer.name: knowledge for scene in plan.scenes if scene.pourer == pourer}


def calibration_stages(plan: CalibrationPlan, deployment: DeploymentPlan | None = None) -> list[StageDefinition]:
    """Pours (unless records replace them), the calibration strategy, and its evaluation against rivals.

    Args:
        deployment: the deployment that actively chosen pours serve; None: they serve calibration's own actions.
    """
    stages = []
    if plan.pour_count > 0:

        def pours(results: Results, seed: int) -> Strategy:
            if plan.design == "active":
                return ActiveDesign(plan, deployment, seed)
            return StratifiedDesign(
                plan.scenes,
                plan.actions,
                plan.pour_count,
                plan.holdout,
                seed,
                constraints=plan.constraints,
                tested=plan.tested,
            )

        stages.append(StageDefinition(POURS, pours, pours=True))

    def calibration(results: Results, seed: int) -> Strategy:
        pours = [scored.pour for scored in measured_pours(plan, results)]
        return plan.settings.build(replace(plan, known=known_simulations(plan, results)), pours, seed)

    def evaluation(results: Results, seed: int) -> Strategy:
        theta, remembered = calibrated_theta(results).theta, result_of(results, CALIBRATION, Calibrated).memory
        dropped = remembered is not None and remembered.contradicted
        plain = (replace(plan, memory=None) if dropped else plan).uncalibrated
        rivals = random_parameters(plan.parameters, plan.fixed_parameters, plan.random_baseline, seed)
        pours = [*measured_pours(plan, results), *_recorded(plan.transfer)]
        draws = posterior_draws(calibrated_theta(results), DRAWS) if rivals else ()
        return CalibrationEvaluation(
            theta,
            rivals,
            pours,
            Contexts.of(plan),
            seed,
            uncalibrated=plain,
            sampled=draws,
            train_seeds=result_of(results, CALIBRATION, Calibrated).pour_seeds,
            trials=[
                (trial.theta, trial.differences)
                for trial in result_of(results, CALIBRATION, Calibrated).trials
                if isinstance(trial, TriedOnAll)
            ],
        )

    fitting = StageDefinition(CALIBRATION, calibration, stand_in=_stand_in(plan))
    return [*stages, fitting, StageDefinition(EVALUATION, evaluation)]


def _stand_in(plan: CalibrationPlan) -> Calibrated:
    """Placeholder for a θ* that is not found yet: a point of the box that is unlikely to occur otherwise."""
    values = plan.parameters.decode([math.sqrt(0.3)] * plan.parameters.dimension)
    theta = CalibratedTheta(
        theta=SimulationParameters.from_values({**plan.fixed_parameters, **values}),
        searched=plan.parameters.names,
        predicted_discrepancy=0.0,
        predicted_deviation=0.0,
        hyperparameters=None,
        map=None,
    )
    return Calibrated(
        strategy=plan.strategy, simulations=0, lost=0, undefined=0, training_pours=0, trials=(), found=theta
    )


def deployment_stages(plan: CampaignPlan, deployment: DeploymentPlan) -> list[StageDefinition]:
    """One stage for each receiver, all with the recommended θ (the plan's θ if nothing is calibrated).

    A confirmation stage, which repeats the recommended pour, follows each if the plan requests it.
    """

    def build_for(scene: Scene) -> Callable[[Results, int], Strategy]:
        def build(results: Results, seed: int) -> Strategy:
            informed = with_left_over(with_posterior(deployment, results), results, plan.calibration, scene)
            informed = with_offsets(informed, results, _theta(plan, results))
            informed = with_evidence(informed, results, plan.calibration, scene, _theta(plan, results))
            return informed.settings.build(informed, scene, _theta(plan, results), seed)

        return build

    def confirm_for(name: str, scene: Scene) -> Callable[[Results, int], Strategy]:
        def build(results: Results, seed: int) -> Strategy:
            recommended = result_of(results, DEPLOYMENT + name, Deployed).recommended
            costing = Costing.of(deployment, scene, _theta(plan, results))
            return Confirmation(costing, recommended, deployment.confirm, seed)

        return build

    stages = []
    for name, scene in by_receiver(deployment).items():
        stages.append(StageDefinition(DEPLOYMENT + name, build_for(scene), pours=deployment.pours > 0))
        if deployment.confirm:
            stages.append(StageDefinition(CONFIRMATION + name, confirm_for(name, scene), pours=True))
    return stages


def prediction_stages(
    plan: CampaignPlan, deployment: DeploymentPlan, seeds: int, thetas: Sequence[SimulationParameters] = ()
) -> list[StageDefinition]:
    """One stage for each receiver, which simulates its recommended pour again with new seeds.

    Args:
        seeds: number of simulations per receiver.
        thetas: posterior draws that the simulations use in turn; empty: the θ that was planned with.
    """

    def build_for(name: str, scene: Scene) -> Callable[[Results, int], Strategy]:
        def build(results: Results, seed: int) -> Strategy:
            recommended = result_of(results, DEPLOYMENT + name, Deployed).recommended
            action = None if recommended is None else scene.action(dict(recommended.action_si))
            costing = Costing.of(deployment, scene, _theta(plan, results))
            left = None if deployment.left_over is None else deployment.left_over.at(scene)
            return RepeatedSimulation(costing, action, seeds, seed, thetas, left)

        return build

    return [
        StageDefinition(PREDICTION + name, build_for(name, scene)) for name, scene in by_receiver(deployment).items()
    ]


def with_posterior(deployment: DeploymentPlan, results: Results) -> DeploymentPlan:
    """The deployment with posterior draws of θ from the preceding calibration; its simulations use them in turn.

    There are none if the calibration has no posterior, or if the weighed pours do not justify θ*. A strategy that
    learns the bench's offsets from its pours receives what calibration knows of them separately (`with_offsets`): if
    offsets were searched, its simulations use θ*.
    """
    if deployment.thetas:
        return deployment
    theta = calibrated_theta(results) if CALIBRATION in results else None
    posterior = () if theta is None or theta.posterior is None else theta.posterior.thetas
    if (
        theta is None
        or not posterior
        or not _justified(results)
        or (deployment.settings.learns_offsets and set(SimulationParameters.nuisances()).intersection(theta.searched))
    ):
        return deployment
    assert theta is not None
    return replace(deployment, thetas=posterior_draws(theta, POSTERIOR_DRAWS))


def with_left_over(
    deployment: DeploymentPlan, results: Results, calibration: CalibrationPlan | None, scene: Scene
) -> DeploymentPlan:
    """The deployment with its residual for a scene: the given one, or that of an evaluated preceding calibration."""
    left = deployment.left_over
    if left is None and CALIBRATION in results and EVALUATION in results:
        scores = result_of(results, EVALUATION, Scores)
        left = calibration_residual(calibration, scores, len(calibrated_theta(results).searched))
    return replace(deployment, left_over=None if left is None else left.at(scene))


def posterior_draws(theta: CalibratedTheta, count: int) -> tuple[SimulationParameters, ...]:
    """At most `count` draws of the posterior of θ; none if there is no posterior."""
    rows = () if theta.posterior is None else theta.posterior.thetas
    count = min(count, len(rows))
    spread = [rows[i * len(rows) // count] for i in range(count)]
    return tuple(SimulationParameters.model_validate({**theta.theta.model_dump(), **row}) for row in spread)


def with_offsets(deployment: DeploymentPlan, results: Results, best: SimulationParameters) -> DeploymentPlan:
    """The deployment with the known bench offsets, from earlier pours into a receiver, the calibration or a memory.

    A calibration contributes if it searched nuisance parameters; parameters that it did not search keep their
    tolerances.
    """
    if not deployment.settings.learns_offsets or deployment.bench:
        return deployment
    previous = [
        result.bench for result in results.values() if isinstance(result, Deployed) and result.bench is not None
    ]
    if previous:
        return replace(deployment, bench=previous[-1].displacements())
    nuisances = set(SimulationParameters.nuisances())
    theta = calibrated_theta(results) if CALIBRATION in results else None
    if theta is None and deployment.memory is not None:
        offsets = nuisances.intersection(deployment.memory.means)
        posterior = deployment.memory.thetas(best, POSTERIOR_DRAWS) if offsets else []
    else:
        offsets = nuisances.intersection(() if theta is None else theta.searched)
        if theta is None or theta.posterior is None or not offsets:
            return deployment
        rows = theta.posterior.thetas
        posterior = [SimulationParameters.model_validate({**theta.theta.model_dump(), **row}) for row in rows]
    if not posterior:
        return deployment
    worlds = drawn_worlds(best, POSTERIOR_DRAWS, 0, posterior=posterior, known=offsets)
    return replace(deployment, bench=tuple(displacement(best, world, deployment.actions) for world in worlds))


def with_evidence(
    deployment: DeploymentPlan,
    results: Results,
    calibration: CalibrationPlan | None,
    scene: Scene,
    best: SimulationParameters,
) -> DeploymentPlan:
    """The deployment with the weighed pours of an evaluated preceding calibration, and of a memory that its pours do
    not contradict, as evidence about the simulator."""
    if not deployment.settings.learns_offsets:
        return deployment
    memory, evidence = deployment.memory, CalibrationEvidence()
    if calibration is not None and EVALUATION in results:
        weighed = [*measured_pours(calibration, results), *_recorded(calibration.transfer)]
        scores, searched = result_of(results, EVALUATION, Scores), len(calibrated_theta(results).searched)
        evidence += calibration_evidence(deployment, scene, best, calibration, weighed, scores, searched)
        remembered = result_of(results, CALIBRATION, Calibrated).memory
        memory = None if remembered is None or remembered.contradicted else calibration.memory
    if memory is not None:
        evidence += memory_evidence(deployment, scene, best, memory)
    return replace(deployment, evidence=evidence) if evidence.lines else deployment


def by_receiver(deployment: DeploymentPlan) -> dict[str, Scene]:
    """Scenes by the names of their receivers, or by their own names if receivers are shared."""
    distinct = len({scene.receiver.name for scene in deployment.scenes}) == len(deployment.scenes)
    return {scene.receiver.name if distinct else scene.name: scene for scene in deployment.scenes}


def recommended_pours(plan: CampaignPlan, results: Results) -> dict[str, Simulate]:
    """A simulation of each receiver's recommended pour with the θ that its deployment used, by receiver."""
    simulations = {}
    for name, scene in by_receiver(plan.deployment).items() if plan.deployment is not None else ():
        result = results.get(DEPLOYMENT + name)
        if isinstance(result, Deployed) and result.recommended is not None:
            action, seed = scene.action(dict(result.recommended.action_si)), stage_seed(plan.seed, f"film:{name}")
            simulations[name] = Simulate(scene.name, action, _theta(plan, results), seed, purpose="film")
    return simulations


def _theta(plan: CampaignPlan, results: Results) -> SimulationParameters:
    """The θ that calibration recommends; the plan's if nothing was calibrated."""
    return deployed_theta(results) if CALIBRATION in results else plan.parameters


def deployed_theta(results: Results) -> SimulationParameters:
    """The θ to deploy with: θ*, or the uncalibrated one if the weighed pours do not justify θ*.

    Raises:
        RunError: the calibration found no θ*.
    """
    scores = result_of(results, EVALUATION, Scores) if EVALUATION in results else None
    return recommended_theta(calibrated_theta(results).theta, scores)


def _justified(results: Results) -> bool:
    """Whether the weighed pours justify θ*, or this was not compared."""
    gain = result_of(results, EVALUATION, Scores).gain if EVALUATION in results else None
    return gain is None or gain.recommended != UNCALIBRATED


def calibrated_theta(results: Results) -> CalibratedTheta:
    """θ* of the calibration stage.

    Raises:
        RunError: there is none.
    """
    theta = result_of(results, CALIBRATION, Calibrated).found
    if theta is None:
        raise RunError("the calibration has found no θ*")
    return theta


def measured_pours(plan: CalibrationPlan, results: Results) -> list[ScoredPour]:
    """Weighed pours of the calibration's scene: from the stage that made them, and from the records."""
    scored, scenes = [], {scene.name: scene for scene in plan.poured}
    for pour in result_of(results, POURS, DesignResult).measured if POURS in results else ():
        scene = scenes.get(pour.scene, plan.scene)
        action = scene.action(dict(pour.action_si))
        measured = MeasuredPour(action, pour.spillage, pour.poured, pour.split, scene.name)
        scored.append(ScoredPour(scene.name, measured))
    return [*scored, *_recorded(plan.records)]


def known_simulations(plan: CalibrationPlan, results: Results) -> tuple[KnownSimulation, ...]:
    """Simulations in the calibration's scenes by the stage that made the pours; the plan's without such a stage."""
    if POURS not in results:
        return plan.known
    simulated = result_of(results, POURS, DesignResult).simulated
    scenes = {scene.name: scene for scene in plan.scenes}
    return tuple(
        KnownSimulation(dict(run.theta), run.scene, scenes[run.scene].action(dict(run.action_si)), run.spillage)
        for run in simulated
    )


def _recorded(records: RecordSet | None) -> list[ScoredPour]:
    if records is None:
        return []
    return [ScoredPour(pour.scene or records.scene.name, MeasuredPour.from_record(pour)) for pour in records.pours]
