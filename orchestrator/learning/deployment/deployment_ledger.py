"""Ledger of a deployment in one scene, and the requests that are built from it.

- `DeploymentLedger` records all trials and pours with their costs, counts what was spent of the budget, and provides
  the data of surrogates.
- `DeploymentRequests` builds simulations with their θ and seeds, and queries about the loss with their limits.
- `SearchSettings` holds the settings that D1, D2 and D3 share.

Nothing is requested here: `deployment_base` does.
"""

from __future__ import annotations

from typing import Any, TypeVar

from actors.optimizer.questions import Data, Equality, Point, SpaceFillingQuery, SurrogateQuery
from orchestrator.learning.calibration.calibration_base import Kappa
from orchestrator.learning.campaign_plan import DeploymentPlan, DeploymentSettings
from orchestrator.learning.deployment.costing import Costing
from orchestrator.learning.deployment.real_pours import DeploymentTrial, point_of, prior_pours
from orchestrator.learning.requests import ADDED, Decision, Failed, Outcome, Pour, Prediction, Request, Simulate
from orchestrator.learning.trials import SeedStream, Trials
from sim_engine.action import Action, described
from sim_engine.liquids import SimulationParameters
from sim_engine.scene import Scene
from sim_engine.settings.model import PositiveSimulationCount

MAX_REFUSED = 20
"""Number of refused actions (touching vessels, out of reach) that are free: pours before a strategy gives up, and
simulations before further ones count against the budget."""


EQUAL_LOSS = 0.002
"""Difference of two expected losses, as a share of the load, below which the actions are equally good: less than the
scatter from pour to pour on any bench so far."""

GOLDEN_RATIO = 0.6180339887498949
"""Multiples of it modulo 1 cover the unit interval evenly, however many there are."""

Q = TypeVar("Q", bound=SurrogateQuery)
"""Type of a query."""


class SearchSettings(DeploymentSettings):
    """Settings of D1, D2 and D3: Bayesian optimisation."""

    kappa: Kappa = 2.0
    """κ of the lower confidence bound."""

    initial_samples: PositiveSimulationCount = 3
    """Random actions before the surrogate takes over."""


class DeploymentLedger:
    """Trials and pours of a deployment in one scene.

    A refusal does not count against a budget; at most `MAX_REFUSED` are free. A pour that failed after something had
    moved counts, and enters the data with the worst cost.

    Attributes:
        plan, scene: what is poured, and where.
        trials: simulated trials.
        pours: pours that the strategy requested, in order.
        added: weighed pours that were made without a request.
        former: points and costs of the pours from before the campaign.
        costing: converts outcomes to costs.
        decisions: texts for the log.
    """

    def __init__(self, plan: DeploymentPlan, scene: Scene, parameters: SimulationParameters) -> None:
        self.plan, self.scene = plan, scene
        self.costing = Costing.of(plan, scene, parameters)
        self.trials = Trials()
        self.pours: list[DeploymentTrial] = []
        self.added: list[DeploymentTrial] = []
        self.decisions: list[Decision] = []
        data = plan.data if plan.settings.learns_on_pours else None
        self.former = () if data is None else prior_pours(data, scene, plan.actions, self.costing)
        self._former_counted = 0 if data is None or not data.counts else len(self.former)
        if data is not None:
            text = f"{len(self.former)} former pours enter the data ({data.path.parent.name}/{data.path.name})"
            self.decisions.append(Decision("; left out: ".join([text, *data.left_out])))

    # -- outcomes --------------------------------------------------------------------------------------------------

    def settle(self, request: Simulate, outcome: Outcome) -> None:
        """Record the outcome of a simulation."""
        if isinstance(outcome, Failed) and outcome.kind == "invalid_action":
            self.trials.settle(request, None, refused=True)
        else:
            self.trials.settle(request, self.costing.of_theta(request.parameters).simulated(outcome, request.action))

    def begin(self, point: Point, predicted: Prediction | None) -> DeploymentTrial:
        """Enter a pour that is about to be requested."""
        noise = 0.0 if predicted is None or predicted.scatter is None else predicted.scatter
        number = self._former_counted + len(self.pours) + 1
        self.pours.append(DeploymentTrial(number, point, self.plan.actions.decode(point), predicted, noise))
        return self.pours[-1]

    def take(self, outcome: Outcome) -> None:
        """Record the outcome of the latest pour."""
        self._settle(self.pours[-1], outcome)

    def correct(self, request: Request, outcome: Outcome) -> None:
        """Replace the outcome of a pour.

        Raises:
            ValueError: the strategy has no outcome of this request.
        """
        number = request.number if isinstance(request, Pour) else None
        answered = [trial for trial in self.pours if trial.number == number and trial.status in ("weighed", "failed")]
        if not answered:
            raise ValueError("the strategy has no outcome of this pour")
        self.decisions.append(Decision(f"pour {number} is corrected"))
        self._settle(answered[-1], outcome)

    def _settle(self, trial: DeploymentTrial, outcome: Outcome) -> None:
        trial.take(outcome, self.scene, self.costing, penalised=True)
        if trial.status == "weighed" and trial.cost is not None:
            self.decisions.append(Decision(f"pour {trial.number}: loss {trial.cost:.4g}", {"loss": trial.cost}))

    def add(self, request: Pour, outcome: Outcome) -> None:
        """Take a pour that was added by hand into the data.

        Raises:
            ValueError: the pour is another one, which was not requested.
        """
        if request.purpose != ADDED:
            raise ValueError(f"this pour was not asked for: {request}")
        values = {name: float(getattr(request.action, name)) for name in self.plan.actions.names}
        trial = DeploymentTrial(0, point_of(request.action, self.plan.actions), values, None, 0.0)
        trial.take(outcome, self.scene, self.costing, penalised=False)
        if trial.cost is not None:
            trial.status = "added"
            self.added.append(trial)
            text = f"a pour was added: {described(values)}  loss {trial.cost:.4g}"
            self.decisions.append(Decision(text, {"loss": trial.cost}))

    # -- counts ----------------------------------------------------------------------------------------------------

    @property
    def counted(self) -> int:
        """Pours that count against the budget."""
        return self._former_counted + sum(p.status in ("weighed", "failed") for p in self.pours)

    @property
    def refused(self) -> int:
        """Pours that were refused before anything moved."""
        return sum(p.status == "refused" for p in self.pours)

    @property
    def pours_left(self) -> bool:
        """Whether another pour may be requested."""
        return self.counted < self.plan.pours and self.refused < MAX_REFUSED

    @property
    def spent(self) -> int:
        """Simulated trials before any pour that count against their budget, as known to the next choice."""
        return len(self.trials) - self.unspent

    @property
    def unspent(self) -> int:
        """Refused trials among them that are free."""
        counting = self.trials.counting(everything=self.trials.idle)
        return min(sum(t.refused and t.requests[0].purpose != "refine" for t in counting), MAX_REFUSED)

    # -- data for surrogates ---------------------------------------------------------------------------------------

    @property
    def known(self) -> list[tuple[Point, float]]:
        """Pours that the strategy did not request: from before the campaign, and added by hand."""
        return [*self.former, *((p.point, p.cost) for p in self.added if p.cost is not None)]

    @property
    def poured(self) -> list[tuple[Point, float]]:
        """All pours with a cost."""
        return [*self.known, *((p.point, p.cost) for p in self.pours if p.cost is not None)]

    def real(self) -> Data:
        """Observations of the real cost; those from before the campaign come first."""
        poured = self.poured
        return Data(tuple(point for point, _ in poured), tuple(cost for _, cost in poured))

    def simulated(self, *, everything: bool = False) -> Data:
        """Observations of the simulated cost that the next choice may use; with `everything`, all."""
        return self.trials.data(everything=everything)


class DeploymentRequests:
    """Builds simulations, and queries with the plan's κ, noise and constraints and all refusals and failures so far.

    If the plan has posterior draws of θ, the simulations use them in turn, so that the expected loss over all θ that
    fit the weighed pours is minimised. Where many θ fit equally well, θ* is one of them that rounding may decide; the
    mean over the draws is stable.

    Attributes:
        ledger: the ledger that the limits are read from.
        warned: whether failed pours indicate more failures near them; in the paper they are pours that lost everything.
    """

    def __init__(self, ledger: DeploymentLedger, seeds: SeedStream) -> None:
        self.ledger, self._plan, self._seeds = ledger, ledger.plan, seeds
        self._simulated_thetas = 0
        self.warned = True

    def simulations(self, action: Action, purpose: str, repeats: int = 1) -> tuple[Simulate, ...]:
        """Simulations of one action, each with the next θ."""
        scene, seeds = self.ledger.scene.name, self._seeds
        return tuple(Simulate(scene, action, self._next_theta(), seeds.next(), purpose) for _ in range(repeats))

    def _next_theta(self) -> SimulationParameters:
        """The next of the plan's draws of θ, in an order of which any section covers them evenly; θ* without draws."""
        thetas = self._plan.thetas
        if not thetas:
            return self.ledger.costing.parameters
        self._simulated_thetas += 1
        return thetas[int(self._simulated_thetas * GOLDEN_RATIO % 1.0 * len(thetas))]

    def query(self, kind: type[Q], data: Data, *, everything: bool = True, **parts: Any) -> Q:
        """A query about the loss.

        Args:
            kind: its type.
            data: observations of the loss.
            everything: use all refusals of simulations; else those that the next choice may know.
            parts: further fields of the query.
        """
        settings = self._plan.settings
        if isinstance(settings, SearchSettings):
            parts["kappa"] = settings.kappa
        return kind(self._plan.actions, data, **self._limits(everything), **parts)

    @property
    def equality(self) -> Equality | None:
        """When a recommended action is equal to a gentler one; None with an objective, which rates speed itself."""
        if self._plan.objective is not None:
            return None
        speed = "angular_velocity" if "angular_velocity" in self._plan.actions.names else ""
        return Equality(EQUAL_LOSS * self.ledger.costing.everything_spilled, speed)

    def space_filling(self, **parts: Any) -> SpaceFillingQuery:
        """A query for points that fill the space of actions."""
        return SpaceFillingQuery(self._plan.actions, **self._limits(everything=True), **parts)

    def _limits(self, everything: bool) -> dict[str, Any]:
        """Constraints, refusals and failures, as fields of a query."""
        trials, pours = self.ledger.trials.counting(everything=everything), self.ledger.pours
        return {
            "constraints": self._plan.constraints,
            "infeasible": tuple(trial.point for trial in trials if trial.refused),
            "refused": tuple(p.point for p in pours if p.status == "refused"),
            "failed": tuple(p.point for p in pours if p.mishap and p.cost is not None) if self.warned else (),
        }
