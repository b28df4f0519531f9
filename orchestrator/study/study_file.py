"""Study files: the settings of a study, and their resolution to a plan.

- `StudyFile` is the whole file; `LevelSettings` is a level of mismatch between bench and simulator.
- `CalibrationsBase` and `DeploymentsBase` list the compared strategies. Keys for strategies of installed packages are
  added to them.
- `load_study` reads a file and returns its `StudyPlan`.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field, create_model

from actors.laboratory_settings import BenchSettings, LaboratorySettings, TrueLiquid
from orchestrator.campaigns.file_loading import load_campaign
from orchestrator.campaigns.file_references import References
from orchestrator.campaigns.run_snapshot import as_file
from orchestrator.campaigns.search_ranges import Parameters, ParametersBase
from orchestrator.campaigns.yaml.file_access import missing_file, resolved
from orchestrator.campaigns.yaml.section_validation import PlacedProblems, validate
from orchestrator.campaigns.yaml.yaml_errors import ConfigError
from orchestrator.campaigns.yaml.yaml_source import Document, Place, Report, wrong_kind
from orchestrator.learning.calibration.continuous_calibration import C4Settings
from orchestrator.learning.calibration.pointwise_calibration import C1Settings, C2Settings, C3Settings
from orchestrator.learning.campaign_plan import (
    CalibrationPlan,
    CampaignPlan,
    DeploymentPlan,
    StrategySettings,
)
from orchestrator.learning.deployment.d1 import D1Settings
from orchestrator.learning.deployment.d2 import D2Settings
from orchestrator.learning.deployment.d3 import D3Settings
from orchestrator.learning.strategy_registry import calibrations, deployments
from orchestrator.study.study_plan import ALL, ComparedCalibration, ComparedDeployment, Level, StudyPlan
from sim_engine.liquids import SimulationParameters
from sim_engine.scene import PoseErrorSettings, PoseNoise
from sim_engine.search_space import Space
from sim_engine.settings.model import (
    Example,
    FilePath,
    Name,
    PathOr,
    PositiveCount,
    PositivePourCount,
    PositiveSimulationCount,
    PourCount,
    Problems,
    Seed,
    Settings,
    SimulationCount,
    Text,
    meanings,
)


class StrategyBudget(Settings):
    """A compared strategy: its number of repetitions and its budget."""

    repetitions: Annotated[PositiveCount, Field(le=10_000), Example("10")]
    """Number of runs: each run of a calibration has its own pours, a deployment runs once per receiver."""

    @property
    def complete(self) -> bool:
        """Whether the budget is given; a draft may lack it."""
        return all(self.value(key) is not None for key in self.required_keys() if key != "repetitions")

    def changes(self) -> dict[str, Any]:
        """Settings of the strategy that the file gives."""
        keys = type(self).model_fields.keys() - StrategyBudget.model_fields.keys()
        return {name: value for name in keys if (value := getattr(self, name)) is not None}


def _budget_of(settings: type[StrategySettings], *keys: str, **required: str) -> Any:
    """Make the section of a compared strategy from some of its settings.

    Args:
        keys: names of those that may be left out.
        required: names of the others, with an example.
    """
    fields: Any = {}
    for key in (*required, *keys):
        info, meaning = settings.model_fields[key], meanings(settings)[key]
        value: Any = Annotated[(info.annotation, *info.metadata)] if info.metadata else info.annotation
        if key in required:
            fields[key] = (Annotated[value, Example(required[key])], Field(description=meaning))
        else:
            fields[key] = (value | None, Field(None, description=meaning))
    strategy = settings.model_fields["strategy"].default
    model = create_model(f"{strategy}Budget", __base__=StrategyBudget, __doc__=StrategyBudget.__doc__, **fields)
    model.variant = strategy
    return model


C1Budget: Any = _budget_of(C1Settings, points_per_axis="10")
C2Budget: Any = _budget_of(C2Settings, samples="18")
C3Budget: Any = _budget_of(C3Settings, "initial_samples", "kappa", iterations="59")
C4Budget: Any = _budget_of(C4Settings, "initial_samples", "kappa", simulations="108")
D2Budget: Any = _budget_of(D2Settings, "mean", "initial_samples", "kappa", pours="15")
D3Budget: Any = _budget_of(
    D3Settings, "prior_simulations", "simulations_per_pour", "initial_samples", "kappa", pours="15"
)


class D1Budget(_budget_of(D1Settings, "simulations_per_iteration", "initial_samples", "kappa")):  # type: ignore[misc]
    """A compared strategy: its number of repetitions and its budget."""

    iterations: list[PositiveSimulationCount] = Field(default=[15], min_length=1)
    """Iterations of the optimiser, one campaign for each number: [5, 10, 15]."""


class C4ActiveBudget(_budget_of(C4Settings, "initial_samples", "kappa", simulations="108")):  # type: ignore[misc]
    """C4 with pours that it chooses itself, each by its expected information about the deployments."""

    pours: Annotated[PositivePourCount, Example("6")]
    """Number of training pours to choose; the score uses the repetition's test pours."""

    design_simulations: PositiveSimulationCount = 64
    """Number of simulations for the choice."""

    def changes(self) -> dict[str, Any]:
        """Settings of C4 that the file gives."""
        return {name: value for name, value in super().changes().items() if name in C4Settings.model_fields}


class CalibrationsBase(Settings):
    """The compared calibrations."""

    C1: C1Budget | None = None
    """Uniform grid."""

    C2: C2Budget | None = None
    """Stratified sampling."""

    C3: C3Budget | None = None
    """Bayesian optimisation, each θ on all training pours."""

    C4: C4Budget | None = None
    """Bayesian optimisation, one simulation per iteration; D1 and D3 simulate with the θ that it recommends."""

    C4_paper: C4Budget | None = None
    """C4 as in the paper: the surrogate treats the action's influence as noise. It is compared only; no deployment uses
    it."""

    C4_active: C4ActiveBudget | None = None
    """C4 on fewer pours that are chosen actively. It is compared only; no deployment uses it."""


class DeploymentsBase(Settings):
    """The compared deployments, into each of the base campaign's receivers."""

    D1: D1Budget | None = None
    """Plan in simulation, pour once."""

    D1_uncalibrated: D1Budget | None = None
    """D1 in the simulator with its defaults instead of C4's parameters: the baseline of every deployment."""

    D2: D2Budget | None = None
    """Learn from real pours."""

    D2_paper: D2Budget | None = None
    """D2 as in the paper: a surrogate with a zero mean."""

    D3: D3Budget | None = None
    """Real pours with a simulated prior; the campaign selects the model of the prior."""

    D3_paper: D3Budget | None = None
    """D3 as in the paper: a GP of the residual around the simulations' mean, without a check."""


def _with_others(base: type[Settings], installed: Mapping[str, type[StrategySettings]]) -> Any:
    """Add a key for each strategy of an installed package, with the settings of the strategy."""
    fields: Any = {}
    for name, settings in installed.items():
        if name not in base.model_fields:
            keys = settings.model_fields.keys() - {"strategy"}
            meaning = meanings(settings)["strategy"]
            fields[name] = (_budget_of(settings, *sorted(keys)) | None, Field(None, description=meaning))
    name = base.__name__.replace("Base", "Settings")
    return create_model(name, __base__=base, __doc__=base.__doc__, **fields)


CalibrationsSettings: Any = _with_others(CalibrationsBase, calibrations())
DeploymentsSettings: Any = _with_others(DeploymentsBase, deployments())


class LevelSettings(Settings):
    """Level of mismatch between the bench and the simulator."""

    name: Annotated[Name, Example("moderate")]
    """Name of the level in figures and folders."""

    liquid: Annotated[TrueLiquid, Example("{particles: 4000, cohesion: 0.05 N/m}")]
    """Ground truth: θ of the bench's liquid, which calibration never reads."""

    pose_error: PoseErrorSettings = PoseErrorSettings()
    """Systematic error of grip and placement."""

    pose_noise: PoseNoise = PoseNoise()
    """Scatter of the pose error, drawn for each pour."""


class StudyFile(Settings):
    """A study: repeated and compared calibrations and deployments of a campaign."""

    name: Annotated[Name, Example("paper")]
    """Name of the study; runs are written to study-NAME."""

    seed: Seed = 0
    """Seed of all random choices."""

    campaign: Annotated[FilePath, Example("../campaigns/paper.yaml")]
    """File of the base campaign: vessels, motions, action spaces, ranges of θ, calibration pours, loss."""

    laboratory: PathOr[LaboratorySettings] | None = None
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

    mismatch: list[LevelSettings] | None = None
    """Levels of mismatch between bench and simulator. Unless given, there is one level: the laboratory's bench under
    its own name."""

    compared: Text | None = None
    """Level at which C1 to C4 are compared, or 'all'; unless given, the first level. C4 runs at all levels."""

    random_baseline: SimulationCount = 0
    """Number of random parameters that each calibration is compared with."""

    calibration: CalibrationsSettings | None = None
    """The calibrations."""

    deployment: DeploymentsSettings | None = None
    """The deployments."""

    confirm: PourCount = 0
    """Number of repetitions of each deployment's recommended action at its end, on the same bench with new random
    errors. The number can be raised later, like the repetitions."""

    directory: FilePath | None = None
    """Directory for the study's folder; unless given, 'runs' in the working directory."""

    def check_values(self, problems: Problems) -> None:
        """See `Settings`."""
        names = [level.name for level in self.mismatch or ()]
        if self.mismatch == []:
            problems.add("is empty; name at least one level, or remove the key", "mismatch")
        for i, name in enumerate(names):
            if name is not None and name in names[:i]:
                problems.add(f"a level '{name}' stands above already", "mismatch", i)
        if not problems.valid("calibration", "deployment"):
            return
        if self.calibration is None and self.deployment is None:
            problems.add("there is nothing to compare; add a 'calibration' or a 'deployment' section", key=True)
        if self.confirm and self.deployment is None:
            problems.add("there is no deployment to confirm; add a 'deployment' section, or remove it", "confirm")


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
    bench = _bench(base.laboratory, at, report)
    if bench is None:
        return None
    levels = _levels(file.mismatch, base.laboratory.name, bench)
    names = tuple(level.name for level in levels)
    compared = file.compared or (names[0] if names else "")
    if names and compared not in (*names, ALL):
        report.add(root.at("compared"), f"no such level; there are {', '.join(names)}, and all")
    plan = replace(
        calibration,
        parameters=searched,
        parameter_prior=tuple(prior for prior in calibration.parameter_prior if prior.name in searched.names),
        pour_count=0,
        holdout=0,
        random_baseline=file.random_baseline,
        fixed_parameters=base.parameters.fixed_values(searched.names),
    )
    strategies = _compared_calibrations(file.calibration, plan, count - holdout, names, compared, root, report)
    poured = _compared_deployments(file.deployment, base.deployment, strategies, root, report)
    if not strategies and not poured and not report.problems:
        empty = next(key for key in ("calibration", "deployment") if file.value(key) is not None)
        examples = {
            "calibration": "C4: {repetitions: 10, simulations: 108}",
            "deployment": "D2: {repetitions: 10, pours: 15}",
        }
        report.add(root.at(empty), f"there is nothing to compare; name a strategy, for example '{examples[empty]}'")
    if report.problems:
        return None
    return StudyPlan(
        name=file.name,
        seed=file.seed,
        source=root.document.path,
        base=replace(base, name=file.name, seed=file.seed, calibration=plan, deployment=None),
        levels=levels,
        calibrations=strategies,
        deployments=poured,
        pour_count=count,
        holdout=holdout,
        compared=compared,
        confirm=file.confirm,
        directory=resolved(Path("runs") if file.directory is None else root.directory / file.directory),
    )


def _base(file: StudyFile, root: Place, report: Report) -> CampaignPlan | None:
    references, laboratory = References(report), None
    if file.laboratory is not None:
        laboratory = references.laboratory(file.laboratory, root.at("laboratory"))
    if not file.campaign:  # missing in a draft
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
    if base.memory is not None:
        report.add(root.at("campaign"), "has a 'prior', and the cells of a study begin without one; remove it there")
    if laboratory is not None:
        section = references.section(file.laboratory, root.at("laboratory"), LaboratorySettings)
        record = {} if section is None else as_file(*section, references)
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
    values = {**base.calibration.fixed_parameters, **fixed}
    calibration = replace(
        base.calibration,
        parameters=Space(tuple(axes.values())),
        parameter_prior=(
            *(prior for prior in base.calibration.parameter_prior if prior.name not in (*fixed, *searched)),
            *changes.priors(),
        ),
        fixed_parameters={name: value for name, value in values.items() if name not in axes},
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
    names = list(dict.fromkeys(name for name in file.search if name in axes))
    if not names:
        if not file.search:
            report.add(root.at("search"), "is empty; name parameters, or remove the key")
        return base.calibration.parameters
    return Space(tuple(axes[name] for name in names))


HARDWARE = (
    "laboratory '{}' is hardware. An arm moves only for one run, after '--enable-motion' and with a person next to it; "
    "the cells of a study run in processes of their own, which ask no operator. Pour there with 'decant run', and "
    "name a virtual laboratory here"
)

BUDGETS = (
    *("grid", "points_per_axis", "samples", "simulations"),
    *("pours", "iterations", "simulations_per_iteration", "prior_simulations", "simulations_per_pour", "mean"),
    *("risk_limit", "stop", "good_enough"),
)
"""Settings that a strategy does not take from the base campaign, because the study defines each budget."""

AS_IN_THE_PAPER: dict[str, dict[str, Any]] = {
    "D2_paper": {"mean": "zero"},
    "D3_paper": {"model": "residual"},
}
"""Settings in which the paper's forms differ from the defaults."""

UNCALIBRATED_KEY = "D1_uncalibrated"
"""Deployment that no calibration precedes."""


def _bench(laboratory: LaboratorySettings, at: Place, report: Report) -> BenchSettings | None:
    """The bench of a study. Without a usable one, the reason is added to the report and the result is None."""
    if laboratory.mode != "virtual":
        report.add(at, HARDWARE.format(laboratory.name))
    elif laboratory.arm is not None and laboratory.operator.answers != "virtual":
        report.add(
            at,
            f"laboratory '{laboratory.name}' asks an operator, and a study asks none; set 'operator: {{answers: "
            "virtual}' in it",
        )
    elif laboratory.bench is None:
        report.add(
            at,
            f"laboratory '{laboratory.name}' has no virtual bench to pour on; name one that has, for example "
            "../laboratories/twin.yaml",
        )
    else:
        # Simulated readings need no waiting; an arm over wires needs its real time.
        wired = laboratory.arm is not None
        return laboratory.bench if wired else laboratory.bench.with_values(time_scale=0.0)
    return None


def _levels(written: Iterable[LevelSettings] | None, laboratory: str, bench: BenchSettings) -> tuple[Level, ...]:
    """The benches of all levels: as given, or the laboratory's own under its name. Incomplete levels are left out."""
    if written is None:
        return (Level(laboratory, bench),)
    return tuple(
        Level(
            level.name,
            bench.with_values(liquid=level.liquid, pose_error=level.pose_error, pose_noise=level.pose_noise),
        )
        for level in written
        if level.name is not None and level.liquid is not None
    )


def _compared_calibrations(
    section: Settings | None,
    base: CalibrationPlan,
    train: int,
    levels: tuple[str, ...],
    compared: str,
    root: Place,
    report: Report,
) -> tuple[ComparedCalibration, ...]:
    """The calibrations of a study; problems are added to the report.

    Args:
        base: plan with space and scene; pours and budget are filled in here and later.
        train: number of pours on which every θ of C1 to C3 is simulated.
        levels: names of all levels; C4 runs at all of them, the others at `compared`.
    """
    strategies = []
    for key, strategy in _strategies_in(section):
        at, kind = root.at("calibration", key), calibrations()[strategy.variant]
        if not strategy.complete:
            continue
        changes = strategy.changes()
        if "averaging" in kind.model_fields:
            shared = getattr(base.settings, "averaging", "context")
            changes["averaging"] = "noise" if key == "C4_paper" else shared
        settings = kind.like(base.settings, without=BUDGETS, **changes)
        budget = next((name for name in ("iterations", "simulations") if getattr(settings, name, None)), "")
        initial, most = getattr(settings, "initial_samples", None), getattr(settings, budget, None)
        if initial is not None and most is not None and initial > most:
            if "initial_samples" in changes:
                report.add(at.at("initial_samples"), f"{initial} random θ don't fit into {budget}: {most}")
            settings = settings.with_values(initial_samples=most)
        settled = settings.settled(base.parameters.names, train, PlacedProblems(at, report))
        if settled is None:
            continue
        prior, parameter_prior = (base.prior, base.parameter_prior) if kind.has_prior else ((), ())
        plan = replace(base, settings=settled, prior=prior, parameter_prior=parameter_prior)
        count = getattr(strategy, "pours", 0)  # only a strategy that chooses its pours has the key
        if count:
            plan = replace(plan, design="active", design_simulations=strategy.design_simulations)
        where = levels if key == "C4" or compared == ALL else (compared,)
        strategies.append(ComparedCalibration(_label(key), plan, strategy.repetitions or 1, where, count))
    return tuple(strategies)


def _compared_deployments(
    section: Settings | None,
    base: DeploymentPlan | None,
    calibrated: tuple[ComparedCalibration, ...],
    root: Place,
    report: Report,
) -> tuple[ComparedDeployment, ...]:
    """The deployments of a study; problems are added to the report."""
    if section is None:
        return ()
    if base is None:
        report.add(root.at("deployment"), "the base campaign has no 'deployment' section to take receivers from")
        return ()
    most = max((strategy.repetitions for strategy in calibrated if strategy.label == "C4"), default=0)
    strategies: list[ComparedDeployment] = []
    for key, strategy in _strategies_in(section):
        at, kind = root.at("deployment", key), deployments()[strategy.variant]
        if key == "D2_paper" and strategy.mean == "constant":
            report.add(at.at("mean"), "D2_paper has the paper's mean, 'zero'; remove the key, or compare with D2")
        repetitions = strategy.repetitions or 1
        after_calibration = key != UNCALIBRATED_KEY
        if kind.simulates and after_calibration and repetitions > most:
            report.add(
                at.at("repetitions") if strategy.repetitions is not None else at,
                f"{strategy.variant} simulates with the θ* that C4 finds in the same repetition, and C4 has {most}; "
                f"add 'calibration: {{C4: {{repetitions: {repetitions}, simulations: 108}}}}'",
            )
        if not strategy.complete:
            continue
        changes = strategy.changes() | AS_IN_THE_PAPER.get(key, {})
        rounds = changes.pop("iterations", None)
        if not after_calibration and len(rounds) > 1:
            report.add(at.at("iterations"), f"{len(rounds)} numbers, but the baseline is one plan; give one: [15]")
        settings = kind.like(base.settings, without=BUDGETS, **changes)
        settings.check(PlacedProblems(at, report))
        common = replace(base, settings=settings, data=None, confirm=0)  # a study has its own 'confirm'
        if rounds is None:
            strategies.append(ComparedDeployment(_label(key), common, repetitions))
        for n in sorted(set(rounds or ())):
            plan = common.with_settings(iterations=n)
            label = f"{key}-{n}" if after_calibration else _label(key)
            strategies.append(ComparedDeployment(label, plan, repetitions, after_calibration))
    return tuple(strategies)


def _strategies_in(section: Settings | None) -> list[tuple[str, Any]]:
    """The strategies that a file has, by their keys."""
    keys = () if section is None else type(section).model_fields
    return [(key, strategy) for key in keys if (strategy := getattr(section, key)) is not None]


def _label(key: str) -> str:
    """Name of a strategy in figures and folders."""
    return key.replace("_", "-")
