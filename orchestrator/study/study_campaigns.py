"""Conversion of a study's cell to a campaign.

`campaign_of` copies the plan of the base campaign with the cell's pours, budget, θ, bench and seed, and makes its task.
It runs nothing.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from orchestrator.campaigns.run_snapshot import record_of
from orchestrator.learning.calibration.action_prior import Contexts, region_of
from orchestrator.learning.calibration.active_design import ActiveDesign
from orchestrator.learning.calibration.calibration_scores import CalibrationEvaluation
from orchestrator.learning.calibration.pointwise_calibration import C1Settings
from orchestrator.learning.calibration.pour_design import DesignResult, StratifiedDesign, draw_allowed, stratified
from orchestrator.learning.campaign_plan import CampaignPlan, OutputSettings, RecordedPour, RecordSet
from orchestrator.learning.deployment.costing import Costing
from orchestrator.learning.deployment.deployment_result import Deployed
from orchestrator.learning.requests import Simulate
from orchestrator.learning.strategy import Strategy
from orchestrator.records.codec import Results, result_of
from orchestrator.records.journal import JOURNAL_NAME
from orchestrator.records.run_record import answers
from orchestrator.runs.run_service import RunRequest
from orchestrator.runs.run_tasks import calibrate_task, deploy_task, single_task
from orchestrator.runs.stages import (
    CALIBRATION,
    EVALUATION,
    POURS,
    StageDefinition,
    deployed_theta,
    known_simulations,
    measured_pours,
    stage_seed,
    with_posterior,
)
from orchestrator.study.study_plan import FINAL, GRID, StudyCell, StudyPlan, cells_of
from orchestrator.study.study_strategies import AnsweredByTable, FinalPour, SimulatedTable
from sim_engine.action import Action
from sim_engine.liquids import SimulationParameters

Load = Callable[[str], Results]
"""Loads the stage results of a finished cell by its id."""


def campaign_of(study: StudyPlan, cell: StudyCell, load: Load, directory: Path) -> RunRequest:
    """The task of a cell.

    Args:
        load: loads the results of the cells that this cell needs, and of those that these need.
        directory: directory of its run.
    """
    request = _task(study, cell, load, directory)
    plan = replace(request.campaign, resolved=record_of(study.base.resolved, request.campaign))
    return replace(request, campaign=plan, folder=directory)


def _task(study: StudyPlan, cell: StudyCell, load: Load, directory: Path) -> RunRequest:
    base = study.base
    bench = base.laboratory.bench if not cell.level else study.level(cell.level).bench
    plan = replace(
        base,
        name=cell.id,
        seed=cell.seed,
        laboratory=base.laboratory.with_values(bench=bench),
        outputs=OutputSettings(directory=str(directory), recording=False, figures=False),
        on_unknown="repeat",
    )
    match cell.kind:
        case "pours" if cell.strategy:
            compared = study.calibration(cell.strategy)
            wanted = study.deployments[0].plan if study.deployments else None
            plan = replace(
                plan, calibration=replace(compared.plan, pour_count=compared.pours, holdout=0), deployment=wanted
            )
        case "grid" | "pours" if plan.calibration is not None:
            designed = replace(plan.calibration, pour_count=study.pour_count, holdout=study.holdout)
            plan = replace(plan, calibration=designed)
    match cell.kind:
        case "grid":
            return single_task(plan, GRID, lambda seed: _table(study, seed))
        case "pours":
            return single_task(plan, POURS, lambda seed: _pours(study, plan, cell, seed), pours=True)
        case "calibration":
            return _calibration(study, cell, plan, load, directory)
        case "uncalibrated":
            plan = _with_pours(study, cell, plan, load, directory)
            return single_task(plan, EVALUATION, lambda seed: _score_of_default(plan, seed))
        case "deployment":
            return _deployment(study, cell, plan, cell.needs, load, directory)
        case "final":
            return _final(study, cell, plan, load, directory)


def calibration_actions(study: StudyPlan) -> list[tuple[float, ...]]:
    """Actions of all calibration pours in the unit cube of the action space; they are equal in every repetition."""
    calibration = study.base.calibration
    assert calibration is not None
    rng = np.random.default_rng(stage_seed(study.seed, "actions"))
    region = region_of(calibration.actions, calibration.constraints)
    strata = stratified(study.pour_count, calibration.actions.dimension, rng)
    return [draw_allowed(stratum, region, rng) for stratum in strata]


def _actions(study: StudyPlan) -> list[Action]:
    calibration = study.base.calibration
    assert calibration is not None
    return [calibration.scene.action(calibration.actions.decode(point)) for point in calibration_actions(study)]


def _table(study: StudyPlan, seed: int) -> Strategy:
    plan = study.calibration("C1").plan
    assert isinstance(plan.settings, C1Settings)
    cells = plan.settings.cells
    middles = [[(i + 0.5) / cells[name] for i in range(cells[name])] for name in plan.parameters.names]
    thetas = [
        SimulationParameters.from_values({**plan.fixed_parameters, **plan.parameters.decode(point)})
        for point in itertools.product(*middles)
    ]
    return SimulatedTable(plan.scene.name, _actions(study), thetas, seed)


def _pours(study: StudyPlan, campaign: CampaignPlan, cell: StudyCell, seed: int) -> Strategy:
    plan = campaign.calibration
    assert plan is not None
    if cell.strategy:
        return ActiveDesign(plan, campaign.deployment, seed)
    points = calibration_actions(study)
    return StratifiedDesign(
        plan.scenes, plan.actions, len(points), study.holdout, seed, points=points, tested=plan.tested
    )


def _with_pours(study: StudyPlan, cell: StudyCell, plan: CampaignPlan, load: Load, directory: Path) -> CampaignPlan:
    """The plan with the repetition's weighed pours as records. A strategy with its own pours uses only
    their test split."""
    calibration = plan.calibration if not cell.strategy else study.calibration(cell.strategy).plan
    assert calibration is not None
    mass, pours = calibration.scene.liquid.mass, []
    scenes = {scene.name: scene for scene in calibration.poured}
    count = study.calibration(cell.strategy).pours if cell.strategy else 0
    weighed = result_of(load(cell.needs[0]), POURS, DesignResult).measured
    if count:
        chosen = load(cell.needs[1])
        weighed = (*result_of(chosen, POURS, DesignResult).measured, *(p for p in weighed if p.split == "test"))
        calibration = replace(calibration, known=known_simulations(calibration, chosen))
    for pour in weighed:
        poured, scene = pour.poured * mass, scenes.get(pour.scene, calibration.scene)
        action, spilled = scene.action(dict(pour.action_si)), (pour.spillage or 0.0) * poured
        pours.append(RecordedPour(action, poured, spilled, mass - poured, pour.split, scene.name))
    source = cell.needs[1 if count else 0]
    records = RecordSet(calibration.scene, tuple(pours), directory.parent / source / JOURNAL_NAME)
    return replace(plan, calibration=replace(calibration, records=records))


def _calibration(study: StudyPlan, cell: StudyCell, plan: CampaignPlan, load: Load, directory: Path) -> RunRequest:
    request = calibrate_task(_with_pours(study, cell, plan, load, directory))
    if cell.strategy != "C1":
        return request
    simulated = answers(directory.parent / GRID, Simulate)
    table = [(reply.request, reply.outcome) for reply in simulated if isinstance(reply.request, Simulate)]

    def answered(stage: StageDefinition) -> StageDefinition:
        return replace(stage, build=lambda results, seed: AnsweredByTable(stage.build(results, seed), table))

    stages = [answered(stage) if stage.name == CALIBRATION else stage for stage in request.stages]
    return replace(request, stages=stages)


def _score_of_default(plan: CampaignPlan, seed: int) -> Strategy:
    assert plan.calibration is not None
    pours = measured_pours(plan.calibration, {})
    return CalibrationEvaluation(plan.parameters, {}, pours, Contexts.of(plan.calibration), seed)


def _deployment(
    study: StudyPlan, cell: StudyCell, plan: CampaignPlan, calibrations: Sequence[str], load: Load, directory: Path
) -> RunRequest:
    compared = study.deployment(cell.strategy).plan
    deployment = replace(compared, scenes=tuple(scene for scene in compared.scenes if scene.name == cell.receiver))
    calibrated: Results = {}
    for calibration in (other for other in cells_of(study) if other.id in calibrations):
        calibrated = load(calibration.id)
        deployment = with_posterior(deployment, calibrated)
        plan = _with_pours(study, calibration, plan, load, directory)
        plan = replace(plan, parameters=deployed_theta(calibrated))

    def informed(stage: StageDefinition) -> StageDefinition:
        return replace(stage, build=lambda results, seed: stage.build({**calibrated, **results}, seed))

    request = deploy_task(replace(plan, deployment=deployment))
    return replace(request, stages=[informed(stage) for stage in request.stages])


def _final(study: StudyPlan, cell: StudyCell, plan: CampaignPlan, load: Load, directory: Path) -> RunRequest:
    """One pour of the recommended action, in the deployment's laboratory and with its loss."""
    deployed, *calibrations = cell.needs
    request = _deployment(study, cell, plan, calibrations, load, directory)
    plan = request.campaign
    assert plan.deployment is not None
    recommended = result_of(load(deployed), request.stages[0].name, Deployed).recommended
    scene = plan.deployment.scenes[0]
    action = None if recommended is None else scene.action(dict(recommended.action_si))
    costing = Costing.of(plan.deployment, scene, plan.parameters)
    return single_task(plan, FINAL, lambda seed: FinalPour(costing, action, seed), pours=True)
