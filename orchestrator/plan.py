"""A campaign with everything resolved: scenes, spaces, budgets, seeds as plain values. What the YAML means."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from actors.optimizer.core.problem import Linear
from actors.spec import LaboratorySpec
from orchestrator.strategies.deployment.objectives import Objectives
from sim_engine.action import Action
from sim_engine.liquid import SimulationParameters
from sim_engine.losses import MINIMUM_POURED, Loss
from sim_engine.space import Space
from sim_engine.task import PoseError, Scene

CalibrationName = Literal["C1", "C2", "C3", "C4"]
DeploymentName = Literal["D1", "D2", "D3"]
ModelName = Literal["residual", "pooled", "scaled"]
PolicyName = Literal["ask", "D2", "widen"]
RefusalsName = Literal["avoid", "penalise"]
AveragingName = Literal["context", "noise"]


@dataclass(frozen=True)
class RecordedPour:
    """One weighed pour read from a file.

    Attributes:
        poured, spilled, retained: masses [kg].
        split: 'train', 'test' or 'transfer'.
    """

    action: Action
    poured: float
    spilled: float
    retained: float
    split: str

    @property
    def poured_fraction(self) -> float:
        """Poured over loaded."""
        return self.poured / (self.poured + self.retained)

    @property
    def normalised_spillage(self) -> float | None:
        """r = spilled / poured, None where too little was poured for it."""
        return None if self.poured_fraction < MINIMUM_POURED else self.spilled / self.poured


@dataclass(frozen=True)
class RecordSet:
    """Weighed pours in one scene.

    Attributes:
        path: the CSV file, or the journal of the run that made them.
        lip_radius: what turned the file's lip_to_receiver_axis_mm into x_offset [m]; None if it has x_offset_mm.
        columns: columns that have another name in the file, {name that Decant knows: name in the file}.
    """

    scene: Scene
    pours: tuple[RecordedPour, ...]
    path: Path
    lip_radius: float | None = None
    columns: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class ExistingPours:
    """Pours weighed before the campaign, from which deployment learns as from its own.

    Attributes:
        pours: by the name of the scene they were made in; all inside the action space.
        path: the CSV file, or the journal of the run that made them.
        counts: whether they count against the budget of pours.
        left_out: why others of the file or run were not used, one text each.
        lip_radius, columns: as in `RecordSet`.
    """

    pours: dict[str, tuple[RecordedPour, ...]]
    path: Path
    counts: bool = False
    left_out: tuple[str, ...] = ()
    lip_radius: float | None = None
    columns: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class NormalPrior:
    """The prior g along one dimension of an action: normal, cut off at the ends of its range.

    Attributes:
        name: of the dimension.
        mean, deviation: of the normal before it is cut off, in the dimension's SI unit.
    """

    name: str
    mean: float
    deviation: float


@dataclass(frozen=True)
class CalibrationPlan:
    """C1, C2, C3 or C4: which θ_s reproduces the weighed spills.

    Attributes:
        actions: space in which calibration pours are designed and the prior g draws.
        parameters: searched θ_s.
        fixed_parameters: θ_s values that are not searched.
        pour_count: pours to be made on the bench (0 with `records`).
        holdout: how many of them are kept for testing.
        records: weighed pours to calibrate on in place of new ones (split 'train' and 'test').
        transfer: weighed pours in another scene, scored only.
        simulations: budget of the strategy: single simulated pours, whichever it is.
        random_baseline: how many random θ are scored for comparison.
        initial: C3, C4: random θ before the surrogate takes over.
        kappa: C3, C4: κ of the lower confidence bound.
        grid: C1: values tried of every searched θ_s, by name.
        thetas: C2, C3: how many θ are tried, each on all training pours.
        constraints: on actions, beside the bounds of their space.
        prior: C4: dimensions along which g is not uniform.
        averaging: C4: whether the surrogate knows the action that was simulated ('context'), or takes its influence for
            noise ('noise', the paper's).
    """

    strategy: CalibrationName
    scene: Scene
    actions: Space
    parameters: Space
    fixed_parameters: dict[str, float]
    pour_count: int
    holdout: int
    records: RecordSet | None
    transfer: RecordSet | None
    simulations: int
    random_baseline: int = 0
    initial: int = 8
    kappa: float = 2.0
    grid: dict[str, int] = field(default_factory=dict)
    thetas: int = 0
    constraints: tuple[Linear, ...] = ()
    prior: tuple[NormalPrior, ...] = ()
    averaging: AveragingName = "context"


@dataclass(frozen=True)
class TrustPlan:
    """D3: what the first pours may tell about the simulator.

    Attributes:
        pours: that are compared with what simulations say of them.
        limit: mean of max(z, 0) above which the simulator is called wrong.
        policy: what follows. 'D2': its simulations are forgotten; 'widen': they are believed less; 'ask'.
    """

    pours: int = 4
    limit: float = 2.5
    policy: PolicyName = "D2"


@dataclass(frozen=True)
class RiskPlan:
    """D1: what is minimised where actions are not executed exactly, and θ is not known exactly.

    Attributes:
        measure: of the losses: their mean, or CVaR, the mean of the worst share 1 − level.
        level: β of CVaR.
        pose_error: standard deviations, normal and independent of each other; 0 for what is exact.
        theta: 'best': θ* alone; 'posterior': draws of what else fits the weighed pours.
        thetas: those draws, equally likely, where no calibration of the same campaign makes them.
    """

    measure: Literal["expected", "cvar"] = "expected"
    level: float = 0.9
    pose_error: PoseError = field(default_factory=lambda: PoseError(speed_factor=0.0))
    theta: Literal["best", "posterior"] = "best"
    thetas: tuple[SimulationParameters, ...] = ()

    @property
    def tail(self) -> float:
        """β, and 0 for the mean, which is CVaR at level 0."""
        return self.level if self.measure == "cvar" else 0.0


@dataclass(frozen=True)
class PricesPlan:
    """D3 with `per_pour` None: what things cost, by which simulations are chosen and ended.

    Attributes:
        pour: wall time of a pour, refilling and wiping included [s].
        simulation: CPU time of a simulation until outcomes tell [s].
        worth: share of the worst loss; where all simulations that fit beside a pour promise less, the pool rests.
    """

    pour: float = 90.0
    simulation: float = 2.0
    worth: float = 0.005


@dataclass(frozen=True)
class DeploymentPlan:
    """D1, D2 or D3: how to pour into vessels that calibration never saw.

    Attributes:
        scenes: one per receiver.
        actions: searched action space.
        iterations: D1: iterations of the optimiser in simulation.
        simulations_per_iteration: D1: m1.
        prior_simulations: D3: m2.
        pours: real pours per scene (D1: 1).
        per_pour: simulations told to the strategy between two pours (D3); None: as many as the wall clock allows.
        mean: prior mean of D2's surrogate: 'constant' or 'zero' (the paper's).
        kappa: κ of the lower confidence bound.
        initial: actions drawn evenly before the surrogate takes over.
        on_failed_pour: how a failed pour enters the data.
        data: D2, D3: pours of before the campaign.
        objectives: what is minimised in place of the loss.
        model: D3: how simulations enter the surrogate: 'residual' is the paper's; see docs/optimiser.md.
        trust: D3: when the simulator is called wrong, and what follows; None: pours are only compared.
        noise: of observations: the same everywhere, or varying with the action where the data show it.
        refusals: what an action that can't be made is to the optimiser: a place to avoid, or one with the worst cost.
        risk: D1: in place of the mean loss of exact execution.
        tolerance: D1: loss up to which one may miss the action, as a share of that of spilling all; None: no safe
            window is looked for.
        prices: D3 with `per_pour` None: simulations by what they are worth; None: as they come, as in older runs.
        constraints: on actions, beside the bounds of their space.
        plain: D3 'residual': the simulations before the first pour are chosen as in the paper, with a constant κ; in
            older runs they were not.
    """

    strategy: DeploymentName
    scenes: tuple[Scene, ...]
    actions: Space
    loss: Loss
    pours: int
    iterations: int = 15
    simulations_per_iteration: int = 2
    prior_simulations: int = 37
    per_pour: int | None = 0
    mean: Literal["constant", "zero"] = "constant"
    kappa: float = 2.0
    initial: int = 3
    on_failed_pour: Literal["penalise", "ignore"] = "penalise"
    data: ExistingPours | None = None
    objectives: Objectives | None = None
    model: ModelName = "residual"
    trust: TrustPlan | None = None
    noise: Literal["constant", "varying"] = "constant"
    refusals: RefusalsName = "penalise"
    risk: RiskPlan | None = None
    tolerance: float | None = None
    prices: PricesPlan | None = None
    constraints: tuple[Linear, ...] = ()
    plain: bool = False

    @property
    def loss_name(self) -> str:
        """What results call that which is minimised."""
        return self.loss.name if self.objectives is None else "objectives"


@dataclass(frozen=True)
class OutputPlan:
    """What is written beside the journal.

    Attributes:
        directory: in which each run gets a folder.
        rrd, figures: whether the recording, the figures are made.
        record_rate: frames of a recorded simulation per simulated second [1/s]; 0 records none.
        recorded_simulations: how many of a stage keep their frames.
    """

    directory: Path
    rrd: bool = True
    figures: bool = True
    record_rate: float = 10.0
    recorded_simulations: int = 6


@dataclass(frozen=True)
class CampaignPlan:
    """A whole campaign.

    Attributes:
        source: the YAML file.
        laboratory_source: the file that describes the laboratory; None where that is the campaign's own.
        parameters: θ_s in force where nothing is calibrated.
        parallel_simulations: logical slots of the simulation lane; part of the plan (not of the machine), so that the
            same seed asks for the same things anywhere.
        on_unknown: what happens on resume to a pour that had started and has no outcome.
        resolved: the YAML with everything filled in, JSON-ready, as kept with the run.
    """

    name: str
    seed: int
    source: Path
    laboratory: LaboratorySpec
    parameters: SimulationParameters
    calibration: CalibrationPlan | None
    deployment: DeploymentPlan | None
    outputs: OutputPlan
    parallel_simulations: int = 2
    on_unknown: Literal["ask", "repeat"] = "ask"
    resolved: dict[str, Any] = field(default_factory=dict)
    laboratory_source: Path | None = field(default=None, compare=False)
