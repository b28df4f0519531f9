"""Converts a campaign's file to a plan and checks the combinations of its keys.

- `resolve_campaign` is the entry point.
- `resolve_deployment` determines scenes, budgets, loss and existing data of the deployment.
- `resolve_objectives` checks and converts several objectives instead of a loss.

Sections are validated before (`orchestrator.config.yaml.section_validation`); vessels are not built here.
"""

from __future__ import annotations

from pathlib import Path

from actors.laboratory_settings import LaboratorySettings
from orchestrator.config.calibration_resolution import resolve_calibration, resolve_data
from orchestrator.config.campaign_checks import check_ranges
from orchestrator.config.campaign_file import CampaignFile, DeploymentSection, LearningSection, LossSection
from orchestrator.config.parameter_ranges import ParametersBase
from orchestrator.config.run_snapshot import campaign_record
from orchestrator.config.scene_builder import SceneBuilder
from orchestrator.config.yaml.file_access import resolved
from orchestrator.config.yaml.references import References
from orchestrator.config.yaml.section_validation import PlacedProblems
from orchestrator.config.yaml.yaml_source import Place, Report
from orchestrator.strategies.campaign_plan import CampaignPlan, DeploymentPlan, OutputPlan, Premises
from orchestrator.strategies.deployment.objectives import STOPS, Objectives
from sim_engine.liquids import SimulationParameters
from sim_engine.outcome import Loss
from sim_engine.scene import Scene
from sim_engine.search_space import Space


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
    loss = section.loss or LossSection()
    if loss.retained_weight is not None and loss.name != "spilled_and_retained":
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
        loss=Loss(loss.name, 1.0 if loss.retained_weight is None else loss.retained_weight),
        data=data,
        objectives=resolve_objectives(section, place, complete[0], actions, report),
        constraints=constraints,
        confirm=section.confirm,
    )


def _check_that_pouring_pays(loss: LossSection, actions: Space, place: Place, builder: SceneBuilder) -> None:
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
    directory = _directory(file.outputs.directory, root)
    in_force = default if parameters is None else default | parameters.in_force()
    return CampaignPlan(
        name=file.name,
        seed=file.seed,
        source=root.document.path,
        laboratory=laboratory,
        parameters=SimulationParameters.from_values(in_force),
        calibration=calibration,
        deployment=deployment,
        outputs=OutputPlan(
            directory=directory,
            rrd=file.outputs.rrd,
            figures=file.outputs.figures,
            record_rate=file.outputs.record_rate,
            recorded_simulations=file.outputs.recorded_simulations,
        ),
        parallel_simulations=file.parallel_simulations,
        on_unknown=file.on_unknown,
        resolved=campaign_record(file, root, references, directory),
        laboratory_source=(resolved(root.directory / file.laboratory) if isinstance(file.laboratory, str) else None),
    )


def _directory(text: str | None, root: Place) -> Path:
    return resolved(Path("runs") if text is None else root.directory / text)


def _is_virtual(laboratory: LaboratorySettings) -> bool:
    return laboratory.mode == "virtual" and laboratory.bench is not None
