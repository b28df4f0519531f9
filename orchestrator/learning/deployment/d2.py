"""D2: learn from real pours only, without simulation. `D2Settings` holds the settings, `RealOnly` is the strategy."""

from __future__ import annotations

from typing import Any, ClassVar, Literal

from actors.optimizer.questions import MinimumQuery, RegressionQuery
from orchestrator.learning.campaign_plan import DeploymentPlan
from orchestrator.learning.deployment.deployment_base import MAP_RESOLUTION, Deployment
from orchestrator.learning.deployment.deployment_ledger import SearchSettings
from orchestrator.learning.strategy import Strategy
from sim_engine.liquids import SimulationParameters
from sim_engine.scene import Scene


class D2Settings(SearchSettings):
    """D2: learn from real pours."""

    simulates: ClassVar[bool] = False

    strategy: Literal["D2"] = "D2"
    """Learn from real pours."""

    mean: Literal["constant", "zero"] = "constant"
    """Prior mean of the surrogate; the paper uses 'zero'."""

    def build(self, plan: DeploymentPlan, scene: Scene, parameters: SimulationParameters, seed: int) -> Strategy:
        """Build the strategy."""
        return RealOnly(plan, scene, parameters, seed)


class RealOnly(Deployment[D2Settings]):
    """D2: Bayesian optimisation on weighed pours, without simulation; the baseline.

    The surrogate has a constant mean by default; the paper uses `mean: zero`. For a minimised cost in [0, 1], a zero
    mean rates every unexplored action as perfect, so that the search explores corners without end.

    Source: Lopez-Guevara et al., CoRL 2017, section 3.4 (D2).
    """

    def _next(self) -> None:
        if self._pouring is not None:
            return
        ledger = self._ledger
        if ledger.pours_left:
            points = [p.point for p in ledger.pours if p.status != "refused"]
            tried = [*(point for point, _ in ledger.known), *points]
            if len(tried) < min(self._settings.initial_samples, self._plan.pours):
                # one Sobol sequence, point by point, each far from the points already poured
                query = self._requests.space_filling(known=tuple(tried))
                self._questions.put(query, "start", lambda suggestion: self._pour(suggestion.points[0]))
            else:
                self._questions.put(self._about(MinimumQuery), "pour", self._pour_first)
        else:
            conclusion = self._about(RegressionQuery, equality=self._requests.equality)
            self._questions.put(conclusion, "conclude", self._conclude)

    def _about(self, kind: type[MinimumQuery | RegressionQuery], **parts: Any) -> MinimumQuery | RegressionQuery:
        """A query about the real cost."""
        real = self._ledger.real()
        return self._requests.query(kind, real, mean=self._settings.mean, map_resolution=MAP_RESOLUTION, **parts)
