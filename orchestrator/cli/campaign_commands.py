"""The commands `decant run`, `decant calibrate` and `decant plan`, which run stages in a laboratory."""

from __future__ import annotations

import functools
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from orchestrator.cli.command_options import (
    Answer,
    Campaign,
    EnableMotion,
    InProcess,
    Json,
    Live,
    LiveAt,
    OtherLaboratory,
    Parameters,
    Receiver,
    Resume,
    RunId,
    Seed,
    Thetas,
)
from orchestrator.cli.console import RefusalError, print_json, print_note

if TYPE_CHECKING:
    from orchestrator.cli.command_results import CalibrateOutput
    from orchestrator.learning.campaign_plan import CampaignPlan
    from orchestrator.records.run_record import CampaignResult
    from orchestrator.reports.publishing import Published
    from orchestrator.runs.run_service import RunRequest


def _task_command(task: Literal["run", "calibrate"], text: str) -> Callable[..., None]:
    """Make the command of a task; both have the same options."""

    def work(
        campaign: Campaign,
        resume: Resume = False,
        run_id: RunId = None,
        answer: Answer = None,
        in_process: InProcess = False,
        enable_motion: EnableMotion = False,
        live: Live = False,
        live_at: LiveAt = None,
        laboratory: OtherLaboratory = None,
        seed: Seed = None,
        as_json: Json = False,
    ) -> None:
        from orchestrator.cli.foreground_run import (
            check_campaign_can_run,
            conclude,
            read_campaign,
            resources_with_operator,
            resumed_run,
            run_at_terminal,
        )
        from orchestrator.cli.motion_control import require_campaign_flag
        from orchestrator.cli.view_command import live_view
        from orchestrator.reports.run_summary import summary_json
        from orchestrator.runs.run_tasks import TASKS

        if run_id is not None and not resume:
            raise RefusalError(f"--run {run_id}: goes with --resume; without it a new run is begun")
        if answer is not None and not resume:
            raise RefusalError(f"--answer {answer!r}: goes with --resume; a new run has nothing to answer")
        resumed = functools.partial(resumed_run, run_id=run_id) if resume else None
        request = TASKS[task](read_campaign(campaign, laboratory, seed, resumed))
        plan = request.campaign
        check_campaign_can_run(request)
        require_campaign_flag(request, enabled=enable_motion, task=task)
        flag = "" if laboratory is None else f" --laboratory {laboratory}"
        flag += "" if seed is None else f" --seed {seed}"
        flag += " --enable-motion" if plan.laboratory.mode == "hardware" else ""
        if resumed is not None:
            request = replace(request, folder=resumed(plan), resume=True)
        result, published = run_at_terminal(
            request,
            resources_with_operator(request, in_process=in_process, answer=answer),
            again=lambda folder: f"decant {task} {campaign} --resume --run {folder.name}{flag}",
            live=live_view(plan, live=live, at=live_at),
        )
        if published.theta is not None:
            print_note(f"the parameters to use are in {published.theta}; give them with --parameters")
        if as_json and task == "calibrate":
            print_json(calibration_output(result, published))
        elif as_json:
            from orchestrator.cli.json_output import RunOutput

            print_json(RunOutput.model_validate({"report": published.report, **summary_json(published.summary)}))
        conclude(published.summary.verdict)

    work.__name__, work.__doc__ = task, text
    return work


WHERE_RUNS_GO = (
    "Journal, figures and recording are written to a folder of the run, in the campaign's `outputs.directory`, or in "
    "'runs' in the working directory if the campaign names none."
)

run = _task_command(
    "run",
    f"""Run a campaign: calibrate, then learn to pour.

{WHERE_RUNS_GO}

Ctrl-C pauses the run: a pour that has started is finished and weighed first. `--resume` continues it.
""",
)

calibrate = _task_command(
    "calibrate",
    f"""Only calibrate: find the θ whose simulated spillage matches the weighed pours (C1 to C4), scored on other pours.

{WHERE_RUNS_GO} Its theta.json has the recommended θ in SI units (cohesion in N/m, xsph_rate in 1/s), for
`--parameters`.
""",
)


def calibration_output(result: CampaignResult, published: Published) -> CalibrateOutput:
    """The recommended θ, θ*, and mean |r − c_s| by split: that of θ*, that of its rivals: see
    `CalibrationEvaluation`."""
    from orchestrator.cli.command_results import CalibrateOutput
    from orchestrator.learning.calibration.calibration_base import Calibrated
    from orchestrator.learning.calibration.calibration_scores import CALIBRATED, Scores
    from orchestrator.records.codec import result_of
    from orchestrator.reports.stage_views import rival_scores
    from orchestrator.runs.stages import CALIBRATION, EVALUATION, calibrated_theta, deployed_theta

    results = result.results
    theta, calibration = calibrated_theta(results).theta, result_of(results, CALIBRATION, Calibrated)
    evaluation = result_of(results, EVALUATION, Scores)
    ours = evaluation.discrepancy[CALIBRATED]
    rivals = rival_scores(evaluation)
    others = {
        f"{split}_discrepancy_{name}": values.get(split)
        for split in ("test", "transfer")
        for name, values in rivals.items()
    }
    return CalibrateOutput(
        theta=deployed_theta(results),
        calibrated_theta=theta,
        calibration_gain=None if evaluation.gain is None else evaluation.gain.model_dump(mode="json"),
        train_discrepancy=ours.get("train"),
        test_discrepancy=ours.get("test"),
        transfer_discrepancy=ours.get("transfer"),
        simulations=result.simulations,
        calibration_simulations=calibration.simulations,
        cpu_s=result.cpu_s,
        run=str(result.directory),
        figures=dict(published.figures),
        recording=published.recording,
        report=published.report,
        **others,
    )


def plan(
    campaign: Campaign,
    parameters: Parameters = None,
    receiver: Receiver = None,
    iterations: Annotated[int | None, typer.Option(min=2, help="Iterations of the optimiser.")] = None,
    seed: Seed = None,
    seeds: Annotated[
        int, typer.Option(min=2, max=1000, help="Simulations of the planned action, for its prediction interval.")
    ] = 5,
    thetas: Thetas = None,
    laboratory: OtherLaboratory = None,
    in_process: InProcess = False,
    as_json: Json = False,
) -> None:
    """Plan a pour in simulation (D1), for the campaign's receivers or for a new one.

    By default, fifteen actions are simulated, in parallel on all cores. The planned action is then simulated with
    further seeds, which give its prediction and prediction interval. Nothing is poured. The folder of the planning is
    made where those of the campaign's runs are: in its `outputs.directory`, or in 'runs' in the working directory.

    Actions are shown in deg, deg/s, mm and s.
    """
    from orchestrator.cli.foreground_run import (
        check_campaign_can_run,
        conclude,
        read_campaign,
        read_draws,
        run_at_terminal,
    )
    from orchestrator.learning.deployment.deployment_result import Deployed
    from orchestrator.learning.single_action import ActionPrediction
    from orchestrator.records.codec import result_of
    from orchestrator.reports.run_summary import PLANNED
    from orchestrator.runs.run_service import RunResources
    from orchestrator.runs.stages import DEPLOYMENT, PREDICTION

    base = read_campaign(campaign, laboratory, seed)
    draws = read_draws(parameters, thetas, seeds, base.parameters)
    request = planning_request(base, parameters, receiver, iterations, seeds=seeds, draws=draws)
    chosen = request.campaign
    assert chosen.deployment is not None
    check_campaign_can_run(request)
    if parameters is None:
        print_note(
            f"note: no --parameters given; planning with the campaign's ({json.dumps(chosen.parameters.model_dump())})"
        )
    run_result, published = run_at_terminal(
        request,
        RunResources(in_process=in_process, plain_processes=True),
        again=lambda folder: f"Plan again: decant plan {campaign}",
        not_resumed="this planning is not resumed; what was simulated",
    )
    answers = []
    for stage in (deployed for deployed in request.stages if deployed.name.startswith(DEPLOYMENT)):
        result = result_of(run_result.results, stage.name, Deployed)
        recommended = result.recommended
        if recommended is None:
            conclude(published.summary.verdict)
        assert recommended is not None
        receiver_name = stage.name.removeprefix(DEPLOYMENT)
        repeated = result_of(run_result.results, PREDICTION + receiver_name, ActionPrediction).over_seeds
        spillage = repeated.get("spillage")
        told = published.summary.outcome.receivers[result.scene]
        answers.append(
            {
                "receiver": receiver_name,
                "action": recommended.action,
                "action_si": recommended.action_si,
                "equal_ranges": recommended.equal_ranges,
                "predicted_loss": recommended.predicted_loss,
                "predicted_spillage": None if spillage is None else spillage.mean,
                "predicted_spillage_deviation": None if spillage is None else spillage.deviation,
                "predicted_deviation": recommended.predicted_deviation,
                "loss": chosen.deployment.loss_name,
                **told.model_dump(mode="json", include=set(PLANNED)),
            }
        )
    if as_json:
        from orchestrator.cli.json_output import PlanOutput

        totals = {"simulations": run_result.simulations, "cpu_s": run_result.cpu_s, "run": str(run_result.directory)}
        several = answers if len(answers) > 1 else []
        print_json(PlanOutput.model_validate({**answers[0], "theta": chosen.parameters, **totals, "plans": several}))
    conclude(published.summary.verdict)


def planning_request(
    plan: CampaignPlan, parameters: Path | None, receiver: Path | None, iterations: int | None, **prediction: Any
) -> RunRequest:
    """The planning of a campaign.

    Args:
        parameters: file of the θ to plan with; the campaign's unless given.
        receiver: file of another vessel than the campaign's.
        iterations: as the campaign says unless given.
        prediction: see `plan_task`.

    Raises:
        ConfigError, RunTaskError: a file is wrong, or it has nothing to plan with.
    """
    from orchestrator.campaigns.file_loading import load_vessel
    from orchestrator.runs.run_tasks import plan_task, read_theta

    theta = None if parameters is None else read_theta(parameters, plan)
    return plan_task(plan, theta, None if receiver is None else load_vessel(receiver), iterations, **prediction)
