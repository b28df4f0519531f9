"""Converts a campaign's file to a plan and checks the combinations of its keys.

- `resolve_campaign` is the entry point.
- `resolve_calibration` determines scenes, pours, budgets and priors of the calibration.
- `resolve_deployment` determines scenes, budgets, loss and existing data of the deployment.

Sections are validated before (`orchestrator.campaigns.yaml.section_validation`); vessels are not built here.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

from actors.laboratory_settings import LaboratorySettings
from actors.optimizer.questions import Linear
from orchestrator.campaigns.campaign_file import (
    CalibrationSection,
    CampaignFile,
    DeploymentSection,
    LearningSettings,
    MixturesSettings,
    PoursSettings,
    StageSettings,
    owners_of_priors,
)
from orchestrator.campaigns.campaign_prior import PosteriorSource, PriorNeeds, ResolvedPrior, resolve_prior
from orchestrator.campaigns.dose_resolution import cell_vessels, require_bench, resolve_dispense, resolve_mixtures
from orchestrator.campaigns.file_references import References
from orchestrator.campaigns.pour_table import RecordTable
from orchestrator.campaigns.run_snapshot import as_file
from orchestrator.campaigns.scene_builder import SceneBuilder
from orchestrator.campaigns.search_ranges import ParametersBase
from orchestrator.campaigns.weighed_pours import read_table, records_of_run, resolve_data, resolve_records
from orchestrator.campaigns.yaml.file_access import resolved
from orchestrator.campaigns.yaml.section_validation import PlacedProblems
from orchestrator.campaigns.yaml.yaml_source import Place, Report
from orchestrator.learning.calibration.campaign_memory import CampaignMemory
from orchestrator.learning.campaign_plan import (
    LEAST_TRAINING_POURS,
    CalibrationPlan,
    CampaignPlan,
    DeploymentPlan,
    DispensePlan,
    NormalPrior,
    RecordSet,
)
from orchestrator.learning.deployment.objectives import STOPS
from sim_engine.liquids import SimulationParameters
from sim_engine.outcome import MINIMUM_POURED, Loss
from sim_engine.scene import Scene
from sim_engine.search_space import Axis, Space
from sim_engine.vessel.shapes import VesselSpec

TILT_SPEEDS = ("angular_velocity", "return_velocity")
"""Searched speeds of the tilt, which an arm limits."""


@dataclass(frozen=True)
class StageGround:
    """What calibration and deployment have in common: vessels, actions, and the scenes made of them."""

    builder: SceneBuilder
    section: StageSettings
    place: Place
    pourer: VesselSpec | None
    receivers: list[VesselSpec | None]
    actions: Space | None
    constraints: tuple[Linear, ...]

    @classmethod
    def of(cls, section: StageSettings, builder: SceneBuilder, place: Place, *, inherit: bool) -> StageGround:
        """Resolve the vessels and actions of a section; `inherit` includes the campaign's `receivers`."""
        pourer = builder.pourer(section.pourer, place)
        receivers = builder.receivers(section, place, inherit=inherit)
        actions = builder.space(section.actions, section.motion, place)
        constraints = builder.constraints(section.actions, place, actions)
        return cls(builder, section, place, pourer, receivers, actions, constraints)

    @property
    def motions(self) -> tuple[tuple[Any, Place], ...]:
        """The sections that replace the campaign's motion."""
        return ((self.section.motion, self.place.at("motion")),)

    def scene(self, name: str, receiver: VesselSpec | None, **options: Any) -> Scene | None:
        """A scene with one of the receivers; `options` as in `SceneBuilder.scene`."""
        searched = () if self.actions is None else self.actions.names
        return self.builder.scene(name, self.pourer, receiver, self.motions, searched, self.place, **options)


def resolve_deployment(
    section: DeploymentSection, builder: SceneBuilder, place: Place, laboratory: LaboratorySettings | None
) -> DeploymentPlan | None:
    """The plan of a deployment. Problems are added to the report; the plan may then be None."""
    report, settings = builder.report, section.settings
    strategy_valid = not report.is_broken(place.at("strategy"))
    ground = StageGround.of(section, builder, place, inherit=True)
    actions = ground.actions
    why = "is what calibration averages over; deployment looks for the best action"
    builder.refuse_prior(section.actions, place, why)
    if strategy_valid:
        problems = PlacedProblems(place, report, frozenset(DeploymentSection.model_fields))
        settings.check(problems)
    if settings.pours and laboratory is not None and not laboratory.pours:
        at = place.at("pours") if "pours" in settings.model_fields_set else place
        hint = "name one with a bench" if settings.learns_on_pours else "'pours: 0' only plans"
        report.add(at, f"laboratory '{laboratory.name}' has no bench to pour on; {hint}")
    elif section.confirm and laboratory is not None and not laboratory.pours:
        text = f"laboratory '{laboratory.name}' has no bench to pour on; name one with a bench, or remove it"
        report.add(place.at("confirm"), text)
    loss = section.loss or Loss()
    if actions is not None and section.objective is None:
        _check_that_pouring_pays(loss, actions, place.at("loss"), report)
    scenes = []
    for receiver in ground.receivers or [None]:
        name = "deployment" if receiver is None else f"deployment-{receiver.name}"
        scene = ground.scene(name, receiver, recorded=settings.pours == 0 and not section.confirm)
        if scene is None:
            return None  # one cause, one message
        scenes.append(scene)
    if actions is None or not strategy_valid:
        return None
    if section.objective is not None and not report.is_broken(place.at("objective", "name")):
        section.objective.check(scenes[0], actions, PlacedProblems(place.at("objective"), report))
    data = None
    if isinstance(section, LearningSettings) and section.data is not None:
        data = resolve_data(section.data, place.at("data"), tuple(scenes), actions, laboratory, report)
    return DeploymentPlan(
        settings=settings,
        scenes=tuple(scenes),
        actions=actions,
        loss=loss,
        data=data,
        objective=section.objective,
        constraints=ground.constraints,
        confirm=section.confirm,
    )


def _check_that_pouring_pays(loss: Loss, actions: Space, place: Place, report: Report) -> None:
    """If a pour can stop before any liquid leaves, stopping early must not be the optimum."""
    stops = [name for name in STOPS if name in actions.names]
    if not stops or (loss.name == "spilled_and_retained" and loss.retained_weight != 0.0):
        return
    at, verb = (
        (place.at("retained_weight"), "with 0 the loss")
        if loss.name == "spilled_and_retained"
        else (place.at("name"), f"'{loss.name}'")
    )
    report.add(
        at,
        f"{verb} is least where next to nothing is poured, and with {' and '.join(stops)} searched a pour can stop so "
        f"early; fix {' and '.join(stops)} under motion, use spilled_and_retained with a retained_weight above 0, or "
        "an 'objective' with its 'floor'",
    )


def resolve_calibration(
    section: CalibrationSection,
    builder: SceneBuilder,
    fixed: dict[str, float],
    searched: dict[str, Axis],
    place: Place,
    laboratory: LaboratorySettings | None,
    priors: tuple[NormalPrior, ...] = (),
) -> CalibrationPlan | None:
    """The plan of a calibration. Problems are added to the report; the plan may then be None.

    Args:
        fixed: parameters that are not searched, by name.
        searched: axes of the searched parameters, by name.
        place: place of the section.
        priors: priors of searched parameters.
    """
    report, at = builder.report, place.at("pours")
    ground = StageGround.of(section, builder, place, inherit=False)
    prior = _prior(section, builder, place, ground.actions, ground.constraints)
    pours: PoursSettings = section.pours or PoursSettings()  # a draft may lack it, which is reported
    table = read_table(pours, pours.source, at.at("from"), builder)
    scenes = _calibration_scenes(pours, at, ground, table)
    records, transfer = _existing_pours(pours, at, ground, scenes, table, laboratory)
    if pours.are_made:
        _check_that_bench_pours(pours, laboratory, at.at("count"), report)
    count, holdout = (pours.count or 0, pours.held_out) if pours.are_made else (0, 0)
    train = count - holdout if records is None else records.training_pours
    if records is not None and not report.is_broken(place.at("strategy")):
        _check_training_pours(train, at.at("from" if pours.source is not None else "from_run"), report)
    settings = None
    if not report.is_broken(place.at("strategy")):
        problems = PlacedProblems(place, report, frozenset(CalibrationSection.model_fields))
        settings = section.settings.settled(tuple(searched), train, problems)
    if scenes.first is None or len(scenes.further) < len(ground.receivers) - 1:
        return None
    if ground.actions is None or settings is None or not searched:
        return None
    return CalibrationPlan(
        settings=settings,
        scene=scenes.first,
        actions=ground.actions,
        constraints=ground.constraints,
        prior=prior,
        parameters=Space(tuple(searched.values())),
        fixed_parameters=fixed,
        pour_count=count,
        holdout=holdout,
        records=records,
        transfer=transfer,
        random_baseline=section.random_baseline,
        parameter_prior=priors,
        further=scenes.further,
        tested=scenes.tested,
    )


@dataclass(frozen=True)
class _CalibrationScenes:
    """Scenes of a calibration's pours.

    Attributes:
        first: with the first receiver; None after a problem.
        further: with the other receivers.
        tested: with the receivers that are held out for testing.
    """

    first: Scene | None
    further: tuple[Scene, ...]
    tested: tuple[Scene, ...]


def _calibration_scenes(
    pours: PoursSettings, at: Place, ground: StageGround, table: RecordTable | None
) -> _CalibrationScenes:
    """The scenes of a calibration; `at` is the place of its pours, `table` the file with them."""
    report, receivers = ground.builder.report, ground.receivers
    first = ground.scene(
        "calibration",
        receivers[0] if receivers else None,
        recorded=not pours.are_made,
        constants={} if table is None else table.constants(),
        unread=table is None and (pours.source is not None or report.is_broken(at.at("from"))),
    )
    if first is None:
        return _CalibrationScenes(None, (), _tested_scenes(pours, at, ground, None, ()))
    others = [receiver for receiver in receivers[1:] if receiver is not None]
    scenes = [ground.scene(f"calibration-{other.name}", other) for other in others]
    if scenes and pours.source is not None:
        text = "stands beside pours that are read 'from' a file, which were made into one; keep 'receiver'"
        report.add(ground.place.at("receivers"), text, key=True)
    further = tuple(scene for scene in scenes if scene is not None)
    return _CalibrationScenes(first, further, _tested_scenes(pours, at, ground, first, further))


def _existing_pours(
    pours: PoursSettings,
    at: Place,
    ground: StageGround,
    scenes: _CalibrationScenes,
    table: RecordTable | None,
    laboratory: LaboratorySettings | None,
) -> tuple[RecordSet | None, RecordSet | None]:
    """Pours from a file or an earlier run, and those of the transfer scene; None where there are none."""
    builder, first = ground.builder, scenes.first
    if pours.source is not None:
        return resolve_records(pours, at, builder, table, ground.actions, first, ground.pourer, ground.motions)
    if pours.from_run is None or first is None or ground.actions is None:
        return None, None
    poured, place = (first, *scenes.further, *scenes.tested), at.at("from_run")
    return records_of_run(pours.from_run, place, poured, ground.actions, laboratory, builder.report), None


def _check_that_bench_pours(
    pours: PoursSettings, laboratory: LaboratorySettings | None, place: Place, report: Report
) -> None:
    """Check that pours which are to be made have a bench."""
    if pours.count and laboratory is not None and not laboratory.pours:
        text = f"laboratory '{laboratory.name}' has no bench to pour on; name a CSV file with 'from'"
        report.add(place, text)


def _tested_scenes(
    pours: PoursSettings, at: Place, ground: StageGround, scene: Scene | None, others: tuple[Scene, ...]
) -> tuple[Scene, ...]:
    """Scenes with the receivers that are held out for testing.

    Args:
        at: place of the pours.
        scene: with the first receiver; None after a problem.
        others: scenes with the other receivers.
    """
    tested: list[Scene] = []
    for i, value in enumerate(pours.holdout_receivers or ()):
        place = at.at("holdout_receivers", i)
        vessel = ground.builder.references.vessel(value, place)
        if vessel is None or scene is None:
            continue
        name = f"calibration-{vessel.name}"
        if name in {other.name for other in (*others, *tested)}:
            ground.builder.report.add(place, f"'{vessel.name}' is poured into already")
        held_out = ground.scene(name, vessel)
        if held_out is not None:
            tested.append(held_out)
    return tuple(tested)


def _check_training_pours(count: int, source: Place, report: Report) -> None:
    """Check that enough pours of a file or of an earlier run can be fitted."""
    if count < LEAST_TRAINING_POURS and not report.is_broken(source):
        report.add(
            source,
            f"has {count or 'no'} training pour{'s' * (count != 1)} with at least {MINIMUM_POURED:.0%} poured; a "
            f"calibration needs {LEAST_TRAINING_POURS}",
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
        why = f"belongs to {owners_of_priors()}, which averages over the prior; {strategy} simulates the weighed pours"
        local = section.actions is not None
        builder.refuse_prior(section.actions if local else builder.file.actions, place if local else builder.root, why)
    return ()


def resolve_campaign(
    file: CampaignFile, root: Place, report: Report, posteriors: Callable[[], PosteriorSource]
) -> CampaignPlan | None:
    """The plan of a campaign. Problems are added to the report; the plan may then be None."""
    references = References(report)
    laboratory: LaboratorySettings | None = references.laboratory(file.laboratory, root.at("laboratory"))
    builder = SceneBuilder(file, root, references, references.liquid(file.liquid, root.at("liquid")))
    for role in ("pourer", "receiver"):  # checked even if the sections override it
        if file.value(role) is not None:
            references.vessel(file.value(role), root.at(role))
    sections = _resolved_sections(file, builder, root, laboratory)
    memory = None
    if file.prior is not None and laboratory is not None and not report.problems:
        memory = _memory(file, sections, laboratory, root.at("prior"), references, posteriors)
    if not report.problems:
        sections = sections.with_memory(file, memory).with_arm_limits(laboratory)
    _check_actions(file, builder, root)
    if laboratory is not None:
        _check_repeating(file, sections, laboratory, root.at("on_unknown"), report)
        _check_unattended(file, laboratory, root.at("unattended"), report)
    if report.problems or laboratory is None:
        return None
    return _campaign_plan(file, sections, laboratory, memory, root, references)


@dataclass(frozen=True)
class _Sections:
    """The sections of a campaign as plans; None for a section that is missing or has problems.

    Attributes:
        mixtures: the section that the doses of mixtures are made from, with its defaults.
        pour: scene of a single pour.
    """

    calibration: CalibrationPlan | None
    deployment: DeploymentPlan | None
    dispense: DispensePlan | None
    mixtures: MixturesSettings | None
    pour: Scene | None

    def with_memory(self, file: CampaignFile, memory: CampaignMemory | None) -> _Sections:
        """The same with the prior in the stage that uses it."""
        if file.calibration is not None and self.calibration is not None:
            design, simulations = file.calibration.pours.designed(memory)
            calibration = replace(self.calibration, memory=memory, design=design, design_simulations=simulations)
            return replace(self, calibration=calibration)
        if memory is not None and self.deployment is not None:
            return replace(self, deployment=replace(self.deployment, memory=memory))
        return self

    def with_arm_limits(self, laboratory: LaboratorySettings | None) -> _Sections:
        """The same with the arm's limits as constraints on the pours that it will make."""
        calibration, deployment = self.calibration, self.deployment
        if calibration is not None and calibration.records is None:
            limits = _arm_limits(calibration.actions, laboratory)
            calibration = replace(calibration, constraints=(*calibration.constraints, *limits))
        if deployment is not None:
            limits = _arm_limits(deployment.actions, laboratory)
            deployment = replace(deployment, constraints=(*deployment.constraints, *limits))
        return replace(self, calibration=calibration, deployment=deployment)

    @property
    def prior_means(self) -> Mapping[str, float]:
        """Parameters that a deployment without a calibration takes from its prior."""
        if self.calibration is not None or self.deployment is None or self.deployment.memory is None:
            return {}
        return self.deployment.memory.means


def _resolved_sections(
    file: CampaignFile, builder: SceneBuilder, root: Place, laboratory: LaboratorySettings | None
) -> _Sections:
    calibration = deployment = dispense = pour = None
    if file.calibration is not None:
        parameters: ParametersBase | None = file.simulator.parameters
        fixed = {} if parameters is None else parameters.fixed()
        searched = {} if parameters is None else parameters.searched()
        calibration = resolve_calibration(
            file.calibration,
            builder,
            SimulationParameters.from_values(fixed).fixed_values(searched),
            searched,
            root.at("calibration"),
            laboratory,
            () if parameters is None else parameters.priors(),
        )
    if file.deployment is not None:
        deployment = resolve_deployment(file.deployment, builder, root.at("deployment"), laboratory)
    mixtures = file.mixtures
    if file.dispense is not None:
        dispense = resolve_dispense(file.dispense, builder, root.at("dispense"), laboratory)
    elif mixtures is not None:
        dispense, mixtures = resolve_mixtures(mixtures, builder, root.at("mixtures"), laboratory)
    if file.pour:
        require_bench(laboratory, root.at("pour"), builder.report)
        vessels = builder.pourer(None, root), builder.receiver(None, root)
        pour = builder.scene("pour", *vessels, (), (), root)
    return _Sections(calibration, deployment, dispense, mixtures, pour)


def _check_actions(file: CampaignFile, builder: SceneBuilder, root: Place) -> None:
    """Check that the campaign's actions have no prior that nothing averages over."""
    broken = any(builder.report.is_broken(root.at(key)) for key in ("calibration", "deployment"))
    if not broken and (file.calibration is None or file.calibration.actions is not None):
        builder.refuse_prior(file.actions, root, "decides nothing: no calibration takes its actions from here")


def _check_repeating(
    file: CampaignFile, sections: _Sections, laboratory: LaboratorySettings, at: Place, report: Report
) -> None:
    """Check that a pour with unknown outcome may be repeated, if the file requests it."""
    if file.on_unknown != "repeat":
        return
    if laboratory.mode != "virtual" or not laboratory.pours:
        report.add(at, f"'repeat' needs a virtual bench, and laboratory '{laboratory.name}' has none; use 'ask'")
    elif laboratory.places and sections.dispense is not None:
        kept = f"the vessels of laboratory '{laboratory.name}' keep what is in them"
        report.add(at, f"'repeat' would dose twice: {kept}; use 'ask'")


def _check_unattended(file: CampaignFile, laboratory: LaboratorySettings, at: Place, report: Report) -> None:
    """Check that the laboratory can pour without a person, if the file requests it."""
    if file.unattended is None or (laboratory.places and laboratory.safeguard):
        return
    missing = "'safeguard'" if laboratory.places else "'gripper' and 'places'"
    report.add(at, f"pours without a person need {missing} in the file of laboratory '{laboratory.name}'")


def _campaign_plan(
    file: CampaignFile,
    sections: _Sections,
    laboratory: LaboratorySettings,
    memory: CampaignMemory | None,
    root: Place,
    references: References,
) -> CampaignPlan:
    """The plan of a campaign without problems."""
    dispense, parameters = sections.dispense, file.simulator.parameters
    if file.unattended is not None:
        laboratory = laboratory.with_values(unattended=file.unattended)
    if dispense is not None:
        laboratory = laboratory.in_real_time()
        if laboratory.places:
            laboratory = laboratory.with_values(vessels=cell_vessels(dispense))
    in_force = SimulationParameters().model_dump() | ({} if parameters is None else parameters.in_force())
    directory = file.outputs.folder if file.outputs.directory is None else root.directory / file.outputs.directory
    outputs = file.outputs.model_copy(update={"directory": str(resolved(directory))})
    record: dict[str, Any] = {"outputs": outputs} | ({} if memory is None else {"prior": ResolvedPrior.of(memory)})
    record |= {} if sections.mixtures is None else {"mixtures": sections.mixtures}
    return CampaignPlan(
        name=file.name,
        seed=file.seed,
        source=root.document.path,
        laboratory=laboratory,
        parameters=SimulationParameters.from_values({**in_force, **sections.prior_means}),
        calibration=sections.calibration,
        deployment=sections.deployment,
        outputs=outputs,
        parallel_simulations=file.parallel_simulations,
        on_unknown=file.on_unknown,
        resolved=as_file(file.model_copy(update=record), root, references),
        laboratory_source=(resolved(root.directory / file.laboratory) if isinstance(file.laboratory, str) else None),
        dispense=dispense,
        pour=sections.pour,
    )


def _arm_limits(actions: Space, laboratory: LaboratorySettings | None) -> tuple[Linear, ...]:
    """Constraints with which searched speeds end at the limit of the arm that will make the pours."""
    limit = None if laboratory is None or laboratory.arm is None else laboratory.arm.tilt_speed_limit
    return tuple(
        Linear(((axis.name, 1.0),), limit)
        for axis in actions.axes
        if limit is not None and axis.name in TILT_SPEEDS and axis.lower < limit < axis.upper
    )


def _memory(
    file: CampaignFile,
    sections: _Sections,
    laboratory: LaboratorySettings,
    place: Place,
    references: References,
    posteriors: Callable[[], PosteriorSource],
) -> CampaignMemory | None:
    """The prior of a campaign from earlier ones; None after a problem."""
    calibration, deployment = sections.calibration, sections.deployment
    report, infos = references.report, SimulationParameters.info()
    if calibration is not None and not calibration.settings.makes_posterior:
        report.add(place, f"belongs to C4; {calibration.strategy} takes all values for alike", key=True)
        return None
    poured = deployment.scenes[0] if deployment is not None and deployment.settings.learns_offsets else None
    if calibration is not None:
        needs = PriorNeeds(
            scene=calibration.scene,
            laboratory=laboratory,
            wanted={axis.name: (axis.lower, axis.upper) for axis in calibration.parameters.axes},
            fixed=calibration.fixed_parameters,
            measured=frozenset(prior.name for prior in calibration.parameter_prior),
            poured=poured,
        )
    elif deployment is not None and deployment.settings.simulates:
        parameters: ParametersBase | None = file.simulator.parameters
        fixed = {} if parameters is None else parameters.fixed()
        needs = PriorNeeds(
            scene=deployment.scenes[0],
            laboratory=laboratory,
            wanted={name: (info.lower, info.upper) for name, info in infos.items() if name not in fixed},
            fixed=SimulationParameters().model_dump() | fixed,
            why="the campaign fixes",
            poured=poured,
        )
    else:
        reason = "doses have none" if deployment is None else f"{deployment.strategy} simulates nothing"
        report.add(place, f"tells about parameters of the simulator, and {reason}; remove it", key=True)
        return None

    return resolve_prior(file.prior, needs, place, references, posteriors)
