"""Pours of before the campaign, from a CSV file or a former run: the same scene, and actions that are searched."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from actors.spec import LaboratorySpec
from orchestrator.codec import CodecError
from orchestrator.config.campaign.records import column_name, read_records
from orchestrator.config.campaign.sections import DataSection
from orchestrator.config.yaml.errors import did_you_mean
from orchestrator.config.yaml.files import missing_file, out_of_bounds, resolved
from orchestrator.config.yaml.source import Place, Report
from orchestrator.former import FormerRun, fitting, pours_in, read_former_run
from orchestrator.journal import JOURNAL_NAME
from orchestrator.journal_file import JournalError
from orchestrator.plan import ExistingPours, RecordedPour, RecordSet
from sim_engine.action import ACTION_DIMENSIONS
from sim_engine.space import Space
from sim_engine.task import Scene


def resolve_data(
    section: DataSection,
    place: Place,
    scenes: tuple[Scene, ...],
    actions: Space,
    laboratory: LaboratorySpec | None,
    report: Report,
) -> ExistingPours | None:
    """Deployment's existing pours by scene; what is wrong goes to the report, and then they are None."""
    given = [key for key in ("from", "run") if section.value(key) is not None]
    if len(given) == 2:
        report.add(place.at("run"), "stands beside 'from'; keep one of them", key=True)
        return None
    if not given:
        if not any(report.is_broken(place.at(key)) for key in ("from", "run")):
            report.add(
                place, "needs 'from' (a CSV file of weighed pours) or 'run' (the folder of a former run)", key=True
            )
        return None
    found: dict[str, tuple[RecordedPour, ...]] | None
    if section.run is not None:
        for key in ("receiver", "lip_radius", "columns"):
            if place.at(key).loc in place.document.marks:
                report.add(place.at(key), "belongs to a CSV file; a run knows it", key=True)
        path, found = _of_run(section.run, place.at("run"), scenes, laboratory, report)
        at = place.at("run")
    else:
        path, found = _of_file(section, place, scenes, actions, report)
        at = place.at("from")
    if found is None:
        return None
    used: dict[str, tuple[RecordedPour, ...]] = {}
    left_out: list[str] = []
    for scene in scenes:
        if scene.name in found:
            fit = fitting(found[scene.name], scene, actions)
            used[scene.name] = fit.pours
            left_out += fit.left_out
    if not any(used.values()):
        report.add(at, f"has no pour that this deployment could have made: {'; '.join(left_out)}")
        return None
    return ExistingPours(used, path, section.counts, tuple(left_out), section.lip_radius, dict(section.columns))


def _of_file(
    section: DataSection, place: Place, scenes: tuple[Scene, ...], actions: Space, report: Report
) -> tuple[Path, dict[str, tuple[RecordedPour, ...]] | None]:
    path = resolved(place.directory / str(section.source))
    receivers = {scene.receiver.name: scene for scene in scenes}
    if section.receiver is None and len(scenes) > 1:
        report.add(place, f"says not into which receiver; add 'receiver:' and one of {', '.join(receivers)}", key=True)
        return path, None
    if section.receiver is not None and section.receiver not in receivers:
        guess = did_you_mean(section.receiver, receivers)
        hint = f"did you mean '{guess}'?" if guess else f"receivers are {', '.join(receivers)}"
        report.add(place.at("receiver"), f"deployment has no receiver '{section.receiver}'; {hint}")
        return path, None
    if (why := missing_file(path)) is not None:
        report.add(place.at("from"), why)
        return path, None
    scene = scenes[0] if section.receiver is None else receivers[section.receiver]
    table = read_records(
        path, loaded=scene.liquid.mass, lip_radius=section.lip_radius, columns=section.columns, split="train"
    )
    report.problems.extend(table.problems)
    if table.problems:
        return path, None
    missing = [name for name in actions.names if name not in table.dimensions]
    for name in missing:
        column = column_name(ACTION_DIMENSIONS[name])
        report.add(place.at("from"), f"{name} is searched and the file has no column '{column}'")
    if missing:
        return path, None
    try:
        return path, {scene.name: tuple(row.pour(scene.fixed) for row in table.rows)}
    except ValueError as error:
        report.add(place.at("from"), str(error))
        return path, None


def _of_run(
    run: str, place: Place, scenes: tuple[Scene, ...], laboratory: LaboratorySpec | None, report: Report
) -> tuple[Path, dict[str, tuple[RecordedPour, ...]] | None]:
    former = former_run(run, place, report)
    if former is None:
        return Path(run), None
    if laboratory is not None and former.mode != laboratory.mode:
        report.add(place, f"was poured in a {former.mode} laboratory, and '{laboratory.name}' is {laboratory.mode}")
        return former.path, None
    found = {scene.name: pours_in(former, scene) for scene in scenes}
    if not any(pours for pours, _ in found.values()):
        reasons = dict.fromkeys(reason for _, reason in found.values())
        report.add(place, f"has nothing to learn from: it {'; it '.join(reasons)}")
        return former.path, None
    return former.path, {name: tuple(pours) for name, (pours, _) in found.items() if pours}


def former_run(run: str, place: Place, report: Report) -> FormerRun | None:
    """A former run by its folder; None where there is none that can be read."""
    directory = resolved(place.directory / run)
    if (outside := out_of_bounds(directory)) is not None:
        report.add(place, f"{directory} {outside}")
        return None
    if not (directory / JOURNAL_NAME).is_file():
        what = (
            "has no journal; name the folder of a run" if directory.is_dir() else "no such folder; name that of a run"
        )
        report.add(place, f"{directory}: {what}, for example '../runs/narrow-20300131-1'")
        return None
    try:
        return read_former_run(directory)
    except (JournalError, CodecError) as error:
        report.add(place, str(error))
        return None


def records_of_run(
    run: str,
    place: Place,
    scenes: tuple[Scene, ...],
    actions: Space,
    laboratory: LaboratorySpec | None,
    report: Report,
) -> RecordSet | None:
    """Calibration's pours from a former run, in any of its scenes; None where something is wrong."""
    former = former_run(run, place, report)
    if former is None:
        return None
    if laboratory is not None and laboratory.mode == "hardware" and former.mode != "hardware":
        report.add(place, f"was poured in a virtual laboratory, and '{laboratory.name}' has a real one's liquid")
        return None
    found: list[RecordedPour] = []
    left_out: list[str] = []
    reasons: list[str] = []
    for scene in scenes:
        pours, why = pours_in(former, scene)
        fit = fitting(pours, scene, actions)
        found += [replace(pour, scene=scene.name) for pour in fit.pours] if len(scenes) > 1 else fit.pours
        left_out += fit.left_out
        reasons += [why] if why else []
    if not found:
        report.add(place, f"has nothing to calibrate on: it {'; it '.join(reasons) or 'has ' + '; '.join(left_out)}")
        return None
    if left_out:
        text = f"has pours that this calibration could not have made ({'; '.join(left_out)})"
        report.add(place, f"{text}; change the motion, or the bounds under actions")
        return None
    if all(pour.split != "train" for pour in found):
        report.add(place, "has no pour with split 'train' to calibrate on")
        return None
    return RecordSet(scenes[0], tuple(found), former.path)
