"""How D3 chooses its real pours: the query for the next one, and what follows from an answer about the simulator.

`d3` decides when to pour and what to simulate.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal

from actors.optimizer.questions import Data, ModelDiscrepancy, PourQuery, Suggestion
from orchestrator.learning.deployment.deployment_base import DeploymentReport
from orchestrator.learning.deployment.deployment_ledger import DeploymentRequests
from orchestrator.learning.deployment.deployment_result import Deployed
from orchestrator.learning.deployment.model_monitoring import Rules, SimulatorMonitor, offset_priors
from orchestrator.learning.requests import Decision


class ActionChoice:
    """Chooses the real pours of D3.

    Args:
        simulated: observations of the simulated cost for a query.
        rules: consequences of answers about the simulator; None with the paper's model, which always believes it.

    Attributes:
        ended: reason why no further pour is made; None if they go on.
    """

    def __init__(self, requests: DeploymentRequests, simulated: Callable[[], Data], rules: Rules | None) -> None:
        self._requests, self._ledger, self._plan = requests, requests.ledger, requests.ledger.plan
        self._simulated, self._rules = simulated, rules
        worst = self._ledger.costing.worst
        decisions = self._ledger.decisions
        self._monitor = None if rules is None else SimulatorMonitor(rules, self._plan.actions, worst, decisions)
        evidence = None if rules is None else self._plan.evidence
        self._calibration = () if evidence is None else evidence.pours
        decisions += () if evidence is None else map(Decision, evidence.lines)
        self.ended: str | None = None
        requests.warned = rules is not None

    @property
    def left(self) -> bool:
        """Whether another pour may be requested."""
        return self._ledger.pours_left and self.ended is None

    # -- queries ---------------------------------------------------------------------------------------------------

    @property
    def acquisition(self) -> Literal["lcb", "posterior_minimum", "least_loss"]:
        """Acquisition of the next pour."""
        if self._rules is not None:
            return "least_loss"
        return "lcb" if self._ledger.pours or self._ledger.known else "posterior_minimum"

    def query(self, *, count: int, **parts: Any) -> PourQuery:
        """A query for the next pour and `count` − 1 simulations; with a count of 0, about the real cost only."""
        return self.about(self._ledger.real(), self._simulated(), count=count, **parts)

    def about(self, poured: Data, simulated: Data, **parts: Any) -> PourQuery:
        """A query about given observations."""
        return self._requests.query(PourQuery, poured, simulated=simulated, discrepancy=self._discrepancy, **parts)

    @property
    def _discrepancy(self) -> ModelDiscrepancy | None:
        """The ways in which the simulator may be wrong; None with the paper's model."""
        if self._rules is None:
            return None
        ledger, limit = self._ledger, self._rules.limit
        weighed = [pour.cost for pour in ledger.pours if pour.cost is not None]
        supported = any(cost <= limit.loss for cost in weighed) if weighed and limit else bool(self._calibration)
        if not supported:
            limit = None  # no poured action keeps it and could be repeated
        return ModelDiscrepancy(
            offset_priors(self._plan.actions),
            self._plan.bench,
            worst=ledger.costing.worst,
            pours_left=max(self._plan.pours - ledger.counted - 1, 0),
            limit=limit,
            # an informative first pour may end in a corner, and a limit would keep the following pours there
            lookahead=self._rules.limit is None or limit is not None,
            calibration=self._calibration or None,
        )

    # -- answers ---------------------------------------------------------------------------------------------------

    def judge(self, suggestion: Suggestion, pour: Callable[[Suggestion], None]) -> None:
        """Record the conclusions about the simulator, and make the next pour if they allow it."""
        self.record(suggestion)
        if self._monitor is not None:
            left = self._plan.pours - self._ledger.counted
            self.ended = self._monitor.judge(suggestion, self._ledger.pours, left) or None
        if self.ended is None:
            pour(suggestion)

    def record(self, suggestion: Suggestion) -> None:
        """Record the conclusions about the simulator."""
        if self._monitor is not None and suggestion.discrepancy is not None:
            self._monitor.record(suggestion.discrepancy, self._ledger.pours)

    def result(self, report: DeploymentReport) -> Deployed:
        """The result so far, with the conclusions about simulator and bench."""
        if self._monitor is None:
            return report.result(ended=self.ended)
        return report.result(model_check=self._monitor.result(), ended=self.ended, bench=self._monitor.bench())
