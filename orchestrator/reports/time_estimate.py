"""Estimate of a campaign's remaining time.

`work_of` derives the expected work of each stage (`WorkEstimate`) from the plan. `Forecast` reads the `RunState`, and
combines this work with measured durations.

- Pours and simulations are estimated separately. Before the first measurement, a pour takes the planned times of
  operator and motion, and a simulation a time proportional to its particles.
- A stage's own durations have more weight than those of other stages.
- Simulations during a pour take no extra time unless they take longer than the pour. The same holds for speculative
  simulations while a stage of pours keeps the arm busy.

The estimate is for display only; no decision depends on it.

Limitations: the operator's speed is unknown before the first pour; the load by other programs is assumed to be
constant.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from statistics import fmean, median_low

from actors.laboratory_settings import LaboratorySettings
from orchestrator.learning.calibration.calibration_scores import DRAWS
from orchestrator.learning.campaign_plan import CalibrationPlan, CampaignPlan, DeploymentPlan
from orchestrator.learning.requests import Failed, Pour, Simulate, Simulated
from orchestrator.learning.strategy import Progress
from orchestrator.records.events import Event, RequestFinished, RequestStarted, StageClosed, StageOpened
from orchestrator.records.run_record import NOT_REPORTED, RecordedStage, RunState
from orchestrator.runs.stages import CALIBRATION, CONFIRMATION, DEPLOYMENT, DOSES, EVALUATION, POURS
from sim_engine.action import ACTION_DIMENSIONS
from sim_engine.scene import Scene
from sim_engine.search_space import Space

PRICE = 1e-3
"""Assumed time of a simulated pour on one core, per particle, before the first measurement [s]."""

THOUGHT = 0.2
"""Time between two pours in addition to the pours: a query to the optimiser, the journal [s]."""

ENOUGH = 4
"""Number of simulations, or pours, after which a stage's own durations are used.

The expected duration keeps the weight of this number of simulations, or of one pour.
"""

RECENT = 5
"""Number of recent pours that predict the next ones: operators get faster, and other programs start and stop."""


@dataclass(frozen=True)
class WorkEstimate:
    """Expected work of a stage, before the strategy reports its own progress.

    Attributes:
        simulations, pours: total numbers.
        beside: number of the simulations that run during each pour.
        particles: mean number of particles of a simulation; 0: those of θ*.
        pour_time: planned duration of one pour [s of wall time].
        ahead: number of the simulations that run during pours of an earlier stage, if the simulators are free then.
    """

    simulations: int = 0
    pours: int = 0
    beside: int = 0
    particles: float = 0.0
    pour_time: float = 0.0
    ahead: int = 0


@dataclass
class _Stage:
    """Measurements of a stage. Times in seconds of wall time.

    Attributes:
        waits: times between consecutive finished simulations while no pour has been made; the first counts from the
            opening of the stage.
        particles: particles of these simulations.
        made_before: number of simulations whose outcomes existed when they were requested.
        answered: when the last simulation finished.
        cycles: times from the end of the previous pour to the end of each pour; the first counts from its beginning.
    """

    work: WorkEstimate
    recorded: RecordedStage
    waits: list[float] = field(default_factory=list)
    particles: list[int] = field(default_factory=list)
    made_before: int = 0
    answered: float = 0.0
    cycles: list[float] = field(default_factory=list)
    cycle_from: float | None = None

    @property
    def progress(self) -> Progress:
        """Last reported by the strategy; the expected work before."""
        known = self.recorded.progress
        return Progress(0, self.work.simulations, 0, self.work.pours) if known is NOT_REPORTED else known

    @property
    def simulations_alone(self) -> int:
        """Simulations to wait for before the next pour, or in a stage without pours."""
        if self.cycle_from is not None:
            return 0
        ahead = self.work.ahead - self.made_before
        if len(self.waits) > self.progress.of_simulations - self.work.ahead:
            ahead = 0  # more simulations were waited for than possible if any had run speculatively
        return max(self.progress.simulations_left - self.work.beside * self.progress.pours_left - max(ahead, 0), 0)


class Forecast:
    """Measures durations of a campaign's requests and estimates the remaining time.

    Args:
        run: state of the run, which takes each event before the forecast.
        particles: particles of θ before anything is calibrated.
    """

    def __init__(self, run: RunState, particles: float) -> None:
        self._run, self._particles = run, particles
        self._stages: dict[str, _Stage] = {}
        self._current: _Stage | None = None
        self._pours: list[float] = []

    def begin(self, works: Mapping[str, WorkEstimate]) -> None:
        """Begin a run with the expected work of each stage."""
        self._stages = {name: _Stage(work, self._run.stages[name]) for name, work in works.items()}

    def __call__(self, event: Event) -> None:
        """Measure an event."""
        match event:
            case StageClosed() if event.stage in self._stages:
                self._current = None
                found = getattr(event.result, "found", None)
                if (theta := getattr(found, "theta", None)) is not None:
                    self._particles = theta.particles
            case _ if event.replayed:
                return
            case StageOpened() if event.stage in self._stages:
                self._current = self._stages[event.stage]
                self._current.answered = event.time
            case RequestStarted(request=Pour()) if self._current is not None:
                if self._current.cycle_from is None:
                    self._current.cycle_from = event.time
            case RequestFinished():
                self._finished(event)

    def _finished(self, event: RequestFinished) -> None:
        stage = self._current
        match event.request:
            case Pour() if stage is not None:
                refused = isinstance(event.outcome, Failed) and event.outcome.kind == "invalid_action"
                if stage.cycle_from is not None and not refused:
                    stage.cycles.append(event.time - stage.cycle_from)
                    self._pours.append(event.seconds)
                    stage.cycle_from = event.time
            case Simulate() as request if stage is not None and stage.cycle_from is None:
                if _made_before(event):
                    stage.made_before += 1
                else:
                    stage.waits.append(event.time - stage.answered)
                    stage.particles.append(request.parameters.particles)
                stage.answered = event.time

    def stage_left(self, name: str, now: float) -> float | None:
        """Seconds to the end of a stage; None for an unknown stage."""
        stage = self._stages.get(name)
        if stage is None:
            return None
        if stage.recorded.closed_at is not None:
            return 0.0
        pours = stage.progress.pours_left
        left = stage.simulations_alone * self._price(stage) + pours * self._cycle(stage)
        if pours and stage.cycle_from is not None:
            left -= min(now - stage.cycle_from, 0.9 * self._cycle(stage))
        elif stage is self._current and stage.simulations_alone:
            left -= min(max(now - stage.answered, 0.0), 0.9 * self._price(stage))
        return max(left, 0.0)

    def left(self, now: float) -> float | None:
        """Seconds to the end of the campaign; None before it has begun."""
        if not self._stages:
            return None
        return sum(self.stage_left(name, now) or 0.0 for name in self._stages)

    def _price(self, stage: _Stage) -> float:
        """Seconds between two consecutive finished simulations, without pours."""
        expected = self._expected(stage)
        if len(stage.waits) < ENOUGH:
            return expected
        waits = sorted(stage.waits)[:-1]
        return (sum(waits) + ENOUGH * expected) / (len(waits) + ENOUGH)

    def _expected(self, stage: _Stage) -> float:
        """The same, from measurements of other stages."""
        particles = stage.work.particles or self._particles
        others = [other for other in self._stages.values() if other is not stage and len(other.waits) >= ENOUGH]
        if not others:
            return PRICE / max(min(self._run.slots, self._run.simulators), 1) * particles
        return _usual(others[-1].waits) / fmean(others[-1].particles) * particles

    def _cycle(self, stage: _Stage) -> float:
        """Seconds from the end of a pour to the end of the next."""
        seen = self._pours[-RECENT:] if len(self._pours) >= ENOUGH else ()
        pour = median_low([stage.work.pour_time, *seen])
        expected = max(pour, stage.work.beside * self._price(stage)) + THOUGHT
        cycles = [*stage.cycles[-RECENT:], *[expected] * max(ENOUGH - len(stage.cycles), 1)]
        # the first two include the start of the bench and speculative work
        unusual = 2 if len(stage.cycles) <= RECENT else 1
        return fmean(sorted(cycles)[:-unusual])


def _made_before(event: RequestFinished) -> bool:
    """Whether a simulation ran while the arm poured; its duration then does not predict the next one."""
    return isinstance(event.outcome, Simulated) and event.seconds < 0.1 * event.outcome.outcome.cpu_s


def _usual(values: Sequence[float]) -> float:
    """Mean without the largest value, which may include the start of a process and compilation."""
    return fmean(sorted(values)[:-1])


WEIGHINGS = 15.0
"""Weighing and settling in one pour [s of bench time]; see `actors.bench`."""

WAYS = 8.0
"""Motion to the pour and back home [s of bench time]."""


def work_of(plan: CampaignPlan, stages: Sequence[str]) -> dict[str, WorkEstimate]:
    """Expected work of each stage, by name; empty for stages that are not the plan's own."""
    return {name: _work(plan, name) for name in stages}


def _work(plan: CampaignPlan, name: str) -> WorkEstimate:
    calibration, deployment = plan.calibration, plan.deployment
    if plan.dispense is not None and name == DOSES:
        doses = len(plan.dispense.doses)
        return WorkEstimate(pours=doses, pour_time=pour_time(plan.laboratory, plan.dispense.scenes[0]))
    if calibration is not None:
        pour = pour_time(plan.laboratory, calibration.scene, calibration.actions)
        if name == POURS:
            designing = calibration.design_simulations
            return WorkEstimate(designing, particles=particles_of(plan), pours=calibration.pour_count, pour_time=pour)
        if name == CALIBRATION:
            return WorkEstimate(calibration.simulations, particles=particles_of(plan))
        if name == EVALUATION:
            # Random θ and the uncalibrated one need no θ*: see `orchestrator.runs.request_forecast`.
            rivals = _weighed(calibration) + calibration.random_baseline * _unseen(calibration)
            return WorkEstimate(_scored(calibration), ahead=rivals if calibration.pour_count else 0)
    if deployment is not None and name.startswith((DEPLOYMENT, CONFIRMATION)):
        pour = pour_time(plan.laboratory, deployment.scenes[0], deployment.actions)
        confirming = name.startswith(CONFIRMATION)
        return WorkEstimate(pours=deployment.confirm, pour_time=pour) if confirming else _deployed(deployment, pour)
    return WorkEstimate()


def _weighed(plan: CalibrationPlan) -> int:
    """Number of pours that θ* is evaluated on: made by then, or recorded."""
    records = 0 if plan.records is None else len(plan.records.pours)
    return plan.pour_count + records + (0 if plan.transfer is None else len(plan.transfer.pours))


def _unseen(plan: CalibrationPlan) -> int:
    """Number of these pours that calibration does not use."""
    records = [] if plan.records is None else list(plan.records.pours)
    transfer = 0 if plan.transfer is None else len(plan.transfer.pours)
    return plan.holdout + sum(pour.split != "train" for pour in records) + transfer


def _scored(plan: CalibrationPlan) -> int:
    """Simulations of the evaluation: θ* and the uncalibrated θ on all pours; posterior draws and random rivals on
    unused pours."""
    drawn = DRAWS if plan.random_baseline and plan.settings.makes_posterior else 0
    return 2 * _weighed(plan) + (plan.random_baseline + drawn) * _unseen(plan)


def particles_of(plan: CampaignPlan) -> float:
    """Particles of a simulation: the mean over the search space if particles are searched, else the fixed number."""
    calibration = plan.calibration
    if calibration is None:
        return float(plan.parameters.particles)
    axis = next((axis for axis in calibration.parameters.axes if axis.name == "particles"), None)
    if axis is None:
        return float(calibration.fixed_parameters.get("particles", plan.parameters.particles))
    return math.sqrt(axis.lower * axis.upper)


def _deployed(plan: DeploymentPlan, pour: float) -> WorkEstimate:
    settings = plan.settings
    pours = plan.pours if settings.learns_on_pours else min(plan.pours, 1)
    return WorkEstimate(settings.simulations, pours, settings.simulations_beside, pour_time=pour)


def pour_time(laboratory: LaboratorySettings, scene: Scene, actions: Space | None = None) -> float:
    """Duration of one whole pour with the operator's part, as planned [s of wall time].

    Args:
        laboratory: laboratory with the operator and the bench.
        scene: scene with the fixed parameters of the motion.
        actions: searched parameters of the motion; the middle of their ranges is used. None: nothing is searched.
    """
    values = {**{name: d.lower for name, d in ACTION_DIMENSIONS.items()}, **scene.fixed}
    values |= {axis.name: 0.5 * (axis.lower + axis.upper) for axis in (() if actions is None else actions.axes)}
    angle, speed, back, hold = (
        values.get(name) for name in ("max_angle", "angular_velocity", "return_velocity", "hold_time")
    )
    motion = (angle or 0.0) / (speed or math.inf) + (scene.max_hold_time / 2.0 if hold is None else hold)
    motion += (angle or 0.0) / back if back else 0.0
    bench = laboratory.bench
    liquid = 0.0 if bench is None else PRICE * bench.theta.particles  # a virtual bench simulates its liquid
    if laboratory.arm is not None:
        whole = laboratory.operator.time + laboratory.arm.warning_time + WAYS + motion + WEIGHINGS
        return laboratory.arm.on_clock(whole) + liquid
    if bench is None or bench.time_scale <= 0.0:
        return liquid
    return (bench.operator_time + WAYS + motion + WEIGHINGS) / bench.time_scale + liquid
