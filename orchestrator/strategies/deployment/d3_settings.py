"""The settings of D3."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, ClassVar, Literal

from actors.optimizer.core.mismatch import Limit
from orchestrator.config.yaml.quantities import Quantity
from orchestrator.config.yaml.sections import Complaints, CountOrFree, SimulationCount
from orchestrator.plan import DeploymentPlan
from orchestrator.strategies.deployment.adaptive import IgnoranceSettings, RiskLimitSettings, Rules, StopSettings
from orchestrator.strategies.deployment.prices import PricesSettings
from orchestrator.strategies.deployment.settings import SearchSettings
from orchestrator.strategies.deployment.trust import TrustOrAlways, TrustSettings
from orchestrator.strategies.protocol import Strategy
from orchestrator.strategies.settings import Premises
from sim_engine.liquid import SimulationParameters
from sim_engine.task import Scene

if TYPE_CHECKING:
    from orchestrator.requests import Order


class D3Settings(SearchSettings):
    """D3: real pours with a simulated prior."""

    required: ClassVar[dict[str, str]] = {"strategy": "D3"}

    strategy: Literal["D3"] = "D3"
    """Real pours with a simulated prior."""

    prior_simulations: SimulationCount = 37
    """Simulations before the first pour; with 'per_pour: free' at most so many."""

    per_pour: CountOrFree = 2
    """Simulations told between two pours; 'free': for as long as they are worth it."""

    prices: PricesSettings | None = None
    """With 'per_pour: free': what a pour and a simulation cost."""

    model: Literal["adaptive", "residual", "pooled", "scaled"] = "adaptive"
    """How simulations enter the surrogate of pours; 'adaptive' averages over ways in which the simulator may be wrong,
    'residual' is the paper's."""

    trust: TrustOrAlways | None = None
    """For the other models: when the first pours say that the simulator is wrong, and what follows; 'always' believes
    it, as the paper."""

    ignorance: IgnoranceSettings | None = None
    """With 'model: adaptive': what follows when the simulator seems to say nothing of this bench."""

    risk_limit: RiskLimitSettings | None = None
    """With 'model: adaptive': what no pour may lose, once one has kept it."""

    stop: StopSettings | None = None
    """With 'model: adaptive': ends before all pours are made when no further one is worth it."""

    good_enough: Annotated[float, Quantity("1", "1 %", 1e-4, 1.0)] | None = None
    """With 'model: adaptive': ends as soon as the best action is expected to lose no more than this share of a load."""

    @property
    def beside(self) -> int | None:
        """Simulations told between two pours; None: for as long as a pour takes."""
        return None if self.per_pour == "free" else int(self.per_pour)

    @property
    def adaptive(self) -> bool:
        """Whether it averages over the ways in which the simulator may be wrong."""
        return self.model == "adaptive"

    @property
    def checked(self) -> TrustSettings | None:
        """When the simulator is called wrong; None if it never is, or if every pour weighs it."""
        if self.adaptive or self.trust == "always":
            return None
        return self.trust if isinstance(self.trust, TrustSettings) else TrustSettings()

    @property
    def plain(self) -> bool:
        """Simulations before the first pour are chosen as in the paper, with a constant κ, and warn of nothing."""
        return self.model == "residual"

    @property
    def order(self) -> Order:
        """Only where simulations go on for as long as a pour takes does the clock decide what is asked for."""
        return "completion" if self.beside is None else "logical"

    @property
    def simulations(self) -> int:
        """Those before the first pour and beside all."""
        return self.prior_simulations + (self.pours or 0) * self.simulations_beside

    @property
    def simulations_before(self) -> int:
        """Those of the prior."""
        return self.prior_simulations

    @property
    def simulations_beside(self) -> int:
        """Those told between two pours."""
        return self.beside or 0

    @property
    def spending(self) -> str:
        """What it spends into one receiver, in words."""
        return f"{self.prior_simulations} simulations, then {self.pours} pours with {self.per_pour} beside each"

    def check(self, premises: Premises, complaints: Complaints) -> None:
        """Prices decide only where simulations go on for as long as they are worth it."""
        super().check(premises, complaints)
        if self.prices is not None and self.beside is not None:
            text = f"decides nothing with 'per_pour: {self.per_pour}'; write 'per_pour: free', or remove it"
            complaints.add(text, "prices", key=True)
        for key in () if self.adaptive else ("ignorance", "risk_limit", "stop", "good_enough"):
            if getattr(self, key) is not None:
                complaints.add(f"needs 'model: adaptive', not '{self.model}'", key, key=True)
        if self.trust is not None and self.adaptive:
            complaints.add(
                "decides nothing with 'model: adaptive', which weighs the simulator by every pour", "trust", key=True
            )

    @property
    def learns_of_benches(self) -> bool:
        """What is known of the bench beforehand enters its hypotheses."""
        return self.adaptive

    def rules(self, worst: float) -> Rules:
        """What follows on what the pours say of the simulator, in units of a loss whose largest value is given."""
        limit = None if self.risk_limit is None else Limit(worst * self.risk_limit.loss, self.risk_limit.probability)
        return Rules(
            ignorance=self.ignorance or IgnoranceSettings(),
            limit=limit,
            otherwise="go on" if self.risk_limit is None else self.risk_limit.otherwise,
            gain_below=None if self.stop is None else worst * self.stop.gain_below,
            good_enough=None if self.good_enough is None else worst * self.good_enough,
        )

    def build(self, plan: DeploymentPlan, scene: Scene, parameters: SimulationParameters, seed: int) -> Strategy:
        """The strategy itself."""
        from orchestrator.strategies.deployment.d3 import Hybrid
        from orchestrator.strategies.deployment.d3_free import FreeHybrid

        return (FreeHybrid if self.beside is None else Hybrid)(plan, scene, parameters, seed)
