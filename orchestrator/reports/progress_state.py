"""Progress of a running campaign, counted from its events, and the estimate of its remaining time.

`ProgressState` adds to the `RunState` what displays show: lines of text, the load of the pool, the best losses and the
time estimate. It does not print, and its only clock is the time of the events.

The remaining time is the planned work that is left, times the median of recent durations. `work_of` derives the
expected work of each stage (`WorkEstimate`) from the plan, and `Forecast` measures the times between outcomes. Until
some are measured, the planned time of a pour counts, and a time proportional to the particles of a simulation. The
estimate is for display only; no decision depends on it.

Limitations: the operator's speed is unknown before the first pour; simulations of all stages count as equally long.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from statistics import fmean, median

from actors.laboratory_settings import LaboratorySettings
from orchestrator.learning.calibration.calibration_scores import DRAWS
from orchestrator.learning.campaign_plan import CalibrationPlan, CampaignPlan
from orchestrator.learning.requests import Failed, Pour, Simulate, Simulated
from orchestrator.learning.single_action import CONFIRM
from orchestrator.learning.strategy import Progress, plural
from orchestrator.records.events import CampaignOpened, Event, RequestFinished, RequestStarted, StageOpened
from orchestrator.records.journal_file import Header
from orchestrator.records.run_record import NOT_REPORTED, RunPour, RunState
from orchestrator.reports.figure_style import two_digits
from orchestrator.reports.loss_units import LossUnit, is_calibration, minimised_loss, unit_of_pour
from orchestrator.reports.summarise import pour_summary
from orchestrator.runs.stages import CALIBRATION, CONFIRMATION, DEPLOYMENT, DOSES, EVALUATION, POURS
from sim_engine.action import ACTION_DIMENSIONS
from sim_engine.scene import Scene
from sim_engine.search_space import Space

CHECKPOINT_WORDS = {
    "operator": "waiting for the operator",
    "tare": "taring",
    "approach": "moving to start",
    "tilt": "tilting",
    "hold": "holding",
    "return": "returning upright",
    "dose": "dosing",
    "settle": "settling",
    "weigh": "weighing",
    "record": "recording",
}


@dataclass
class Best:
    """The smallest measured loss of a receiver, in the loss's own unit."""

    loss: float
    pour: int
    unit: LossUnit


class ProgressState:
    """The state of a campaign that is followed, in words and numbers for displays.

    Args:
        plan: the campaign.

    Attributes:
        run: what its events say.
        forecast: estimate of the remaining time.
    """

    def __init__(self, plan: CampaignPlan) -> None:
        self.plan = plan
        self.run = RunState(Header(plan.name, {}), plan.parallel_simulations)
        self.forecast = Forecast(self.run, plan.parameters.particles)
        self._cpu_s: list[float] = []
        self._busy_seconds, self._load_to = 0.0, 0.0
        self._load_from: float | None = None

    def __call__(self, event: Event) -> None:
        """Take an event."""
        if not event.replayed:
            self._pass_time(event.time)
            if isinstance(event, RequestFinished) and isinstance(event.outcome, Simulated):
                self._cpu_s.append(event.outcome.outcome.cpu_s)  # what was made ahead has no wall time
        self.run.take(event)
        self.forecast(event)
        if isinstance(event, CampaignOpened):
            self.forecast.begin(work_of(self.plan, event.stages))

    @property
    def best(self) -> dict[str, Best]:
        """Best measured loss by scene."""
        best: dict[str, Best] = {}
        for pour in self.run.weighed:
            if pour.request.purpose == CONFIRM or (loss := minimised_loss(self.plan, pour)) is None:
                continue
            earlier = best.get(pour.request.scene)
            if earlier is None or loss < earlier.loss:
                unit = unit_of_pour(self.plan, pour.request)
                best[pour.request.scene] = Best(loss, pour.request.number, unit)
        return best

    @property
    def pour(self) -> RunPour | None:
        """The pour under way."""
        return None if self.run.pour is None or self.run.pour.outcome is not None else self.run.pour

    def _pass_time(self, now: float) -> None:
        if self._load_from is None:
            self._load_from = now
        else:
            self._busy_seconds += self.busy * max(now - self._load_to, 0.0)
        self._load_to = now

    @property
    def busy(self) -> int:
        """Number of busy simulators."""
        return min(len(self.run.running) + self.run.ahead.running, self.run.simulators)

    def load(self) -> float | None:
        """Mean share of the pool (0 … 1) that was busy since the last call; None if no time has passed."""
        elapsed = 0.0 if self._load_from is None else self._load_to - self._load_from
        if elapsed <= 0.0 or not self.run.simulators:
            return None
        share = self._busy_seconds / (elapsed * self.run.simulators)
        self._load_from, self._busy_seconds = self._load_to, 0.0
        return share

    def pool_line(self, scene: str | None = None) -> str:
        """'pool 2/2 busy · 214 simulations, 0.9 s each · best so far 1.10 % (pour 4)'."""
        pool = f"pool {self.busy}/{self.run.simulators} busy · " if self.run.simulators else ""
        return pool + self.counts_line(scene)

    def counts_line(self, scene: str | None = None) -> str:
        """'214 simulations, 0.9 s each · best so far 1.10 % (pour 4)'."""
        run, pour = self.run, self.run.pour
        each = f", {two_digits(fmean(self._cpu_s))} s each" if self._cpu_s else ""
        parts = [f"{plural(run.simulated, 'simulation')}{each}"]
        calibrating = self.pour is not None and is_calibration(self.plan, self.pour.request)
        if run.ahead.waiting and (run.ahead.running or calibrating):  # some of them are never requested
            parts.append(f"{run.ahead.waiting} more made ahead")
        if run.failures:
            ((reason, _),) = run.failures.most_common(1)
            parts.append(f"{run.failures.total()} failed ({'' if len(run.failures) == 1 else 'mostly '}{reason})")
        wanted, best_of = pour.request.scene if scene is None and pour is not None else scene, self.best
        if wanted is not None and wanted in best_of:
            best = best_of[wanted]
            parts.append(f"best so far {best.unit.text(best.loss)} (pour {best.pour})")
        return " · ".join(parts)

    def pour_line(self) -> str | None:
        """'pour 7/15 into narrow  angular velocity 41.2 deg/s, x offset 104 mm  predicted 0.80 ± 0.90 %'."""
        pour, total = self.run.pour, None
        if pour is None:
            return None
        text, confirming = pour_summary(self.plan, pour, live=True), pour.request.purpose == CONFIRM
        if self.plan.dispense is not None:
            total = len(self.plan.dispense.doses)
        elif text.calibration:
            total = self.plan.calibration.pour_count if self.plan.calibration is not None else None
        elif self.plan.deployment is not None:
            total = self.plan.deployment.confirm if confirming else self.plan.deployment.pours
        begun = text.number - sum(p.stage == pour.stage and p.id != pour.id and p.refused for p in self.run.pours)
        of = f"/{total}" if begun == text.number else f" ({begun} of {total})"
        of = of if total and begun <= total else ""
        line = f"{'confirming pour' if confirming else 'pour'} {text.number}{of} into {text.receiver}  {text.action}"
        if text.predicted:
            line += f"  predicted {text.predicted}"
        if pour.outcome is not None:
            line += f"  measured {text.remark if text.state == 'failed' else text.measured}"
        return line

    def dose_line(self) -> str | None:
        """'31.2 ± 0.4 g of 50 g   5.1 g/s' while a wanted amount is poured; None otherwise."""
        progress = None if self.run.pour is None else self.run.pour.progress
        if progress is None or progress.dose is None:
            return None
        dose = progress.dose
        amounts = f"{1e3 * dose.amount:.1f} ± {2e3 * dose.deviation:.1f} g of {1e3 * dose.target:g} g"
        return f"{amounts}   {1e3 * dose.flow:.1f} g/s"


PRICE = 1e-3
"""Assumed time of a simulated pour on one core, per particle, before the first measurement [s]."""

RECENT = 9
"""Number of recent durations whose median counts: operators get faster, and other programs start and stop."""

LATE = 3.0
"""Number of expected durations after which a pour or a simulation counts as late."""


@dataclass(frozen=True)
class WorkEstimate:
    """Expected work of a stage, before the strategy reports its own progress.

    Attributes:
        simulations, pours: total numbers.
        beside: number of the simulations that run during each pour.
        pour_time: planned duration of one pour [s of wall time].
    """

    simulations: int = 0
    pours: int = 0
    beside: int = 0
    pour_time: float = 0.0


class Forecast:
    """Measures the times between outcomes and estimates the remaining time.

    Args:
        run: state of the run, which takes each event before the forecast.
        particles: particles of a simulation.
    """

    def __init__(self, run: RunState, particles: float) -> None:
        self._run, self._particles = run, particles
        self._works: Mapping[str, WorkEstimate] = {}
        self._cycles: deque[float] = deque(maxlen=RECENT)
        self._waits: deque[float] = deque(maxlen=RECENT)
        self._stage, self._pouring, self._since = "", False, 0.0

    def begin(self, works: Mapping[str, WorkEstimate]) -> None:
        """Begin a run with the expected work of each stage."""
        self._works = works

    def __call__(self, event: Event) -> None:
        """Measure an event: the time from a pour's end to the next one's, and between simulations before any pour."""
        match event:
            case _ if event.replayed:
                return
            case StageOpened():
                self._stage, self._pouring, self._since = event.stage, False, event.time
            case RequestStarted(request=Pour()) if not self._pouring:
                self._pouring, self._since = True, event.time
            case RequestFinished(request=Pour()):
                if not (isinstance(event.outcome, Failed) and event.outcome.kind == "invalid_action"):
                    self._cycles.append(event.time - self._since)
                    self._since = event.time
            case RequestFinished(request=Simulate()) if not self._pouring:
                self._waits.append(event.time - self._since)
                self._since = event.time

    def stage_left(self, name: str, now: float) -> float | None:
        """Seconds to the end of a stage; None for an unknown stage."""
        work = self._works.get(name)
        if work is None:
            return None
        recorded, current = self._run.stages[name], name == self._stage
        if recorded.closed_at is not None:
            return 0.0
        progress = recorded.progress
        if progress is NOT_REPORTED:
            progress = Progress(0, work.simulations, 0, work.pours)
        simulations = max(progress.simulations_left - work.beside * progress.pours_left, 0)
        if current and self._pouring:
            simulations = 0
        # The planned duration counts twice: the first outcome includes the start of simulators, or of the bench.
        price = PRICE * self._particles / max(min(self._run.slots, self._run.simulators), 1)
        wait = median([price, price, *self._waits])
        planned = max(work.pour_time, work.beside * wait)
        cycle = median([planned, planned, *self._cycles])
        left = simulations * wait + progress.pours_left * cycle
        if current:
            passed, expected = max(now - self._since, 0.0), 0.9 * (wait if simulations else cycle)
            left += max(passed - LATE * expected, 0.0) - min(passed, expected)  # what is late is as late again
        return max(left, 0.0)

    def left(self, now: float) -> float | None:
        """Seconds to the end of the campaign; None before it has begun."""
        if not self._works:
            return None
        return sum(self.stage_left(name, now) or 0.0 for name in self._works)


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
        if name == POURS:
            pour = pour_time(plan.laboratory, calibration.scene, calibration.actions)
            return WorkEstimate(calibration.design_simulations, calibration.pour_count, pour_time=pour)
        if name == CALIBRATION:
            return WorkEstimate(calibration.simulations)
        if name == EVALUATION:
            return WorkEstimate(_scored(calibration))
    if deployment is not None and name.startswith((DEPLOYMENT, CONFIRMATION)):
        pour = pour_time(plan.laboratory, deployment.scenes[0], deployment.actions)
        if name.startswith(CONFIRMATION):
            return WorkEstimate(pours=deployment.confirm, pour_time=pour)
        settings = deployment.settings
        pours = deployment.pours if settings.learns_on_pours else min(deployment.pours, 1)
        return WorkEstimate(settings.simulations, pours, settings.simulations_beside, pour)
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
    draws = DRAWS if plan.random_baseline and plan.settings.makes_posterior else 0
    return 2 * _weighed(plan) + (plan.random_baseline + draws) * _unseen(plan)


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
        seconds = laboratory.operator.time + laboratory.arm.warning_time + WAYS + motion + WEIGHINGS
        return laboratory.arm.on_clock(seconds) + liquid
    if bench is None or bench.time_scale <= 0.0:
        return liquid
    return (bench.operator_time + WAYS + motion + WEIGHINGS) / bench.time_scale + liquid
