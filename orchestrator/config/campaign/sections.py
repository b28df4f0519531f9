"""Campaigns as written in files: the sections, their keys and what they mean. `resolve` makes plans of them."""

from __future__ import annotations

from typing import Annotated, Any, ClassVar, Literal

from pydantic import Field

from orchestrator.config.laboratory.sections import LaboratoryFile, PoseNoiseSection
from orchestrator.config.motion import Actions as ActionsModel
from orchestrator.config.motion import Motion as MotionModel
from orchestrator.config.motion import Parameters as ParametersModel
from orchestrator.config.vessel import LiquidFile, VesselFile
from orchestrator.config.yaml.quantities import Quantity
from orchestrator.config.yaml.sections import Count, CountOrFree, Name, PathOr, PositiveCount, Section, Switch, Text
from orchestrator.strategies.deployment.objectives import ObjectiveName
from sim_engine.losses import LossName

# Built at import from the declarations in sim_engine; a type checker sees them as Any.
Actions: Any = ActionsModel
Motion: Any = MotionModel
Parameters: Any = ParametersModel

Kappa = Annotated[float, Quantity("1", "2.0", 0.0, 100.0)]


class TransferSection(Section):
    """Weighed pours in another scene, for scoring what was calibrated; never fitted."""

    required: ClassVar[dict[str, str]] = {"from": "transfer.csv", "receiver": "cone.yaml"}

    source: Text | None = Field(default=None, alias="from")
    """CSV file."""

    receiver: PathOr[VesselFile] | None = None
    """Its receiver."""

    motion: Motion | None = None
    """What its motion has otherwise than calibration's."""


class PoursSection(Section):
    """Pours to calibrate on: to be made (`count`), or weighed already (`from`, `from_run`)."""

    count: PositiveCount | None = None
    """Pours to make on the bench."""

    holdout: Count | None = None
    """How many of them are kept for testing; an eighth unless given."""

    source: Text | None = Field(default=None, alias="from")
    """CSV file of weighed pours; its column `split` says which are kept for testing."""

    from_run: Text | None = None
    """Folder of a former run: its weighed pours in the same scene, with the splits that they had there."""

    lip_radius: Annotated[float, Quantity("m", "40 mm", 0.0, 0.5)] | None = None
    """The pourer's inner radius at the lip, where the CSV has lip_to_receiver_axis_mm in place of x_offset_mm."""

    columns: dict[Text, Text] = Field(default_factory=dict)
    """Columns that have another name in the CSV: {name that Decant knows: name in the file}."""

    transfer: TransferSection | None = None
    """Weighed pours in another scene, scored only."""


class CalibrationSection(Section):
    """Which parameters of the simulator reproduce the weighed spills."""

    required: ClassVar[dict[str, str]] = {"pours": "{count: 32, holdout: 4}"}

    strategy: Literal["C1", "C2", "C3", "C4"] = "C4"
    """C1: uniform grid; C2: stratified sampling; C3: Bayesian optimisation, each θ on all training pours; C4: Bayesian
    optimisation of the mean discrepancy over the actions, one simulation an iteration."""

    pourer: PathOr[VesselFile] | None = None
    """The campaign's unless given."""

    receiver: PathOr[VesselFile] | None = None
    """The campaign's unless given."""

    motion: Motion | None = None
    """What has other values than in the campaign's `motion`."""

    actions: Actions | None = None
    """Searched dimensions; the campaign's `actions` unless given."""

    pours: PoursSection | None = None
    """Pours to calibrate on."""

    simulations: PositiveCount | None = None
    """Budget of single simulated pours; C1 to C3 have it as a limit, or as all that says how many θ they try."""

    grid: dict[Text, PositiveCount] | None = None
    """C1: values of every searched parameter: {particles: 5, cohesion: 6}."""

    per_axis: PositiveCount | None = None
    """C1: as many values of each, in place of 'grid'."""

    samples: PositiveCount | None = None
    """C2: θ in all, in equal strata where the number fits, else a Latin hypercube."""

    iterations: PositiveCount | None = None
    """C3: θ in all, each simulated on all training pours."""

    initial: PositiveCount = 8
    """C3, C4: random parameters before the surrogate takes over."""

    kappa: Kappa = 2.0
    """C3, C4: κ of the lower confidence bound."""

    averaging: Literal["context", "noise"] = "context"
    """C4: context: the surrogate knows which action was simulated; noise, the paper's: its influence is noise."""

    random_baseline: Count = 0
    """Random parameters that are scored for comparison."""


class DataSection(Section):
    """Pours of before the campaign that deployment learns from: in a CSV file, or made by a former run."""

    source: Text | None = Field(default=None, alias="from")
    """CSV file of weighed pours, with the columns of calibration's `pours`; `split` may be left out."""

    run: Text | None = None
    """Folder of a former run: its weighed pours in the same scenes, whatever they were made for."""

    receiver: Text | None = None
    """Name of the receiver that the CSV file is about, where there are several."""

    counts: Switch = False
    """Whether these pours count against the budget."""

    lip_radius: Annotated[float, Quantity("m", "40 mm", 0.0, 0.5)] | None = None
    """The pourer's inner radius at the lip, where the CSV has lip_to_receiver_axis_mm in place of x_offset_mm."""

    columns: dict[Text, Text] = Field(default_factory=dict)
    """Columns that have another name in the CSV: {name that Decant knows: name in the file}."""


class LossSection(Section):
    """What deployment minimises."""

    name: LossName = "spilled_and_retained"
    """(spilled + w·retained) / loaded; or the paper's: normalised, grams, particles."""

    retained_weight: Annotated[float, Quantity("1", "1.0", 0.0, 100.0)] | None = None
    """w; 1 unless given."""


class ObjectiveSection(Section):
    """One of several things wanted of a pour."""

    required: ClassVar[dict[str, str]] = {"name": "spillage"}

    name: ObjectiveName | None = None
    """spillage and retained: shares of the load; time: duration of the motion; target_volume: pour so much and stop."""

    weight: Annotated[float, Quantity("1", "1.0", 1e-6, 1e6)] = 1.0
    """In the weighted sum."""

    scale: Annotated[float, Quantity("s", "10 s", 0.01, 3600.0)] | None = None
    """Of time: a duration that is as bad as spilling everything; 10 s unless given."""

    volume: Annotated[float, Quantity("m^3", "150 mL", 1e-7, 0.1)] | None = None
    """Of target_volume: what should be poured."""

    tolerance: Annotated[float, Quantity("m^3", "2 mL", 0.0, 0.1)] | None = None
    """Of target_volume: by how much it may be missed; nothing unless given."""


class TrustSection(Section):
    """D3: when the first pours say that the simulator is wrong, and what follows."""

    pours: Annotated[int, Field(strict=True, ge=3, le=10)] = 4
    """Weighed pours that are compared with the simulations, from the third on."""

    limit: Annotated[float, Quantity("1", "2.5", 0.5, 100.0)] = 2.5
    """Mean of max(z, 0) above which the simulator is called wrong."""

    policy: Literal["ask", "D2", "widen"] = "D2"
    """D2: its simulations are forgotten; widen: they are believed less; ask: the campaign pauses with a question."""


class RiskSection(Section):
    """D1: plan for a robot that misses, and for not knowing θ, in place of one pour that goes exactly as planned."""

    measure: Literal["expected", "cvar"] = "expected"
    """expected: mean loss over the errors; cvar: mean over the worst share 1 − level of them."""

    level: Annotated[float, Quantity("1", "0.9", 0.01, 0.99)] | None = None
    """cvar: between 0, the mean of all, and 1, the very worst; 0.9 unless given."""

    pose_error: PoseNoiseSection = PoseNoiseSection()
    """Standard deviations of the errors, normal and independent."""

    theta: Literal["best", "posterior"] = "best"
    """best: θ* alone; posterior: draws of what else fits the weighed pours, from C4 or from `--parameters`."""


class WindowSection(Section):
    """D1: how far one may miss the planned action, in each dimension, before too much is spilled."""

    required: ClassVar[dict[str, str]] = {"tolerance": "2 %"}

    tolerance: Annotated[float, Quantity("1", "2 %", 1e-4, 1.0)] | None = None
    """Largest loss, as a share of what spilling the whole load would cost."""


class PricesSection(Section):
    """D3 with `per_pour: free`: what things cost, by which simulations are chosen and ended."""

    pour: Annotated[float, Quantity("s", "90 s", 0.0, 86400.0, positive=True)] = 90.0
    """Time that a pour takes, refilling and wiping included."""

    simulation: Annotated[float, Quantity("s", "2 s", 0.0, 3600.0, positive=True)] = 2.0
    """CPU time of a simulation, until their outcomes tell."""

    worth: Annotated[float, Quantity("1", "0.005", 0.0, 1.0)] = 0.005
    """Share of the worst loss: where all simulations that fit beside a pour promise less together, the pool rests."""


class DeploymentSection(Section):
    """How to pour into vessels that calibration never saw."""

    required: ClassVar[dict[str, str]] = {"strategy": "D3"}

    strategy: Literal["D1", "D2", "D3"] | None = None
    """D1: plan in simulation; D2: learn on real pours; D3: real pours with a simulated prior."""

    pourer: PathOr[VesselFile] | None = None
    """The campaign's unless given."""

    receiver: PathOr[VesselFile] | None = None
    """The campaign's unless given."""

    receivers: list[PathOr[VesselFile]] | None = None
    """Several receivers, one after the other."""

    motion: Motion | None = None
    """What has other values than in the campaign's `motion`."""

    actions: Actions | None = None
    """Searched dimensions; the campaign's `actions` unless given."""

    loss: LossSection = LossSection()
    """What is minimised."""

    objectives: list[ObjectiveSection] | None = None
    """Several things wanted at once, in place of a loss."""

    pareto: Switch | None = None
    """Look for all compromises between the objectives that nothing beats; the weights then choose one of them."""

    floor: Annotated[float, Quantity("1", "0.5", 0.01, 1.0)] | None = None
    """Share of the load (of the target volume) that a pour must deliver to be better than none; 0.5 unless given."""

    pours: Count | None = None
    """Real pours per receiver; D1: 1 unless given, 0 only plans."""

    iterations: PositiveCount | None = None
    """D1: iterations of the optimiser; 15 unless given, 30 with 'risk'."""

    simulations_per_iteration: PositiveCount | None = None
    """D1: simulations averaged in each, under 'risk' one as planned and the others under errors; 2 unless given."""

    prior_simulations: Count | None = None
    """D3: simulations before the first pour, 37 unless given; with 'per_pour: free' at most so many."""

    per_pour: CountOrFree | None = None
    """D3: simulations told between two pours, 2 unless given; 'free': for as long as they are worth it."""

    prices: PricesSection | None = None
    """D3 with 'per_pour: free': what a pour and a simulation cost."""

    mean: Literal["constant", "zero"] | None = None
    """D2: prior mean of the surrogate; the paper's is 'zero'."""

    model: Literal["residual", "pooled", "scaled"] | None = None
    """D3: how simulations enter the surrogate of pours, 'scaled' unless given; 'residual' is the paper's."""

    trust: TrustSection | None = None
    """D3: when the first pours say that the simulator is wrong, and what follows."""

    noise: Literal["constant", "varying"] = "constant"
    """Scatter of a pour: the same everywhere, or varying with the action where at least 20 observations show it."""

    risk: RiskSection | None = None
    """D1: errors of execution, and of θ, that the action has to bear."""

    window: WindowSection | None = None
    """D1: look for the safe window around the action, and check it by simulations."""

    kappa: Kappa = 2.0
    """κ of the lower confidence bound."""

    initial: PositiveCount = 3
    """Random actions before the surrogate takes over."""

    on_failed_pour: Literal["penalise", "ignore"] = "penalise"
    """How a failed pour enters the data."""

    data: DataSection | None = None
    """D2, D3: pours of before the campaign."""


class SimulatorSection(Section):
    """The simulator."""

    parameters: Parameters | None = None
    """Parameters θ: a value fixes one, a range has it searched by calibration; the others have their defaults."""


class OutputsSection(Section):
    """What is written beside the journal."""

    directory: Text | None = None
    """Where runs go; 'runs' in the working directory unless given."""

    rrd: Switch = True
    """Write a recording for the viewer."""

    figures: Switch = True
    """Write figures at the end."""

    record_rate: Annotated[float, Quantity("1/s", "10 1/s", 0.0, 10.0)] = 10.0
    """Frames of particles per simulated second."""

    recorded_simulations: Count = 6
    """How many simulations are recorded with their particles."""


class CampaignFile(Section):
    """A campaign: calibrate the simulator, deploy what was learnt, or both."""

    required: ClassVar[dict[str, str]] = {
        "name": "narrow-cup",
        "laboratory": "../laboratories/virtual.yaml",
        "liquid": "{name: water, mass: 200 g}",
    }

    name: Name | None = None
    """Its name in run directories and figures."""

    seed: Count = 0
    """Of every random choice: same campaign, seed and outcomes → same requests."""

    laboratory: PathOr[LaboratoryFile] | None = None
    """Where it runs."""

    liquid: PathOr[LiquidFile] | None = None
    """What is poured."""

    pourer: PathOr[VesselFile] | None = None
    """The vessel in the robot's hand."""

    receiver: PathOr[VesselFile] | None = None
    """The vessel on the table."""

    receivers: list[PathOr[VesselFile]] | None = None
    """Several receivers for deployment, one after the other."""

    motion: Motion | None = None
    """Values of the motion that are not searched, for all sections."""

    actions: Actions | None = None
    """Searched dimensions, for sections that name none of their own."""

    simulator: SimulatorSection = SimulatorSection()
    """The simulator."""

    calibration: CalibrationSection | None = None
    """Which parameters of the simulator reproduce the weighed spills."""

    deployment: DeploymentSection | None = None
    """How to pour into vessels that calibration never saw."""

    on_unknown: Literal["ask", "repeat"] = "ask"
    """What happens on resume to a pour that had started and has no outcome; 'repeat' on a virtual bench only."""

    parallel_simulations: Annotated[PositiveCount, Field(le=256)] = 2
    """Logical slots of the simulation lane, whatever the machine: the same seed asks for the same things anywhere."""

    outputs: OutputsSection = OutputsSection()
    """What is written beside the journal."""
