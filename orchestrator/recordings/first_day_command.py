"""The command `decant recording first-day`: ten pours and five doses, recorded, replayed and explained on one page."""

from __future__ import annotations

import dataclasses
import json
import math
import shutil
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from orchestrator.cli.command_options import EnableMotion, InProcess, OtherLaboratory
from orchestrator.cli.console import (
    FAILED,
    RefusalError,
    Refused,
    print_message,
    print_warning,
    waiting_for,
)

if TYPE_CHECKING:
    from orchestrator.learning.campaign_plan import CampaignPlan
    from orchestrator.recordings.first_day import DayStep
    from orchestrator.recordings.recording_file import PourRecording
    from orchestrator.recordings.rig_diagnosis import RigDiagnosis
    from sim_engine.scene import Scene

DOSE_LIMIT = 1e-3
"""Excess that a dose avoids [kg]."""

PAGE, RESULT, PICTURE = "first-day.html", "first-day.json", "first-day.png"


def first_day(
    folder: Annotated[Path, typer.Argument(help="Folder of the recordings; steps that it has are kept.")],
    campaign: Annotated[
        Path | None, typer.Option(help="Campaign whose bench pours the missing steps, with water.")
    ] = None,
    laboratory: OtherLaboratory = None,
    practise: Annotated[
        bool, typer.Option("--practise", help="Record the day on a virtual dosing bench instead, without a clock.")
    ] = False,
    wrong: Annotated[
        str | None, typer.Option(help="With --practise: wrong on that bench: lag, holds, grip, height or viscosity.")
    ] = None,
    seed: Annotated[int, typer.Option(min=0, max=2**31, help="With --practise: seed of that bench.")] = 0,
    lag: Annotated[str, typer.Option(help="Lag of the balance that you expect.")] = "0.35 s",
    particles: Annotated[
        int, typer.Option(min=0, max=50_000, help="Particles of the replays; 0: only the estimator.")
    ] = 400,
    enable_motion: EnableMotion = False,
    in_process: InProcess = False,
) -> None:
    """Record ten pours and five doses of water, replay them, and find which quantity of the rig is wrong.

    With a campaign, its bench makes the steps that the folder lacks, one after the other; run the command again after
    an interruption. Without one, the recordings of the folder are explained. Writes first-day.html and first-day.json.
    """
    from orchestrator.recordings.first_day import practice_day
    from orchestrator.recordings.recording_replay import replay_recording
    from orchestrator.recordings.rig_diagnosis import diagnose
    from sim_engine.errors import DecantError
    from sim_engine.liquids import SimulationParameters

    expected = _expected_lag(folder, campaign, lag, wrong, practise=practise)
    if practise or campaign is not None:
        with Refused(OSError):
            folder.mkdir(parents=True, exist_ok=True)
    if practise:
        with Refused(OSError), waiting_for(lambda: "recording ten pours and five doses"):
            practice_day(folder, seed, wrong)
    elif campaign is not None:
        _pour_day(folder, campaign, laboratory, enable_motion=enable_motion, in_process=in_process)
    recordings = _day_of(folder)
    replays = []
    for recording in recordings:
        text = f"replaying {recording.name}"
        with Refused(DecantError, at=f"{recording.path.name}: "), waiting_for(lambda text=text: text):  # type: ignore[misc]
            theta = SimulationParameters(particles=max(particles, 200))
            replays.append(replay_recording(recording, parameters=theta, particles=particles > 0).document())
    with waiting_for(lambda: "comparing explanations"):
        diagnosis = diagnose(recordings, expected)
    words = summary_words(diagnosis, replays)
    print("\n".join(words))
    document = diagnosis.document() | {"replays": replays}
    with Refused(OSError):
        (folder / RESULT).write_text(json.dumps(document, indent=2, default=str) + "\n", encoding="utf-8")
        (folder / PAGE).write_text(_page(folder, diagnosis, replays, words), encoding="utf-8")
    print_message(f"page: {folder / PAGE}")


def _expected_lag(folder: Path, campaign: Path | None, lag: str, wrong: str | None, *, practise: bool) -> float:
    """The expected lag of the balance [s], once the options fit together.

    Raises:
        RefusalError: they don't, or the folder can't have the recordings (exit code 2).
    """
    from sim_engine.settings.quantity import QuantityError, typed_quantity

    if practise and campaign is not None:
        raise RefusalError("--practise: has a bench of its own; leave out --campaign")
    if wrong is not None and not practise:
        raise RefusalError("--wrong: goes with --practise; a real rig is as it is")
    with Refused(QuantityError, at="--lag: "):
        expected = typed_quantity(lag, "s", "0.35 s")
    if not 0.0 < expected <= 10.0:
        raise RefusalError(f"--lag: {lag}: should be above 0 and at most 10 s")
    if folder.exists() and not folder.is_dir():
        raise RefusalError(f"{folder}: is a file; name a folder for the recordings")
    if practise and folder.is_dir() and any(folder.iterdir()):
        raise RefusalError(f"{folder}: is not empty; name a new folder")
    return expected


def _day_of(folder: Path) -> list[PourRecording]:
    """The recordings of a folder; their warnings are printed.

    Raises:
        RefusalError: there are none, or one is invalid (exit code 2).
    """
    from orchestrator.recordings.recording_file import load_recordings

    if not folder.is_dir() or not any(folder.glob("*.yaml")):
        text = f"{folder}: has no recorded pour; name a --campaign whose bench pours, or --practise"
        raise RefusalError(text)
    recordings = load_recordings([folder])
    for recording in recordings:
        for warning in recording.warnings:
            print_warning(warning)
    return recordings


def _pour_day(folder: Path, path: Path, laboratory: Path | None, *, enable_motion: bool, in_process: bool) -> None:
    """Pour the steps that a folder lacks, and record each.

    Raises:
        RefusalError: a step can't be made (exit code 2), or was not completed (1).
    """
    from orchestrator.cli.foreground_run import read_campaign
    from orchestrator.cli.motion_control import require_flag
    from orchestrator.cli.simulate_command import scene_to_simulate
    from orchestrator.recordings.first_day import first_day as steps_of

    plan = read_campaign(path, laboratory)
    bench = plan.laboratory
    if not bench.pours:
        raise RefusalError(f"laboratory {bench.name} has no bench: it simulates and plans")
    if plan.deployment is None:
        raise RefusalError(f"{path}: needs a 'deployment' with the action of the pours, as first-day.yaml has")
    if bench.balance is None or bench.balance.placement != "receiver":
        text = f"laboratory {bench.name}: the first day needs 'balance: {{placement: receiver}}', for its readings"
        raise RefusalError(text)
    again = f"decant recording first-day {folder} --campaign {path}"
    again += "" if laboratory is None else f" --laboratory {laboratory}"
    if bench.mode != "hardware":
        print_message("a virtual bench weighs pours only at their end: this day is replayed, but not explained")
    require_flag(bench, enabled=enable_motion, again=f"{again} --enable-motion")
    steps = steps_of(scene_to_simulate(plan)[0].pourer, plan.deployment.scenes[0].liquid.density)
    for number, step in enumerate(steps, start=1):
        if (folder / f"{step.name}.yaml").exists():
            continue
        target = f"{1e3 * step.amount:.0f} g" if step.amount is not None else f"to {math.degrees(step.angle):.0f}°"
        print_message(
            f"step {number} of {len(steps)}, {step.name}: {step.purpose} ({target}); fill {1e3 * step.fill:.0f} g"
        )
        if step.misses:
            print_message("  this pour misses the receiver on purpose: put a tray below it")
        _pour_step(folder, plan, step, in_process=in_process, again=again)


def _pour_step(
    folder: Path,
    plan: CampaignPlan,
    step: DayStep,
    *,
    in_process: bool,
    again: str,
) -> None:
    """Pour one step as a run of its own, and move its recording into the folder."""
    from orchestrator.cli.dose_command import pour_doses
    from orchestrator.cli.foreground_run import check_campaign_can_run
    from orchestrator.cli.pour_command import chosen_pour, pour_weighed
    from orchestrator.recordings.recording_export import export_recordings
    from orchestrator.runs.run_tasks import dose_task

    def filled(scenes: tuple[Scene, ...]) -> tuple[Scene, ...]:
        return tuple(
            dataclasses.replace(scene, liquid=scene.liquid.model_copy(update={"mass": step.fill})) for scene in scenes
        )

    assert plan.deployment is not None
    outputs: dict[str, Any] = {"directory": folder.absolute() / "runs", "figures": False, "recording": False}
    used = dataclasses.replace(
        plan,
        calibration=None,
        deployment=dataclasses.replace(plan.deployment, scenes=filled(plan.deployment.scenes)[:1]),
        dispense=plan.dispense and dataclasses.replace(plan.dispense, scenes=filled(plan.dispense.scenes)),
        outputs=plan.outputs.model_copy(update=outputs),
    )
    if step.amount is None:
        used = dataclasses.replace(used, dispense=None)
        run = pour_weighed(chosen_pour(used, _assignments(used, step)), in_process=in_process, again=again)
    else:
        request = dose_task(used, [step.amount], DOSE_LIMIT)
        used = request.campaign
        check_campaign_can_run(request)
        run = pour_doses(request, in_process=in_process, again=again)
    written, left_out = export_recordings(run, plan=used)
    if not written:
        raise RefusalError(f"{step.name}: was not recorded: {'; '.join(left_out)}", FAILED)
    # the CSV file first: a step counts as made when its YAML file is there
    for file in sorted(written[0].parent.iterdir(), key=lambda file: file.suffix == ".yaml"):
        name = f"{step.name}{file.suffix}" if file.stem == written[0].stem else file.name
        shutil.copyfile(file, folder / name)


def _assignments(plan: CampaignPlan, step: DayStep) -> list[str]:
    """The action of a pour; what the step does not name is the middle of the campaign's ranges."""
    assert plan.deployment is not None
    scene, space = plan.deployment.scenes[0], plan.deployment.actions
    from sim_engine.vessel.vessel import build_vessel

    middle = {**scene.fixed, **{axis.name: axis.decode(0.5) for axis in space.axes}}
    offset = float(middle.get("x_offset") or 0.1)
    if step.misses:
        offset += 2.0 * build_vessel(scene.receiver).opening_radius + 0.02
    values = {
        "angular_velocity": math.degrees(step.speed),
        "max_angle": math.degrees(step.angle),
        "x_offset": 1e3 * offset,
        "height": 1e3 * float(middle.get("height") or 0.1),
    }
    return [f"{name}={value:.4f}" for name, value in values.items()]


def summary_words(diagnosis: RigDiagnosis, replays: list[dict[str, Any]]) -> list[str]:
    """The answers of a first day, one a line.

    Args:
        diagnosis: the explanation.
        replays: documents of the replays.
    """
    from orchestrator.recordings.rig_diagnosis import ADVICE

    inside = sum(dose.inside for dose in diagnosis.doses)
    words = []
    if diagnosis.explanations:
        words.append(
            f"Does the model describe this rig? {'yes' if diagnosis.describes else 'no'}: {inside} of "
            f"{len(diagnosis.doses)} doses are inside the 90 % interval predicted from the pours"
        )
    differences = [
        abs(dose["simulation"]["final_difference_g"])
        for dose in replays
        if dose["simulation"] and not dose["recording"].stem.endswith("miss")
    ]
    if differences:
        mean, worst = sum(differences) / len(differences), max(differences)
        words.append(
            f"Particles, nothing fitted: {mean:.2g} g from the weighed amount on average, {worst:.2g} g at most"
        )
    main = diagnosis.main
    if not diagnosis.explanations:
        words.append(
            "Which quantity explains the difference? unknown: fewer than 4 pours have readings while they flow; a real "
            "balance below the receiver gives them"
        )
    elif main is None:
        words.append("Which quantity explains the difference? nothing stands out: the tolerances explain the pours")
    else:
        further = [cause.name for cause in diagnosis.explanations if cause.stands_out and cause is not main]
        others = f"; also: {', '.join(further)}, less directly" if further else ""
        words.append(f"Which quantity explains the difference? {main.name}: {main.text}{others}")
    error = diagnosis.dose_error
    if error is not None:
        words.append(f"How exact are doses? {1e3 * error[0]:.2g} g on average, {1e3 * error[1]:.2g} g at most")
    if diagnosis.missed is not None:
        words.append(f"The pour that misses on purpose put {1e3 * diagnosis.missed:.2g} g into the receiver")
    if diagnosis.explanations:
        advice = "widen the ranges; repeat this day after changes" if main is None else ADVICE[main.name]
        words.append(f"What to calibrate next? {advice}")
    return words


def _page(folder: Path, diagnosis: RigDiagnosis, replays: list[dict[str, Any]], words: list[str]) -> str:
    """The summary as an HTML page; its picture is written, too.

    Raises:
        OSError: the picture can't be written.
    """
    from orchestrator.recordings.recording_figures import diagnosis_figure
    from orchestrator.recordings.rig_diagnosis import STANDS_OUT
    from orchestrator.reports.figure_style import save
    from orchestrator.reports.html_report import Picture, render
    from orchestrator.reports.wording import ResultRow, ResultTable

    pictures = (
        []
        if not diagnosis.explanations
        else [
            Picture.of(
                save(diagnosis_figure(diagnosis), folder / PICTURE),
                "Evidence of each explanation, and the doses as predicted from the pours, minus the weighed amount.",
                f"Evidence above {STANDS_OUT:g} counts. Lag and holds are read from the balance, the rest is fitted.",
                wide=True,
            )
        ]
    )
    explanations = ResultTable(
        "Explanations",
        ("quantity", "evidence", "value (90 % interval)"),
        [
            ResultRow((cause.name, f"{cause.evidence:.1f}", cause.text), "best" if cause is diagnosis.main else "")
            for cause in diagnosis.explanations
        ],
        frozenset({1}),
    )
    rows = []
    for pour in replays:
        simulated, onset = pour["simulation"], pour["onset"]
        rows.append(
            ResultRow(
                (
                    pour["recording"].stem,
                    f"{pour['measured_g']:.1f}",
                    "—" if simulated is None else f"{simulated['final_g']:.1f}",
                    "—" if onset is None else f"{onset['tilt_deg']:.1f}",
                    "—" if not simulated or simulated["onset"] is None else f"{simulated['onset']['tilt_deg']:.1f}",
                    f"{pour['estimator']['normalised_innovation']:.2f}",
                )
            )
        )
    header = ("recording", "weighed [g]", "simulated [g]", "onset [°]", "simulated onset [°]", "innovation²")
    pours = ResultTable("Replays, nothing fitted but the lag", header, rows, frozenset(range(1, 6)))
    return render(
        "first_day.html.j2",
        title="First day",
        kicker="Recorded pours",
        heading="First day of a rig",
        lead=f"{len(replays)} recordings in the folder {folder.absolute().name}.",
        footer="Written by decant recording first-day.",
        words=words,
        pictures=pictures,
        tables=[explanations, pours] if diagnosis.explanations else [pours],
    )
