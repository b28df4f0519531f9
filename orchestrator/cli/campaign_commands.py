"""`decant run`, `decant calibrate`, `decant plan`: the verbs that run stages in a laboratory."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from orchestrator.cli.console import BAD_INPUT, RefusalError, Refused, mention, print_json
from orchestrator.cli.foreground_run import (
    check_campaign_can_run,
    check_laboratory_answers,
    read_campaign,
    run_in_front_of_people,
)

if TYPE_CHECKING:
    from orchestrator.journal.run_record import CampaignResult
    from orchestrator.results.publishing import Published
    from orchestrator.strategies.campaign_plan import CampaignPlan


_TOLD = {
    "prediction",
    "prediction_band",
    "at_bounds",
    "predicted_delivered_g",
    "predicted_delivered_ml",
    "risk",
    "window",
    "not_covered",
}
"""Fields of a receiver's summary that a plan for it prints beside the action."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class RunOptions:
    """What `run` and `calibrate` are given on the command line beside their campaign."""

    resume: bool = False
    run_id: str | None = None
    """With resume: which run; None is the newest unfinished one."""
    answer: str | None = None
    """With resume: what came of the pour that was under way; None lets a person be asked."""
    in_process: bool = False
    laboratory: Path | None = None
    """In place of the campaign's."""
    seed: int | None = None
    """In place of the campaign's."""
    as_json: bool = False
    arm: bool = False
    """Hardware may move in this run."""
    live: bool = False
    """A live view is served while it runs …"""
    live_at: str | None = None
    """… at this ADDRESS[:PORT], where one is given."""


def run(path: Path, options: RunOptions) -> None:
    """The whole campaign."""
    from orchestrator.results.run_summary import summary_json

    result, published = _run("run", path, options)
    if options.as_json:
        summary = summary_json(published.summary)
        print_json({"run": result.directory.name, "report": published.report, **summary})


def calibrate(path: Path, options: RunOptions) -> None:
    """Only what finds θ*, and how good it is beside its rivals."""
    result, published = _run("calibrate", path, options)
    if options.as_json:
        print_json(calibration_json(result, published))


def calibration_json(result: CampaignResult, published: Published) -> dict[str, Any]:
    """The recommended θ, θ*, and mean |r − c_s| by split: that of θ*, that of its rivals: see
    `CalibrationEvaluation`."""
    from orchestrator.journal.codec import result_of
    from orchestrator.results.stage_views import rival_scores
    from orchestrator.runs.stages import CALIBRATION, EVALUATION, calibrated_theta, deployed_theta
    from orchestrator.strategies.calibration.calibration_base import Calibrated
    from orchestrator.strategies.calibration.calibration_scores import CALIBRATED, Scores

    results = result.results
    theta, calibration = calibrated_theta(results).theta, result_of(results, CALIBRATION, Calibrated)
    evaluation = result_of(results, EVALUATION, Scores)
    ours = evaluation.discrepancy[CALIBRATED]
    rivals = rival_scores(evaluation)
    data: dict[str, Any] = {
        "theta": deployed_theta(results).model_dump(),
        "calibrated_theta": theta.model_dump(),
        "calibration_gain": None if evaluation.gain is None else evaluation.gain.model_dump(mode="json"),
    }
    for split in ("train", "test", "transfer"):
        data[f"{split}_discrepancy"] = ours.get(split)
        if split != "train":
            data |= {f"{split}_discrepancy_{name}": values.get(split) for name, values in rivals.items()}
    return {
        **data,
        "simulations": result.simulations,
        "calibration_simulations": calibration.simulations,
        "cpu_s": result.cpu_s,
        "run": str(result.directory),
        "figures": published.figures,
        "recording": published.recording,
        "report": published.report,
    }


def plan_pour(
    path: Path,
    *,
    parameters: Path | None,
    receiver: Path | None,
    iterations: int | None,
    seed: int | None,
    seeds: int,
    thetas: int | None,
    laboratory: Path | None,
    in_process: bool,
    as_json: bool,
) -> None:
    """D1 for one receiver: the action that the calibrated simulator would pour with, and what to expect of it."""
    from orchestrator.cli.prediction_inputs import foretelling
    from orchestrator.journal.codec import result_of
    from orchestrator.run_service import RunRequest, RunResources
    from orchestrator.runs.stages import DEPLOYMENT, PREDICTION, deployment_stages, prediction_stages
    from orchestrator.strategies.deployment.deployment_result import Deployed
    from orchestrator.strategies.single_action import PredictedPour

    plan = planning_plan(read_campaign(path, laboratory, seed), parameters, receiver, iterations)
    assert plan.deployment is not None
    planning = deployment_stages(plan, plan.deployment)
    request = RunRequest(plan, planning, as_written=receiver is None)
    check_campaign_can_run(request)
    known = foretelling(plan, parameters, thetas, seeds)
    count = max(seeds, len(known.drawn))
    stages = [*planning, *prediction_stages(plan, plan.deployment, count, known.drawn)]
    resources = RunResources(in_process=in_process, brief=True)
    check_laboratory_answers(request, resources)
    directory = run_directory(plan, resume=False, run_id=None)
    if parameters is None:
        mention(
            f"note: no --parameters given; planning with the campaign's ({json.dumps(plan.parameters.model_dump())})"
        )
    run_result, published = run_in_front_of_people(
        dataclasses.replace(request, stages=stages, folder=directory),
        resources,
        again=f"Plan anew: decant plan {path}",
        not_resumed="this planning is not resumed; what was simulated",
    )
    answers = []
    for stage in planning:
        result = result_of(run_result.results, stage.name, Deployed)
        recommended = result.recommended
        if recommended is None:
            raise RefusalError(f"{stage.name}: no action could be planned; every simulation failed. See {directory}")
        receiver_name = stage.name.removeprefix(DEPLOYMENT)
        repeated = result_of(run_result.results, PREDICTION + receiver_name, PredictedPour).over_seeds
        spillage = repeated.get("spillage")
        told = published.summary.receivers[result.scene]
        answers.append(
            {
                "receiver": receiver_name,
                "action": recommended.action,
                "action_si": recommended.action_si,
                "predicted_loss": recommended.predicted_loss,
                "predicted_spillage": None if spillage is None else spillage.mean,
                "predicted_spillage_deviation": None if spillage is None else spillage.deviation,
                "predicted_deviation": recommended.predicted_deviation,
                "loss": plan.deployment.loss_name,
                **told.model_dump(mode="json", include=_TOLD),
            }
        )
    theta = plan.parameters.model_dump()
    if as_json:
        totals = {"simulations": run_result.simulations, "cpu_s": run_result.cpu_s, "run": str(directory)}
        first = answers[0]
        print_json({**first, "theta": theta, **totals, **({"plans": answers} if len(answers) > 1 else {})})


def planning_plan(
    plan: CampaignPlan,
    parameters: Path | None,
    receiver: Path | None,
    iterations: int | None,
) -> CampaignPlan:
    """A campaign turned into D1 without pours, and its record.

    Args:
        parameters: file of the θ to plan with; the campaign's unless given.
        receiver: file of another vessel than the campaign's.
        iterations: as the campaign says unless given.

    Raises:
        RefusalError: it has nothing to plan with, or a file is wrong (exit code 2).
    """
    from orchestrator.config.file_loading import load_vessel
    from orchestrator.config.yaml.yaml_errors import ConfigError
    from orchestrator.run_service import RunTaskError, planned, read_theta

    with Refused(ConfigError, RunTaskError):
        given = None if parameters is None else read_theta(parameters, plan)
        return planned(plan, given, None if receiver is None else load_vessel(receiver), iterations)


def _run(task: Literal["run", "calibrate"], path: Path, options: RunOptions) -> tuple[CampaignResult, Published]:
    from orchestrator.cli.foreground_run import check_somebody_is_there
    from orchestrator.cli.motion_approval import arm_campaign
    from orchestrator.cli.view_command import live_view
    from orchestrator.run_service import RunResources, RunTaskError, task_request

    with Refused(RunTaskError):
        request = task_request(read_campaign(path, options.laboratory, options.seed), task)
    plan = request.campaign
    check_campaign_can_run(request)
    if options.answer is not None and not options.resume:
        raise RefusalError(
            f"--answer {options.answer!r}: goes with --resume; a new run has nothing to answer", BAD_INPUT
        )
    checksum = arm_campaign(plan, request.stages, armed=options.arm, verb=task)
    if request.pours:
        check_somebody_is_there(plan.laboratory)
    resources = RunResources(in_process=options.in_process, approved_checksum=checksum or "")
    check_laboratory_answers(request, resources)
    live = live_view(plan, live=options.live, at=options.live_at)
    directory = run_directory(plan, resume=options.resume, run_id=options.run_id)
    flag = "" if options.laboratory is None else f" --laboratory {options.laboratory}"
    flag += "" if options.seed is None else f" --seed {options.seed}"
    flag += " --arm" if plan.laboratory.mode == "hardware" else ""
    again = f"decant {task} {path} --resume --run {directory.name}{flag}"
    result, published = run_in_front_of_people(
        dataclasses.replace(request, folder=directory, resume="yes" if options.resume else "no"),
        resources,
        again=again,
        answer=options.answer,
        live=live,
    )
    if published.theta is not None:
        mention(f"the parameters to use are in {published.theta}; give them with --parameters")
    return result, published


def run_directory(plan: CampaignPlan, *, resume: bool, run_id: str | None) -> Path:
    """A new run's directory, or the one to go on with.

    Raises:
        RefusalError: there is none, or it can't be made (exit code 2).
    """
    from orchestrator.run_errors import RunError
    from orchestrator.runs.run_folder import create_run, find_run

    if run_id is not None and not resume:
        raise RefusalError(f"--run {run_id}: goes with --resume; without it a new run is begun", BAD_INPUT)
    try:
        directory = find_run(plan, run_id) if resume else create_run(plan)
    except RunError as error:
        raise RefusalError(str(error), BAD_INPUT) from None
    except OSError as error:
        raise RefusalError(f"{plan.outputs.folder}: can't be written: {error.strerror}", BAD_INPUT) from None
    return directory
