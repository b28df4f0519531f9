"""Progress of a running campaign, counted from its events.

`ProgressState` adds to the `RunState` what displays show: lines of text, the load of the pool, the best losses and the
time estimate. It does not print, and its only clock is the time of the events.
"""

from __future__ import annotations

from dataclasses import dataclass

from orchestrator.learning.campaign_plan import CampaignPlan
from orchestrator.learning.requests import Simulated
from orchestrator.learning.single_action import CONFIRM
from orchestrator.records.events import CampaignOpened, Event, RequestFinished
from orchestrator.records.journal_file import Header
from orchestrator.records.run_record import RunPour, RunState
from orchestrator.reports.loss_units import LossUnit, is_calibration, minimised_loss, unit_of_pour
from orchestrator.reports.summarise import pour_summary
from orchestrator.reports.time_estimate import Forecast, work_of

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
        self._timed: list[float] = []
        self._busy_seconds, self._load_to = 0.0, 0.0
        self._load_from: float | None = None

    def __call__(self, event: Event) -> None:
        """Take an event."""
        if not event.replayed:
            self._pass_time(event.time)
            if isinstance(event, RequestFinished) and isinstance(event.outcome, Simulated) and event.seconds > 0.0:
                self._timed.append(event.seconds)
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
            known = best.get(pour.request.scene)
            if known is None or loss < known.loss:
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
        each = f", {sum(self._timed) / len(self._timed):.1f} s each" if self._timed else ""
        parts = [f"{run.simulated} simulation{'s' * (run.simulated != 1)}{each}"]
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
        of = f"/{total}" if total else ""
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
