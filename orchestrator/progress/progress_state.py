"""Progress of a running campaign, counted from its events.

`ProgressState` keeps the counts, the running pour, the best losses and the time estimate for displays. It does not
print, and its only clock is the time of the events.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field

from actors.interfaces import PourProgress
from orchestrator.journal.run_record import RecordedPour
from orchestrator.progress.time_estimate import Forecast, particles_of, work_of
from orchestrator.requests import Failed, Pour, Poured, Simulate, Simulated
from orchestrator.results.loss_units import LossUnit, is_calibration, loss_of_pour, unit_of_pour
from orchestrator.results.stage_views import receiver_name
from orchestrator.results.summarise import pour_summary
from orchestrator.runs.events import (
    CampaignClosed,
    CampaignOpened,
    CampaignStateChanged,
    Event,
    PourProgressed,
    RequestFinished,
    RequestStarted,
    SpeculationProgressed,
    StageClosed,
    StageOpened,
    StrategyProgressed,
)
from orchestrator.strategies.campaign_plan import CampaignPlan
from orchestrator.strategies.single_action import CONFIRM
from orchestrator.strategies.strategy import Progress

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
class StageProgressState:
    """Progress of one stage.

    Attributes:
        progress: progress last reported by the strategy.
        opened_at, closed_at: times of these events; a replayed opening has none.
    """

    name: str
    progress: Progress = field(default_factory=Progress)
    opened_at: float | None = None
    closed_at: float | None = None


@dataclass
class PourProgressState:
    """The running pour, or the last one."""

    number: int
    stage: str
    scene: str
    action: str
    predicted: str
    started_at: float
    calibrating: bool
    confirming: bool = False
    progress: PourProgress | None = None
    result: str = ""


@dataclass
class Best:
    """The smallest measured loss of a receiver, in the loss's own unit."""

    loss: float
    pour: int
    unit: LossUnit


@dataclass
class ProgressState:
    """Counts a campaign's events.

    Attributes:
        plan: the campaign.
        simulators: number of simulators in the pool.
        running: ids of running simulations.
        ahead: number of running and unused speculative simulations.
        simulations: number of finished simulations.
        failures: number of failed simulations by their reason in a few words.
        simulation_seconds: total wall seconds of finished simulations, without replayed ones.
        timed_simulations: number of simulations in `simulation_seconds`.
        best: best measured loss by scene.
        forecast: estimate of the remaining time.
    """

    plan: CampaignPlan
    mode: str = ""
    state: str = ""
    simulators: int = 0
    stages: dict[str, StageProgressState] = field(default_factory=dict)
    running: set[int] = field(default_factory=set)
    ahead: SpeculationProgressed = field(default_factory=lambda: SpeculationProgressed(running=0, waiting=0))
    simulations: int = 0
    failures: Counter[str] = field(default_factory=Counter)
    simulation_seconds: float = 0.0
    timed_simulations: int = 0
    pour: PourProgressState | None = None
    best: dict[str, Best] = field(default_factory=dict)

    forecast: Forecast = field(init=False)

    _busy_seconds: float = 0.0
    _load_from: float | None = None
    _load_to: float = 0.0

    def __post_init__(self) -> None:
        self.forecast = Forecast(self.plan.parallel_simulations, particles_of(self.plan))

    def __call__(self, event: Event) -> None:
        """Count an event."""
        if not event.replayed:
            self._pass_time(event.time)
        self.forecast(event)
        match event:
            case CampaignOpened():
                self.mode, self.simulators = event.mode, event.simulators
                self.stages = {name: StageProgressState(name) for name in event.stages}
                self.forecast.begin(event.simulators, work_of(self.plan, event.stages))
            case CampaignStateChanged():
                self.state = event.after
            case CampaignClosed():
                self.state = event.state
            case StageOpened():
                stage = self._stage(event.stage)
                # A replayed stage has no known duration; the first live event starts its clock.
                stage.opened_at = None if event.replayed else event.time
            case StageClosed():
                self._stage(event.stage).closed_at = event.time
            case StrategyProgressed():
                stage = self._stage(event.stage)
                stage.progress = event.progress
                if not event.replayed and stage.opened_at is None:
                    stage.opened_at = event.time
            case RequestStarted():
                self._started(event)
            case RequestFinished():
                self._finished(event)
            case SpeculationProgressed():
                self.ahead = event
            case PourProgressed() if self.pour is not None:
                self.pour.progress = event.progress

    def _stage(self, name: str) -> StageProgressState:
        return self.stages.setdefault(name, StageProgressState(name))

    def _started(self, event: RequestStarted) -> None:
        match event.request:
            case Simulate():
                self.running.add(event.id)
            case Pour() as pour:
                said = pour_summary(self.plan, RecordedPour(event.stage, event.id, pour))
                self.pour = PourProgressState(
                    pour.number,
                    event.stage,
                    pour.scene,
                    said.action,
                    said.predicted,
                    event.time,
                    said.calibration,
                    pour.purpose == CONFIRM,
                )

    def _finished(self, event: RequestFinished) -> None:
        match event.request, event.outcome:
            case Simulate(), outcome:
                self.running.discard(event.id)
                if isinstance(outcome, Simulated):
                    self.simulations += 1
                    if event.seconds > 0.0:
                        self.simulation_seconds += event.seconds
                        self.timed_simulations += 1
                elif isinstance(outcome, Failed):
                    self.failures[outcome.reason.partition(":")[0]] += 1
            case Pour() as pour, Poured() as outcome:
                loss = loss_of_pour(self.plan, pour, outcome.measurement)
                if self.pour is not None:
                    weighed = RecordedPour(event.stage, event.id, pour, "weighed", outcome.measurement)
                    self.pour.result = pour_summary(self.plan, weighed).measured
                minimised = pour.purpose != CONFIRM and pour.dose is None and not is_calibration(self.plan, pour)
                if loss is not None and minimised:
                    best = self.best.get(pour.scene)
                    if best is None or loss < best.loss:
                        self.best[pour.scene] = Best(loss, pour.number, unit_of_pour(self.plan, pour))
            case Pour(), Failed() as failed:
                if self.pour is not None:
                    self.pour.result = f"failed: {failed.reason}"

    def _pass_time(self, now: float) -> None:
        if self._load_from is None:
            self._load_from = now
        else:
            self._busy_seconds += self.busy * max(now - self._load_to, 0.0)
        self._load_to = now

    @property
    def busy(self) -> int:
        """Number of busy simulators."""
        return min(len(self.running) + self.ahead.running, self.simulators)

    @property
    def _calibration_pour(self) -> bool:
        return self.pour is not None and self.pour.calibrating and not self.pour.result

    def load(self) -> float | None:
        """Mean share of the pool (0 … 1) that was busy since the last call; None if no time has passed."""
        elapsed = 0.0 if self._load_from is None else self._load_to - self._load_from
        if elapsed <= 0.0 or not self.simulators:
            return None
        share = self._busy_seconds / (elapsed * self.simulators)
        self._load_from, self._busy_seconds = self._load_to, 0.0
        return share

    def pool_line(self, scene: str | None = None) -> str:
        """'pool 2/2 busy · 214 simulations, 0.9 s each · best so far 1.10 % (pour 4)'."""
        pool = f"pool {self.busy}/{self.simulators} busy · " if self.simulators else ""
        return pool + self.counts_line(scene)

    def counts_line(self, scene: str | None = None) -> str:
        """'214 simulations, 0.9 s each · best so far 1.10 % (pour 4)'."""
        each = f", {self.simulation_seconds / self.timed_simulations:.1f} s each" if self.timed_simulations else ""
        parts = [f"{self.simulations} simulation{'s' * (self.simulations != 1)}{each}"]
        if self.ahead.waiting and (self.ahead.running or self._calibration_pour):  # some of them are never requested
            parts.append(f"{self.ahead.waiting} more made ahead")
        if self.failures:
            ((reason, _),) = self.failures.most_common(1)
            parts.append(f"{self.failures.total()} failed ({'' if len(self.failures) == 1 else 'mostly '}{reason})")
        wanted = self.pour.scene if scene is None and self.pour is not None else scene
        if wanted is not None and wanted in self.best:
            best = self.best[wanted]
            parts.append(f"best so far {best.unit.text(best.loss)} (pour {best.pour})")
        return " · ".join(parts)

    def pour_line(self) -> str | None:
        """'pour 7/15 into narrow  angular velocity 41.2 deg/s, x offset 104 mm  predicted 0.80 ± 0.90 %'."""
        pour = self.pour
        if pour is None:
            return None
        total = None
        if self.plan.dispense is not None:
            total = len(self.plan.dispense.doses)
        elif pour.calibrating:
            total = self.plan.calibration.pour_count if self.plan.calibration is not None else None
        elif self.plan.deployment is not None:
            total = self.plan.deployment.confirm if pour.confirming else self.plan.deployment.pours
        of = f"/{total}" if total else ""
        kind = "confirming pour" if pour.confirming else "pour"
        line = f"{kind} {pour.number}{of} into {receiver_name(self.plan, pour.scene)}  {pour.action}"
        if pour.predicted:
            line += f"  predicted {pour.predicted}"
        if pour.result:
            line += f"  measured {pour.result}"
        return line

    def dose_line(self) -> str | None:
        """'31.2 ± 0.4 g of 50 g   5.1 g/s' while a wanted amount is poured; None otherwise."""
        progress = None if self.pour is None else self.pour.progress
        if progress is None or progress.dose is None:
            return None
        dose = progress.dose
        amounts = f"{1e3 * dose.amount:.1f} ± {2e3 * dose.deviation:.1f} g of {1e3 * dose.target:g} g"
        return f"{amounts}   {1e3 * dose.flow:.1f} g/s"
