"""Converts a calibration section to its plan, including weighed pours from before the campaign.

`resolve_calibration` determines pours, budgets and priors. `resolve_data` and `records_of_run` read existing pours from
a CSV file or a previous run; they must match the scene and the searched actions.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from actors.laboratory_settings import LaboratorySettings
from actors.optimizer.questions import Linear
from orchestrator.config.campaign_file import CalibrationSection, DataSection
from orchestrator.config.scene_builder import SceneBuilder
from orchestrator.config.weighed_pours import column_name, read_records, read_table, resolve_records
from orchestrator.config.yaml.file_access import missing_file, out_of_bounds, resolved
from orchestrator.config.yaml.section_validation import PlacedProblems
from orchestrator.config.yaml.yaml_source import Place, Report
from orchestrator.journal.codec import CodecError
from orchestrator.journal.journal import JOURNAL_NAME
from orchestrator.journal.journal_file import JournalError
from orchestrator.runs.prior_data import PreviousRun, fitting, pours_in, read_former_run
from orchestrator.strategies.campaign_plan import CalibrationPlan, ExistingPours, NormalPrior, RecordedPour, RecordSet
from orchestrator.strategies.strategy_registry import calibrations
from sim_engine.action import ACTION_DIMENSIONS
from sim_engine.errors import did_you_mean
from sim_engine.scene import Scene
from sim_engine.search_space import Axis, Space


def resolve_data(
    section: DataSection,
    place: Place,
    scenes: tuple[Scene, ...],
    actions: Space,
    laboratory: LaboratorySettings | None,
    report: Report,
) -> ExistingPours | None:
    """Existing pours of the deployment by scene; None after a problem, which is added to the report."""
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
    run: str, place: Place, scenes: tuple[Scene, ...], laboratory: LaboratorySettings | None, report: Report
) -> tuple[Path, dict[str, tuple[RecordedPour, ...]] | None]:
    previous = former_run(run, place, report)
    if previous is None:
        return Path(run), None
    if laboratory is not None and previous.mode != laboratory.mode:
        report.add(place, f"was poured in a {previous.mode} laboratory, and '{laboratory.name}' is {laboratory.mode}")
        return previous.path, None
    found = {scene.name: pours_in(previous, scene) for scene in scenes}
    if not any(pours for pours, _ in found.values()):
        reasons = dict.fromkeys(reason for _, reason in found.values())
        report.add(place, f"has nothing to learn from: it {'; it '.join(reasons)}")
        return previous.path, None
    return previous.path, {name: tuple(pours) for name, (pours, _) in found.items() if pours}


def former_run(run: str, place: Place, report: Report) -> PreviousRun | None:
    """A previous run by its folder; None if it can't be read."""
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
    laboratory: LaboratorySettings | None,
    report: Report,
) -> RecordSet | None:
    """Calibration pours from a previous run, in any of its scenes; None after a problem."""
    previous = former_run(run, place, report)
    if previous is None:
        return None
    if laboratory is not None and laboratory.mode == "hardware" and previous.mode != "hardware":
        report.add(place, f"was poured in a virtual laboratory, and '{laboratory.name}' has a real one's liquid")
        return None
    found: list[RecordedPour] = []
    left_out: list[str] = []
    reasons: list[str] = []
    for scene in scenes:
        pours, why = pours_in(previous, scene)
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
    return RecordSet(scenes[0], tuple(found), previous.path)


DESIGN_SIMULATIONS = 64
"""Default number of simulations of an active design."""


def resolve_calibration(
    section: CalibrationSection,
    builder: SceneBuilder,
    fixed: dict[str, float],
    searched: dict[str, Axis],
    place: Place,
    laboratory: LaboratorySettings | None,
    known: tuple[NormalPrior, ...] = (),
) -> CalibrationPlan | None:
    """The plan of a calibration. Problems are added to the report; the plan may then be None.

    Args:
        fixed: parameters that are not searched, by name.
        searched: axes of the searched parameters, by name.
        place: place of the section.
        known: priors of searched parameters.
    """
    report = builder.report
    pours, at = section.pours, place.at("pours")
    from_file = pours is not None and pours.source is not None
    from_run = None if pours is None else pours.from_run
    pourer = builder.pourer(section.pourer, place)
    receivers = builder.receivers(section, place, inherit=False)
    receiver = receivers[0] if receivers else None
    actions = builder.space(section.actions, section.motion, place)
    constraints = builder.constraints(section.actions, place, actions)
    prior = _prior(section, builder, place, actions, constraints)
    motions = ((section.motion, place.at("motion")),)
    searched_actions = () if actions is None else actions.names
    table = read_table(pours, pours.source, at.at("from"), builder) if pours is not None else None
    constants = {} if table is None else table.constants()
    scene = builder.scene(
        "calibration",
        pourer,
        receiver,
        motions,
        searched_actions,
        place,
        recorded=from_file or from_run is not None,
        constants=constants,
    )
    further = tuple(
        builder.scene(f"calibration-{other.name}", pourer, other, motions, searched_actions, place)
        for other in receivers[1:]
        if other is not None and scene is not None
    )
    if further and from_file:
        text = "stands beside pours that are read 'from' a file, which were made into one; keep 'receiver'"
        report.add(place.at("receivers"), text, key=True)
    tested: list[Scene | None] = []
    for i, value in enumerate((None if pours is None else pours.holdout_receivers) or ()):
        vessel = builder.references.vessel(value, at.at("holdout_receivers", i))
        if vessel is not None and scene is not None:
            name = f"calibration-{vessel.name}"
            if name in {other.name for other in (*further, *tested) if other is not None}:
                report.add(at.at("holdout_receivers", i), f"'{vessel.name}' is poured into already")
            tested.append(builder.scene(name, pourer, vessel, motions, searched_actions, place))
    records = transfer = None
    count = holdout = 0
    if pours is not None and (from_file or from_run is not None):
        source = "a file" if from_file else "a run"
        for key in ("count", "holdout", "holdout_receivers", "design", "simulations"):
            if pours.value(key) not in (None, "stratified"):  # the default appears in the record of a run
                report.add(
                    at.at(key), f"belongs to pours that are still to be made; these are read 'from' {source}", key=True
                )
    if pours is not None and not from_file:
        for key in ("lip_radius", "transfer", "columns"):
            if at.at(key).loc in at.document.marks:
                report.add(at.at(key), "belongs to pours that are read 'from' a CSV file", key=True)
    if pours is not None and from_file:
        if from_run is not None:
            report.add(at.at("from_run"), "stands beside 'from'; keep one of them", key=True)
        records, transfer = resolve_records(pours, at, builder, table, actions, scene, pourer, motions)
    elif from_run is not None:
        if scene is not None and actions is not None:
            scenes = (scene, *(other for other in (*further, *tested) if other is not None))
            records = records_of_run(from_run, at.at("from_run"), scenes, actions, laboratory, report)
    elif pours is not None:
        if pours.simulations is not None and pours.design != "active":
            report.add(at.at("simulations"), "belongs to 'design: active'; remove it, or add that", key=True)
        count = pours.count or 0
        if (
            not count
            and not report.is_broken(at)
            and not any(report.is_broken(at.at(k)) for k in ("count", "from", "from_run"))
        ):
            text = "needs 'count' (pours to make on the bench), 'from' (a CSV file of weighed pours) or 'from_run'"
            report.add(at, text, key=True)
        holdout = max(1, count // 8) if pours.holdout is None and count > 1 else pours.holdout or 0
        if count and holdout >= count:
            report.add(at.at("holdout"), f"keeps {holdout} of {count} pours for testing, so that none is left to fit")
        if count and laboratory is not None and not laboratory.pours:
            report.add(
                at.at("count"), f"laboratory '{laboratory.name}' has no bench to pour on; name a CSV file with 'from'"
            )
    settings = None
    if not report.is_broken(place.at("strategy")):
        train = count - holdout if records is None else records.training_pours
        problems = PlacedProblems(place, report, frozenset(CalibrationSection.model_fields))
        settings = section.settings.settled(tuple(searched), train, problems)
    active = pours is not None and pours.design == "active" and count > 0
    others = tuple(other for other in further if other is not None)
    if scene is None or len(others) < len(receivers) - 1 or actions is None or settings is None or not searched:
        return None
    return CalibrationPlan(
        settings=settings,
        scene=scene,
        actions=actions,
        constraints=constraints,
        prior=prior,
        parameters=Space(tuple(searched.values())),
        fixed_parameters=fixed,
        pour_count=count,
        holdout=holdout,
        records=records,
        transfer=transfer,
        random_baseline=section.random_baseline,
        parameter_prior=known,
        further=others,
        tested=tuple(scene for scene in tested if scene is not None),
        design="stratified" if pours is None else pours.design,
        design_simulations=(pours.simulations or DESIGN_SIMULATIONS) if pours is not None and active else 0,
    )


def _prior(
    section: CalibrationSection,
    builder: SceneBuilder,
    place: Place,
    actions: Space | None,
    constraints: tuple[Linear, ...],
) -> tuple[NormalPrior, ...]:
    """The prior over actions, for a strategy that averages over it."""
    report, strategy = builder.report, section.settings.strategy
    if section.settings.has_prior:
        return builder.prior(section.actions, place, actions, constraints)
    if not report.is_broken(place.at("strategy")):
        owners = " and ".join(name for name, settings in calibrations().items() if settings.has_prior)
        why = f"belongs to {owners}, which averages over the prior; {strategy} simulates the weighed pours"
        if section.actions is None:
            builder.refuse_prior(builder.file.actions, builder.root, why)
        else:
            builder.refuse_prior(section.actions, place, why)
    return ()
