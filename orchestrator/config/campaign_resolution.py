"""Converts a campaign's file to a plan and checks the combinations of its keys.

- `resolve_campaign` is the entry point.
- `resolve_calibration` determines scenes, pours, budgets and priors of the calibration.
- `resolve_deployment` determines scenes, budgets, loss and existing data of the deployment.

Sections are validated before (`orchestrator.config.yaml.section_validation`); vessels are not built here.
"""

from __future__ import annotations

from actors.laboratory_settings import LaboratorySettings
from actors.optimizer.questions import Linear
from orchestrator.config.campaign_checks import check_ranges
from orchestrator.config.campaign_file import (
    CalibrationSection,
    CampaignFile,
    DeploymentSection,
    LearningSection,
)
from orchestrator.config.run_snapshot import as_file
from orchestrator.config.scene_builder import SceneBuilder
from orchestrator.config.search_ranges import ParametersBase
from orchestrator.config.weighed_pours import read_table, records_of_run, resolve_data, resolve_records
from orchestrator.config.yaml.file_access import resolved
from orchestrator.config.yaml.references import References
from orchestrator.config.yaml.section_validation import PlacedProblems
from orchestrator.config.yaml.yaml_source import Place, Report
from orchestrator.strategies.campaign_plan import (
    CalibrationPlan,
    CampaignPlan,
    DeploymentPlan,
    NormalPrior,
    Premises,
)
from orchestrator.strategies.deployment.objectives import STOPS, Objectives
from orchestrator.strategies.strategy_registry import calibrations
from sim_engine.liquids import SimulationParameters
from sim_engine.outcome import Loss
from sim_engine.scene import Scene
from sim_engine.search_space import Axis, Space


def resolve_objectives(
    section: DeploymentSection, place: Place, scene: Scene, actions: Space, report: Report
) -> Objectives | None:
    """The objectives that replace a loss; None if none are given, or after a problem."""
    before, parts = len(report.problems), section.objectives
    if parts is None:
        for key in ("pareto", "floor"):
            if section.value(key) is not None and not report.is_broken(place.at("objectives")):
                report.add(place.at(key), "belongs to 'objectives'; name some, or remove it", key=True)
        return None
    if place.at("loss").loc in place.document.marks:
        report.add(place.at("loss"), "stands beside 'objectives'; keep one of them", key=True)
    at = place.at("objectives")
    if not parts:
        report.add(at, "is empty; name at least one, for example '- {name: spillage}'")
    if section.pareto and len(parts) == 1:
        report.add(place.at("pareto"), "needs two objectives that can't both be had", key=True)
    names = [part.name for part in parts]
    for i, part in enumerate(parts):
        if report.is_broken(at.at(i, "name")):
            continue
        if part.name in names[:i]:
            report.add(at.at(i), f"{part.name} stands twice in the list; keep one of them")
        beside = frozenset(names[:i] + names[i + 1 :])
        part.check(scene, actions, beside, PlacedProblems(at.at(i), report, frozenset()))
    if len(report.problems) > before:
        return None
    floor = 0.5 if section.floor is None else section.floor
    return Objectives(tuple(parts), floor, bool(section.pareto))


def resolve_deployment(
    section: DeploymentSection, builder: SceneBuilder, place: Place, laboratory: LaboratorySettings | None
) -> DeploymentPlan | None:
    """The plan of a deployment. Problems are added to the report; the plan may then be None."""
    report, settings = builder.report, section.settings
    known = not report.is_broken(place.at("strategy"))
    pourer = builder.pourer(section.pourer, place)
    receivers = builder.receivers(section, place)
    actions = builder.space(section.actions, section.motion, place)
    constraints = builder.constraints(section.actions, place, actions)
    builder.refuse_prior(
        section.actions, place, "is what calibration averages over; deployment looks for the best action"
    )
    if known:
        problems = PlacedProblems(place, report, frozenset(DeploymentSection.model_fields))
        settings.check(Premises(actions, section.objectives is not None), problems)
    if settings.pours and laboratory is not None and not laboratory.pours:
        at = place.at("pours") if "pours" in settings.model_fields_set else place
        hint = "name one with a bench" if settings.learns_on_pours else "'pours: 0' only plans"
        report.add(at, f"laboratory '{laboratory.name}' has no bench to pour on; {hint}")
    elif section.confirm and laboratory is not None and not laboratory.pours:
        text = f"laboratory '{laboratory.name}' has no bench to pour on; name one with a bench, or remove it"
        report.add(place.at("confirm"), text)
    loss = section.loss or Loss()
    if "retained_weight" in loss.model_fields_set and loss.name != "spilled_and_retained":
        report.add(
            place.at("loss", "retained_weight"), f"belongs to spilled_and_retained, not to {loss.name}", key=True
        )
    elif actions is not None and section.objectives is None:
        _check_that_pouring_pays(loss, actions, place.at("loss"), builder)
    scenes = []
    for receiver in receivers or [None]:
        name = "deployment" if receiver is None else f"deployment-{receiver.name}"
        motions = ((section.motion, place.at("motion")),)
        scene = builder.scene(
            name,
            pourer,
            receiver,
            motions,
            () if actions is None else actions.names,
            place,
            recorded=settings.pours == 0 and not section.confirm,
        )
        scenes.append(scene)
        if scene is None:
            break  # one cause, one message
    complete = tuple(scene for scene in scenes if scene is not None)
    if not complete or len(complete) < len(receivers) or actions is None or not known:
        return None
    data = None
    if isinstance(section, LearningSection) and section.data is not None:
        data = resolve_data(section.data, place.at("data"), complete, actions, laboratory, report)
    return DeploymentPlan(
        settings=settings,
        scenes=complete,
        actions=actions,
        loss=loss,
        data=data,
        objectives=resolve_objectives(section, place, complete[0], actions, report),
        constraints=constraints,
        confirm=section.confirm,
    )


def _check_that_pouring_pays(loss: Loss, actions: Space, place: Place, builder: SceneBuilder) -> None:
    """If a pour can stop before any liquid leaves, stopping early must not be the optimum."""
    stops = [name for name in STOPS if name in actions.names]
    if not stops or (loss.name == "spilled_and_retained" and loss.retained_weight != 0.0):
        return
    at, what = (
        (place.at("retained_weight"), "with 0 the loss")
        if loss.name == "spilled_and_retained"
        else (place.at("name"), f"'{loss.name}'")
    )
    builder.report.add(
        at,
        f"{what} is least where next to nothing is poured, and with {' and '.join(stops)} searched a pour can stop so "
        f"early; fix {' and '.join(stops)} under motion, use spilled_and_retained with a retained_weight above 0, or "
        "'objectives' with their 'floor'",
    )


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


def resolve_campaign(file: CampaignFile, root: Place, report: Report) -> CampaignPlan | None:
    """The plan of a campaign. Problems are added to the report; the plan may then be None."""
    references = References(report)
    laboratory: LaboratorySettings | None = references.laboratory(file.laboratory, root.at("laboratory"))
    liquid = references.liquid(file.liquid, root.at("liquid"))
    builder = SceneBuilder(file, root, references, liquid)
    for role in ("pourer", "receiver"):  # checked even if the sections override it
        if file.value(role) is not None:
            references.vessel(file.value(role), root.at(role))
    parameters: ParametersBase | None = file.simulator.parameters
    fixed = {} if parameters is None else parameters.fixed()
    searched = {} if parameters is None else parameters.searched()
    default = SimulationParameters().model_dump()
    fixed = {name: float(value) for name, value in default.items() if name not in searched} | fixed
    check_ranges(file, root, report)
    calibration = deployment = None
    if file.calibration is not None:
        calibration = resolve_calibration(
            file.calibration,
            builder,
            fixed,
            searched,
            root.at("calibration"),
            laboratory,
            () if parameters is None else parameters.priors(),
        )
    if file.deployment is not None:
        deployment = resolve_deployment(file.deployment, builder, root.at("deployment"), laboratory)
    broken = any(report.is_broken(root.at(key)) for key in ("calibration", "deployment"))
    if not broken and (file.calibration is None or file.calibration.actions is not None):
        builder.refuse_prior(file.actions, root, "decides nothing: no calibration takes its actions from here")
    if file.calibration is None and file.deployment is None and not broken:
        report.add(root, "there is nothing to do; add a 'calibration' or a 'deployment' section")
    if file.on_unknown == "repeat" and laboratory is not None and not _is_virtual(laboratory):
        report.add(
            root.at("on_unknown"),
            f"'repeat' needs a virtual bench, and laboratory '{laboratory.name}' has none; use 'ask'",
        )
    if report.problems or laboratory is None or file.name is None:
        return None
    directory = file.outputs.folder if file.outputs.directory is None else root.directory / file.outputs.directory
    outputs = file.outputs.model_copy(update={"directory": str(resolved(directory))})
    in_force = default if parameters is None else default | parameters.in_force()
    return CampaignPlan(
        name=file.name,
        seed=file.seed,
        source=root.document.path,
        laboratory=laboratory,
        parameters=SimulationParameters.from_values(in_force),
        calibration=calibration,
        deployment=deployment,
        outputs=outputs,
        parallel_simulations=file.parallel_simulations,
        on_unknown=file.on_unknown,
        resolved=as_file(file.model_copy(update={"outputs": outputs}), root, references),
        laboratory_source=(resolved(root.directory / file.laboratory) if isinstance(file.laboratory, str) else None),
    )


def _is_virtual(laboratory: LaboratorySettings) -> bool:
    return laboratory.mode == "virtual" and laboratory.bench is not None
