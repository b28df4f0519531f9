"""The commands `decant recording export`, `replay` and `fit`: recorded pours from runs, and what they show."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from orchestrator.cli.command_options import Parameters, RunFolder, add_group, run_folder
from orchestrator.cli.console import (
    FAILED,
    RefusalError,
    Refused,
    print_message,
    print_note,
    print_warning,
    waiting_for,
)
from sim_engine.settings.plugin_registry import FileKind

if TYPE_CHECKING:
    from orchestrator.recordings.recording_file import PourRecording
    from orchestrator.recordings.recording_fit import Fit, Judgement
    from orchestrator.recordings.recording_replay import PourReplay
    from sim_engine.settings.model import Settings

Recordings = Annotated[
    list[Path], typer.Argument(help="Recorded pours (YAML), or folders of them.", metavar="RECORDING")
]


def export(
    run: RunFolder,
    to: Annotated[
        Path | None, typer.Option(help="Folder for the files; default: 'recordings' in the run's folder.")
    ] = None,
) -> None:
    """Write the weighed pours and doses of a run as recorded pours, from its journal.

    Files that exist are kept. To write them at the end of every run, set 'outputs: {pour_recordings: true}' in the
    campaign.
    """
    from orchestrator.learning.run_errors import RunError
    from orchestrator.recordings.recording_export import export_recordings
    from orchestrator.records.journal import JOURNAL_NAME

    folder = run_folder(run)
    if not (folder / JOURNAL_NAME).is_file():
        raise RefusalError(f"{folder}: is no run; name the folder of a run, which has a {JOURNAL_NAME}")
    with Refused(RunError, OSError):
        written, left_out = export_recordings(folder, to)
    for reason in left_out:
        print_message(f"not exported: {reason}")
    for path in written:
        print(path)
    if not written:
        raise RefusalError(f"{folder}: no pour of this run can be exported", FAILED)


def replay(
    recordings: Recordings,
    particles: Annotated[
        int, typer.Option(min=0, max=50_000, help="Particles of the simulation; 0: only the estimator.")
    ] = 1000,
    parameters: Parameters = None,
    values: Annotated[
        Path | None, typer.Option("--fitted", help="Values that 'decant recording fit --output' has written.")
    ] = None,
    seed: Annotated[int, typer.Option(min=0, max=2**31, help="Seed of simulation and estimator.")] = 0,
    png: Annotated[Path | None, typer.Option(help="Folder for a picture of each pour: NAME.png.")] = None,
) -> None:
    """Replay recorded pours: simulate the recorded tilt, run the dosing estimator over the readings, and compare.

    Nothing is fitted but the lag of the balance, which the estimator finds; values of '--fitted' are named. Exit code 2
    if a file is invalid.
    """
    from orchestrator.campaigns.file_loading import load_parameters
    from orchestrator.recordings.recording_figures import replay_figure
    from orchestrator.recordings.recording_fit import read_values
    from orchestrator.recordings.recording_replay import ReplayValues, replay_recording
    from orchestrator.recordings.recording_verdict import likely_cause, replay_doubts, verdict_sentence
    from orchestrator.reports.figure_style import save
    from sim_engine.errors import DecantError
    from sim_engine.liquids import SimulationParameters
    from sim_engine.simulator import PourSimulator

    theta = None if parameters is None else load_parameters(parameters)
    with Refused(ValueError, OSError, at="--fitted: "):
        settings = ReplayValues() if values is None else read_values(values)
    loaded = _loaded(recordings)
    theta = (theta or SimulationParameters()).model_copy(update={"particles": max(particles, 200)})
    simulator = PourSimulator() if particles else None
    try:
        for recording in loaded:
            at, text = f"{recording.path.name}: ", f"replaying {recording.name}"
            with Refused(DecantError, at=at), waiting_for(lambda text=text: text):  # type: ignore[misc]
                report = replay_recording(
                    recording, settings, parameters=theta, seed=seed, particles=particles > 0, simulator=simulator
                )
            print(replay_text(report))
            if doubts := replay_doubts(report):
                with waiting_for(lambda text=f"looking for the cause in {recording.name}": text):  # type: ignore[misc]
                    cause = likely_cause([recording])
                print_warning(verdict_sentence(doubts, cause))
            if png is not None:
                with Refused(OSError, at="--png: "):
                    print_note(f"picture  {save(replay_figure(report), png / f'{recording.name}.png')}")
    finally:
        if simulator is not None:
            simulator.close()


def fit(
    recordings: Recordings,
    unknown: Annotated[
        list[str] | None,
        typer.Option(help="Quantity to fit: grip, height, fill, lag, viscosity. Repeatable; default: grip and lag."),
    ] = None,
    until: Annotated[
        str | None,
        typer.Option(
            help="Fit only the readings up to this time after the first tilt, for example '6 s'; the rest is judged."
        ),
    ] = None,
    judged: Annotated[
        list[Path] | None,
        typer.Option("--judge", help="Recorded pour (or folder) to predict with the fit. Repeatable."),
    ] = None,
    output: Annotated[Path | None, typer.Option("--output", "-o", help="Write the values to this JSON file.")] = None,
) -> None:
    """Fit unknown quantities that recorded pours share, with 90 % intervals, and judge the fit on other readings.

    A fit that can't be right is refused with its likely cause, exit code 2: values far from those of a rig that was set
    up with care, or residuals that are large against the pour.

    The model is the tilting cup with the lag of the balance, not the particles; its flow is always fitted. Judged are
    the recordings of '--judge', and with '--until' the later readings of the fitted ones.
    """
    from orchestrator.recordings.recording_fit import fit_recordings, judge_recording
    from orchestrator.recordings.recording_verdict import unlikely
    from sim_engine.settings.quantity import QuantityError, typed_quantity

    with Refused(QuantityError, at="--until: "):
        seconds = None if until is None else typed_quantity(until, "s", "6 s")
    if output is not None and (output.suffix != ".json" or not output.parent.is_dir()):
        raise RefusalError(f"--output {output}: should be a .json file in a folder that exists")
    loaded = _loaded(recordings)
    others = _loaded(judged or ())
    if both := sorted({recording.path for recording in loaded} & {recording.path for recording in others}):
        text = f"--judge: {both[0].name} is fitted, too; judge another, or fit its beginning with --until"
        raise RefusalError(text)
    with waiting_for(lambda: f"fitting {len(loaded)} recorded pours"):
        fitted = fit_recordings(loaded, tuple(unknown or ("grip", "lag")), until=seconds)
        if refusal := unlikely(loaded, fitted):
            raise RefusalError(f"no value is found: {refusal}")
        judgements = [judge_recording(fitted, pour) for pour in (*(loaded if seconds is not None else ()), *others)]
    print(fit_text(fitted, judgements))
    if output is not None:
        document = fitted.document() | {"judged": [recording.document() for recording in judgements]}
        with Refused(OSError, at="--output: "):
            output.write_text(json.dumps(document, indent=2) + "\n", encoding="utf-8")


def _loaded(paths: Sequence[Path]) -> list[PourRecording]:
    """Recorded pours; their warnings are printed."""
    from orchestrator.recordings.recording_file import load_recordings

    recordings = load_recordings(paths)
    for recording in recordings:
        for warning in recording.warnings:
            print_warning(warning)
    return recordings


def replay_text(replay: PourReplay) -> str:
    """A replay in a few lines.

    Args:
        replay: the replay.
    """
    data = replay.document()
    read, simulated, estimator = data["arrivals"], data["simulation"], data["estimator"]
    lines = [f"{replay.recording.name}: {data['measured_g']:.4g} g measured, {_onset(data['onset'])}"]
    if simulated is not None:
        lines.append(
            f"  predicted by the simulation: {simulated['final_g']:.4g} g ({simulated['final_difference_g']:+.3g} g), "
            f"{_onset(simulated['onset'])}; RMS {simulated['rms_g']:.3g} g"
        )
    low, high = estimator["final_g"][1:]
    lag = estimator["lag_s"]
    lines.append(
        f"  estimator: {low:.4g} to {high:.4g} g at the end; each reading predicted from those before: "
        f"{100 * estimator['coverage']:.0f} % inside 90 %, mean normalised innovation squared "
        f"{estimator['normalised_innovation']:.2f} (1 is right)"
    )
    fitted = data["fitted"]
    fixed = [
        f"{name.replace('_', ' [')}] {fitted[name]:g}" for name in ("grip_deg", "height_mm", "fill_g") if fitted[name]
    ]
    source = f" from {', '.join(fitted['on'])}" if fitted["on"] else ""
    suffix = f"; given{source}: {', '.join(fixed)}" if fixed else ""
    where = "fitted here" if replay.values.lag is None else "given, and corrected by the readings"
    lines.append(f"  lag {lag[0]:.2f} s ({lag[1]:.2f} to {lag[2]:.2f} s), {where}{suffix}")
    lines.append(
        f"  readings: every {read['interval_s']:.3g} s, longest gap {read['longest_gap_s']:.2g} s, "
        f"{read['repeated']} of {read['rising']} repeat the one before while the mass rises"
    )
    return "\n".join(lines)


def _onset(onset: dict[str, float] | None) -> str:
    return "nothing flowed" if onset is None else f"onset at {onset['time_s']:.2f} s and {onset['tilt_deg']:.1f}°"


def fit_text(fit: Fit, judged: Sequence[Judgement]) -> str:
    """A fit and its judgement, separately.

    Args:
        fit: the fit.
        judged: predictions of readings that were not fitted.
    """
    span = "" if fit.until is None else f", readings of the first {fit.until:g} s"
    lines = [f"fitted on {', '.join(fit.fitted_on)}{span} (90 % intervals)"]
    lines += [f"  {estimate.name:<10} {estimate.text}" for estimate in fit.values]
    if fit.held is not None:
        share, low, high = (100 * bound for bound in fit.held)
        lines.append(f"  {'held':<10} {share:.0f} % of the readings while the mass rises ({low:.0f} to {high:.0f} %)")
    lines.append(f"  residuals  {', '.join(f'{1e3 * rms:.2g}' for rms in fit.rms)} g (RMS)")
    lines.append("predicted, not fitted" if judged else "nothing was judged; name other recordings with --judge")
    for pour in judged:
        value, low, high = (1e3 * number for number in pour.final)
        which = "later readings" if pour.fitted else "whole pour"
        lines.append(
            f"  {pour.name} ({which}): {value:.4g} g ({low:.4g} to {high:.4g}), measured "
            f"{1e3 * pour.measured_final:.4g} g; RMS {1e3 * pour.rms:.2g} g, {100 * pour.coverage:.0f} % of the "
            "readings inside 90 %"
        )
    return "\n".join(lines)


def _settings() -> type[Settings]:
    from orchestrator.recordings.recording_file import RecordingFile

    return RecordingFile


def _check(path: Path) -> tuple[str, list[str]]:
    from orchestrator.recordings.recording_file import load_recording

    recording = load_recording(path)
    for warning in recording.warnings:
        print_warning(warning)
    return f"recorded pour, {len(recording.readings)} readings, {1e3 * recording.gain:.4g} g", []


RECORDING_FILE = FileKind(_settings, _check)
"""Files of recorded pours, for `decant validate` and `decant schema`."""


def register(app: typer.Typer) -> None:
    """Add the group `decant recording`."""
    from orchestrator.recordings.first_day_command import first_day

    add = add_group(
        app,
        "recording",
        "Recorded pours: export them from runs, replay them, fit unknown quantities, and record a first day.",
        "decant recording replay configs/recordings/dose-1.yaml",
        "decant recording export runs/dispense-20300131-1",
        quiet=True,
    )
    add(export, "decant recording export dispense-20300131-1   # a run in the folder runs/")
    add(
        replay,
        "decant recording replay configs/recordings/dose-1.yaml --png pictures",
        "decant recording replay day-one/ --fitted fit.json",
    )
    add(
        fit,
        "decant recording fit day-one/ --unknown grip --unknown lag --judge day-two/ --output fit.json",
        "decant recording fit configs/recordings/dose-1.yaml --until '5 s'   # judged on the rest",
    )
    add(
        first_day,
        "decant recording first-day day-one --campaign configs/campaigns/first-day.yaml",
        "decant recording first-day practice --practise --wrong grip   # in minutes, without a laboratory",
        "decant recording first-day day-one   # explain the recordings of a folder again",
        name="first-day",
    )
