"""Studies as written in files: which strategies are compared, how often, and on benches that are how far off."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import ClassVar

from orchestrator.config.laboratory.sections import HiddenLiquid, LaboratoryFile
from orchestrator.config.load import load_campaign
from orchestrator.config.parameters import Parameters, ParametersBase
from orchestrator.config.pose import PoseErrorSection, PoseNoiseSection
from orchestrator.config.study.arms import CalibrationsSection, DeploymentsSection
from orchestrator.config.study.resolve import bench_of, calibration_arms, deployment_arms, levels_of, written_levels
from orchestrator.config.yaml.dump import as_file
from orchestrator.config.yaml.errors import ConfigError
from orchestrator.config.yaml.files import missing_file, resolved
from orchestrator.config.yaml.kinds import wrong_kind
from orchestrator.config.yaml.references import References
from orchestrator.config.yaml.sections import (
    FilePath,
    Name,
    PathOr,
    PositivePourCount,
    PourCount,
    Section,
    Seed,
    SimulationCount,
    Text,
)
from orchestrator.config.yaml.source import Document, Place, Report
from orchestrator.config.yaml.validate import validate
from orchestrator.plan import CampaignPlan
from orchestrator.study.plan import ALL, StudyPlan
from sim_engine.liquid import SimulationParameters
from sim_engine.space import Space


class LevelSection(Section):
    """How far the bench is from what the simulator can be."""

    required: ClassVar[dict[str, str]] = {"name": "moderate", "liquid": "{particles: 4000, cohesion: 0.05 N/m}"}

    name: Name | None = None
    """Its name in figures and folders."""

    liquid: HiddenLiquid | None = None
    """Hidden θ of the 'real' liquid; calibration never reads it."""

    pose_error: PoseErrorSection = PoseErrorSection()
    """Systematic error of grip and placement."""

    pose_noise: PoseNoiseSection = PoseNoiseSection()
    """Its scatter, drawn anew for each pour."""


class StudyFile(Section):
    """A study: a campaign's calibrations and deployments, repeated and compared."""

    required: ClassVar[dict[str, str]] = {
        "name": "paper",
        "campaign": "../campaigns/paper.yaml",
    }

    name: Name | None = None
    """Its name; runs go to study-NAME."""

    seed: Seed = 0
    """Seed of every random choice."""

    campaign: FilePath | None = None
    """File of the base campaign: vessels, motions, action spaces, ranges of θ, calibration pours, loss."""

    laboratory: PathOr[LaboratoryFile] | None = None
    """In place of the campaign's; a virtual one, with a bench: of numbers, or over wires."""

    parameters: Parameters | None = None  # type: ignore[valid-type]
    """In place of the campaign's parameters of the same names: a value fixes one, a range has it searched."""

    search: list[Text] | None = None
    """Which of the campaign's searched parameters are searched; the others keep the default, or what comes nearest to
    it within the campaign's range."""

    pours: PositivePourCount | None = None
    """Calibration pours of a repetition, in place of the campaign's."""

    holdout: PositivePourCount | None = None
    """How many of them are kept for testing."""

    mismatch: list[LevelSection] | None = None
    """Levels of mismatch between bench and simulator; unless given, one: the laboratory's bench as it is, under its
    name."""

    compared: Text | None = None
    """Level at which C1 to C4 are compared, or 'all'; the first unless given. C4 is run at all levels."""

    random_baseline: SimulationCount = 0
    """Random parameters that each calibration is scored beside."""

    calibration: CalibrationsSection | None = None
    """The calibrations."""

    deployment: DeploymentsSection | None = None
    """The deployments."""

    confirm: PourCount | None = None
    """How often each deployment's recommended action is poured again at its end, on the same bench with fresh chance
    errors; not at all unless given. May be raised later, as repetitions may."""

    directory: FilePath | None = None
    """Where the study's folder goes; 'runs' in the working directory unless given."""


def load_study(path: Path) -> StudyPlan:
    """The plan of a study file, with everything that it refers to.

    Raises:
        ConfigError: anything is wrong with it or with a file it refers to; all problems at once.
    """
    report = Report()
    place = Place(Document.read(resolved(path)))
    if (other := wrong_kind(place.document, "study")) is not None:
        raise ConfigError([other])
    section = validate(StudyFile, place, report)
    study = None if section is None else _resolve(section, place, report)
    report.raise_if_any()
    assert study is not None, "a study without problems has a plan"
    return study


def _resolve(file: StudyFile, root: Place, report: Report) -> StudyPlan | None:
    base = _base(file, root, report)
    written = written_levels(file.mismatch, root, report)
    if base is None:
        return None
    calibration = base.calibration
    if calibration is None or calibration.pour_count < 1:
        report.add(root.at("campaign"), "has no calibration on pours that are to be made (calibration.pours.count)")
        return None
    searched = _searched(file, base, root, report)
    count = file.pours or calibration.pour_count
    holdout = file.holdout or min(calibration.holdout, count - 1)
    if not 0 < holdout < count - 1:
        report.add(
            root.at("holdout") if file.holdout else root.at("campaign"),
            f"{holdout} of {count} pours for testing: a study needs at least one, and leaves two or more to fit",
        )
    at = root.at("laboratory" if file.laboratory is not None else "campaign")
    bench = bench_of(base.laboratory, at, report)
    if bench is None:
        return None
    levels = levels_of(written, base.laboratory.name, bench)
    names = tuple(level.name for level in levels)
    compared = file.compared or (names[0] if names else "")
    if names and compared not in (*names, ALL):
        report.add(root.at("compared"), f"no such level; there are {', '.join(names)}, and all")
    if (
        file.calibration is None
        and file.deployment is None
        and not any(report.is_broken(root.at(key)) for key in ("calibration", "deployment"))
    ):
        report.add(root, "there is nothing to compare; add a 'calibration' or a 'deployment' section", key=True)
    if file.confirm and file.deployment is None and not report.is_broken(root.at("deployment")):
        report.add(root.at("confirm"), "there is no deployment to confirm; add a 'deployment' section, or remove it")
    plan = replace(
        calibration,
        parameters=searched,
        parameter_prior=tuple(prior for prior in calibration.parameter_prior if prior.name in searched.names),
        pour_count=0,
        holdout=0,
        random_baseline=file.random_baseline,
        fixed_parameters={
            name: value for name, value in base.parameters.model_dump().items() if name not in searched.names
        },
    )
    arms = calibration_arms(file.calibration, plan, count - holdout, names, compared, root, report)
    poured = deployment_arms(file.deployment, base.deployment, arms, root, report)
    if not arms and not poured and not report.problems:
        empty = next(key for key in ("calibration", "deployment") if file.value(key) is not None)
        examples = {
            "calibration": "C4: {repetitions: 10, simulations: 108}",
            "deployment": "D2: {repetitions: 10, pours: 15}",
        }
        report.add(root.at(empty), f"there is nothing to compare; name a strategy, for example '{examples[empty]}'")
    if report.problems or file.name is None:
        return None
    return StudyPlan(
        name=file.name,
        seed=file.seed,
        source=root.document.path,
        base=replace(base, name=file.name, seed=file.seed, calibration=plan, deployment=None),
        levels=levels,
        calibrations=arms,
        deployments=poured,
        pour_count=count,
        holdout=holdout,
        compared=compared,
        confirm=file.confirm or 0,
        directory=resolved(Path("runs") if file.directory is None else root.directory / file.directory),
    )


def _base(file: StudyFile, root: Place, report: Report) -> CampaignPlan | None:
    references, laboratory = References(report), None
    if file.laboratory is not None:
        laboratory = references.laboratory(file.laboratory, root.at("laboratory"))
    if file.campaign is None:
        return None
    path = resolved(root.directory / file.campaign)
    if (missing := missing_file(path)) is not None:
        report.add(root.at("campaign"), missing)
        return None
    try:
        base = load_campaign(path)
    except ConfigError as error:
        report.problems.extend(error.problems)
        return None
    if laboratory is not None:
        found = references.section(file.laboratory, root.at("laboratory"), LaboratoryFile)
        record = {} if found is None else as_file(*found, references)
        base = replace(base, laboratory=laboratory, resolved={**base.resolved, "laboratory": record})
    return base if file.parameters is None else _with_parameters(base, file.parameters, root.at("parameters"), report)


def _with_parameters(base: CampaignPlan, changes: ParametersBase, place: Place, report: Report) -> CampaignPlan:
    """The plan with other values or ranges of θ."""
    fixed, searched = changes.fixed(), changes.searched()
    base = replace(base, parameters=SimulationParameters.from_values(base.parameters.model_dump() | changes.in_force()))
    if base.calibration is None:
        return base
    axes = {axis.name: axis for axis in base.calibration.parameters.axes if axis.name not in fixed} | searched
    if not axes:
        report.add(place, "fixes all that the campaign searches; leave a range to at least one")
        return base
    known = {**base.calibration.fixed_parameters, **fixed}
    calibration = replace(
        base.calibration,
        parameters=Space(tuple(axes.values())),
        parameter_prior=(
            *(prior for prior in base.calibration.parameter_prior if prior.name not in (*fixed, *searched)),
            *changes.priors(),
        ),
        fixed_parameters={name: value for name, value in known.items() if name not in axes},
    )
    return replace(base, calibration=calibration)


def _searched(file: StudyFile, base: CampaignPlan, root: Place, report: Report) -> Space:
    assert base.calibration is not None
    axes = {axis.name: axis for axis in base.calibration.parameters.axes}
    if file.search is None:
        return base.calibration.parameters
    for i, name in enumerate(file.search):
        if name not in axes:
            report.add(
                root.at("search", i), f"'{name}' is not searched by the campaign; searched are {', '.join(axes)}"
            )
        elif name in file.search[:i]:
            report.add(root.at("search", i), f"'{name}' stands twice; keep one")
    known = list(dict.fromkeys(name for name in file.search if name in axes))
    if not known:
        if not file.search:
            report.add(root.at("search"), "is empty; name parameters, or remove the key")
        return base.calibration.parameters
    return Space(tuple(axes[name] for name in known))
