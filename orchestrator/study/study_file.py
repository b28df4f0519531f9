"""Study files: the YAML sections of a study and their conversion to a plan.

- `StudyFile` is the whole file; `LevelSection` is a level of mismatch between bench and simulator.
- `CalibrationsBase` and `DeploymentsBase` list the compared strategies. Keys for strategies of installed packages are
  added to them.
- `load_study` reads a file and returns its `StudyPlan`.

Levels and strategies are resolved in `study_resolution`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, ClassVar

from pydantic import Field, create_model

from orchestrator.config.file_loading import load_campaign
from orchestrator.config.laboratory_file import HiddenLiquid, LaboratoryFile
from orchestrator.config.run_snapshot import as_file
from orchestrator.config.search_ranges import Parameters, ParametersBase
from orchestrator.config.yaml.file_access import missing_file, resolved
from orchestrator.config.yaml.references import References
from orchestrator.config.yaml.section_validation import validate
from orchestrator.config.yaml.yaml_errors import ConfigError
from orchestrator.config.yaml.yaml_source import Document, Place, Report, wrong_kind
from orchestrator.strategies.calibration.continuous_calibration import C4Settings
from orchestrator.strategies.calibration.pointwise_calibration import C1Settings, C2Settings, C3Settings
from orchestrator.strategies.campaign_plan import CampaignPlan, StrategySettings
from orchestrator.strategies.deployment.d1 import D1Settings
from orchestrator.strategies.deployment.d2 import D2Settings
from orchestrator.strategies.deployment.d3 import D3Settings
from orchestrator.strategies.deployment.disturbances import PoseErrorSection, PoseNoiseSection
from orchestrator.strategies.strategy_registry import calibrations, deployments
from orchestrator.study.study_plan import ALL, StudyPlan
from orchestrator.study.study_resolution import bench_of, calibration_arms, deployment_arms, levels_of, written_levels
from sim_engine.liquids import SimulationParameters
from sim_engine.search_space import Space
from sim_engine.settings.model import (
    MADE,
    FilePath,
    Name,
    PathOr,
    PositiveCount,
    PositivePourCount,
    PositiveSimulationCount,
    PourCount,
    Seed,
    Settings,
    SimulationCount,
    Text,
)


class ArmSection(Settings):
    """A compared strategy: its number of repetitions and its budget."""

    required: ClassVar[dict[str, str]] = {"repetitions": "10"}

    repetitions: Annotated[PositiveCount, Field(le=10_000)] | None = None
    """Number of runs: each run of a calibration has its own pours, a deployment runs once per receiver."""

    def changes(self) -> dict[str, Any]:
        """Settings of the strategy that the arm gives."""
        own = type(self).model_fields.keys() - ArmSection.model_fields.keys()
        return {name: value for name in own if (value := getattr(self, name)) is not None}


def _arm(settings: type[StrategySettings], *keys: str, **required: str) -> Any:
    """Make the section of an arm from some of its strategy's settings; only the given ones are required."""
    fields: Any = {}
    for key in keys:
        info = settings.model_fields[key]
        value: Any = Annotated[(info.annotation, *info.metadata)] if info.metadata else info.annotation
        fields[key] = (value | None, Field(None, description=info.description))
    name = f"{settings.model_fields['strategy'].default}ArmSection"
    model = create_model(name, __base__=ArmSection, __doc__=ArmSection.__doc__, **fields)
    model.required = ArmSection.required | required
    model.variant = settings.model_fields["strategy"].default
    return model


C1Arm: Any = _arm(C1Settings, "per_axis", per_axis="10")
C2Arm: Any = _arm(C2Settings, "samples", samples="18")
C3Arm: Any = _arm(C3Settings, "iterations", "initial", "kappa", iterations="59")
C4Arm: Any = _arm(C4Settings, "simulations", "initial", "kappa", simulations="108")
D2Arm: Any = _arm(D2Settings, "pours", "mean", "initial", "kappa", pours="15")


class D1ArmSection(_arm(D1Settings, "simulations_per_iteration", "initial", "kappa")):  # type: ignore[misc]
    """A compared strategy: its number of repetitions and its budget."""

    iterations: list[PositiveSimulationCount] = Field(default=[15], min_length=1)
    """Iterations of the optimiser, one campaign for each number: [5, 10, 15]."""


class D3ArmSection(_arm(D3Settings, "pours", "prior_simulations", "initial", "kappa", pours="15")):  # type: ignore[misc]
    """A compared strategy: its number of repetitions and its budget."""

    per_pour: SimulationCount | None = None
    """Simulations between two pours; not 'free', because the requests would then depend on the clock."""


class C4ActiveArmSection(_arm(C4Settings, "simulations", "initial", "kappa", simulations="108", pours="6")):  # type: ignore[misc]
    """C4 with pours that it chooses itself, each by its expected information about the deployments."""

    pours: PositivePourCount | None = None
    """Number of training pours to choose; the score uses the repetition's test pours."""

    design_simulations: PositiveSimulationCount = 64
    """Number of simulations for the choice."""

    def changes(self) -> dict[str, Any]:
        """Settings of C4 that the arm gives."""
        return {name: value for name, value in super().changes().items() if name in C4Settings.model_fields}


class CalibrationsBase(Settings):
    """The compared calibrations."""

    C1: C1Arm | None = None
    """Uniform grid."""

    C2: C2Arm | None = None
    """Stratified sampling."""

    C3: C3Arm | None = None
    """Bayesian optimisation, each θ on all training pours."""

    C4: C4Arm | None = None
    """Bayesian optimisation, one simulation per iteration; D1 and D3 simulate with the θ that it recommends."""

    C4_paper: C4Arm | None = None
    """C4 as in the paper: the surrogate treats the action's influence as noise. It is compared only; no deployment uses
    it."""

    C4_active: C4ActiveArmSection | None = None
    """C4 on fewer pours that are chosen actively. It is compared only; no deployment uses it."""


class DeploymentsBase(Settings):
    """The compared deployments, into each of the base campaign's receivers."""

    D1: D1ArmSection | None = None
    """Plan in simulation, pour once."""

    D2: D2Arm | None = None
    """Learn from real pours."""

    D2_paper: D2Arm | None = None
    """D2 as in the paper: a surrogate with a zero mean."""

    D3: D3ArmSection | None = None
    """Real pours with a simulated prior; the campaign selects the model of the prior."""

    D3_paper: D3ArmSection | None = None
    """D3 as in the paper: a GP of the residual around the simulations' mean, without a check."""


def _with_others(base: type[Settings], installed: Mapping[str, type[StrategySettings]]) -> Any:
    """Add a key for each strategy of an installed package, with the settings of the strategy."""
    fields: Any = {}
    for name, settings in installed.items():
        if name not in base.model_fields:
            own = settings.model_fields.keys() - {"strategy"}
            meaning = settings.model_fields["strategy"].description
            fields[name] = (_arm(settings, *sorted(own)) | None, Field(None, description=meaning))
    name = base.__name__.replace("Base", "Settings")
    return create_model(name, __base__=base, __doc__=base.__doc__, __cls_kwargs__=MADE, **fields)


CalibrationsSection: Any = _with_others(CalibrationsBase, calibrations())
DeploymentsSection: Any = _with_others(DeploymentsBase, deployments())


class LevelSection(Settings):
    """Level of mismatch between the bench and the simulator."""

    required: ClassVar[dict[str, str]] = {"name": "moderate", "liquid": "{particles: 4000, cohesion: 0.05 N/m}"}

    name: Name | None = None
    """Name of the level in figures and folders."""

    liquid: HiddenLiquid | None = None
    """Hidden θ of the 'real' liquid; calibration never reads it."""

    pose_error: PoseErrorSection = PoseErrorSection()
    """Systematic error of grip and placement."""

    pose_noise: PoseNoiseSection = PoseNoiseSection()
    """Scatter of the pose error, drawn for each pour."""


class StudyFile(Settings):
    """A study: repeated and compared calibrations and deployments of a campaign."""

    required: ClassVar[dict[str, str]] = {
        "name": "paper",
        "campaign": "../campaigns/paper.yaml",
    }

    name: Name | None = None
    """Name of the study; runs are written to study-NAME."""

    seed: Seed = 0
    """Seed of all random choices."""

    campaign: FilePath | None = None
    """File of the base campaign: vessels, motions, action spaces, ranges of θ, calibration pours, loss."""

    laboratory: PathOr[LaboratoryFile] | None = None
    """Laboratory that replaces the campaign's: a virtual one with a bench, simulated directly or over wires."""

    parameters: Parameters | None = None
    """Parameters that replace the campaign's of the same names: a value fixes one, a range searches it."""

    search: list[Text] | None = None
    """Names of the campaign's searched parameters that the study searches. The others have their default, or the
    nearest value in the campaign's range."""

    pours: PositivePourCount | None = None
    """Calibration pours of a repetition, instead of the campaign's number."""

    holdout: PositivePourCount | None = None
    """Number of these pours that are kept for testing."""

    mismatch: list[LevelSection] | None = None
    """Levels of mismatch between bench and simulator. Unless given, there is one level: the laboratory's bench under
    its own name."""

    compared: Text | None = None
    """Level at which C1 to C4 are compared, or 'all'; unless given, the first level. C4 runs at all levels."""

    random_baseline: SimulationCount = 0
    """Number of random parameters that each calibration is compared with."""

    calibration: CalibrationsSection | None = None
    """The calibrations."""

    deployment: DeploymentsSection | None = None
    """The deployments."""

    confirm: PourCount | None = None
    """Number of repetitions of each deployment's recommended action at its end, on the same bench with new random
    errors; 0 unless given. The number can be raised later, like the repetitions."""

    directory: FilePath | None = None
    """Directory for the study's folder; unless given, 'runs' in the working directory."""


def load_study(path: Path) -> StudyPlan:
    """Read the plan of a study file, with all files that it refers to.

    Raises:
        ConfigError: the file or one that it refers to is invalid; all problems are reported at once.
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
