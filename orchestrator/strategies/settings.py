"""What a strategy declares of itself: one class with its settings, their checks, and how it is made.

The class stands beside the strategy and is registered at the door `decant.strategies` under its `strategy`. From it
come the YAML keys with their errors, the JSON schema, the tables of the docs, the run's record and its fingerprint.
"""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass
from pkgutil import resolve_name
from typing import TYPE_CHECKING, Any, ClassVar, Literal, Self

from orchestrator.config.yaml.sections import Complaints, PourCount, Section

if TYPE_CHECKING:
    from collections.abc import Sequence

    from orchestrator.plan import CalibrationPlan, DeploymentPlan, Draw, MeasuredPour
    from orchestrator.requests import Order
    from orchestrator.strategies.protocol import Strategy
    from sim_engine.liquid import SimulationParameters
    from sim_engine.space import Space
    from sim_engine.task import Scene


class StrategySettings(Section):
    """What the settings of all strategies have in common."""

    tag: ClassVar[str] = "strategy"

    strategy: str = ""
    """Which strategy; a literal in each class, and its name at the door."""

    @classmethod
    def like(cls, other: StrategySettings, without: Sequence[str] = (), **changes: Any) -> Self:
        """Settings with what another strategy has of the same name, and defaults for the rest.

        Args:
            without: names that keep their defaults.
            changes: values of further names.
        """
        shared = cls.model_fields.keys() & type(other).model_fields.keys() - {"strategy", *without}
        return cls().model_copy(update={name: getattr(other, name) for name in shared} | changes)

    @classmethod
    def unknown_tag(cls, word: str) -> str:
        """Which plug-in would have it, if it could be loaded."""
        strategies = resolve_name("orchestrator.strategies.doors:STRATEGIES")
        return next((str(broken) for broken in strategies.broken if broken.name == word), "")


class CalibrationSettings(StrategySettings):
    """Settings of a calibration: which θ reproduces the weighed spills."""

    has_prior: ClassVar[bool] = False
    """Whether it averages over a prior of actions, so that `actions` may have one."""

    def settled(self, searched: tuple[str, ...], train: int, complaints: Complaints) -> Self | None:
        """The settings with every number filled in; what is wrong is complained of, and then there are none.

        Args:
            searched: names of the searched θ.
            train: pours that a θ can be simulated on; 0 where that is not known, because something else is wrong.
        """
        return self

    @property
    def makes_posterior(self) -> bool:
        """Whether its result has draws of θ given the pours."""
        return False

    @abstractmethod
    def simulations_on(self, train: int) -> int:
        """Single simulated pours that it may spend on so many training pours."""

    @abstractmethod
    def build(self, plan: CalibrationPlan, pours: Sequence[MeasuredPour], seed: int) -> Strategy:
        """The strategy itself."""


@dataclass(frozen=True)
class Premises:
    """What of a deployment its settings may be checked against.

    Attributes:
        actions: that are searched; None where something is wrong with them.
        objectives: whether there are objectives in place of a loss.
    """

    actions: Space | None
    objectives: bool


class DeploymentSettings(StrategySettings):
    """Settings of a deployment: how to pour into vessels that calibration never saw."""

    learns_on_pours: ClassVar[bool] = True
    """Whether real pours, also those of before, enter what it knows; if not, it may also only plan (`pours: 0`)."""

    simulates: ClassVar[bool] = True
    """Whether θ matters to it."""

    pours: PourCount | None = None
    """Real pours per receiver."""

    noise: Literal["constant", "varying"] = "constant"
    """Scatter of a pour: the same everywhere, or varying with the action where at least 20 observations show it."""

    on_failed_pour: Literal["penalise", "ignore"] = "penalise"
    """How a failed pour enters the data."""

    def check(self, premises: Premises, complaints: Complaints) -> None:
        """Complain of what does not make sense together."""
        if not self.learns_on_pours:
            return
        if self.pours is None:
            complaints.add(
                f"key 'pours' is missing; {self.strategy} learns on real pours, add for example 'pours: 15'",
                key=True,
                of="pours",
            )
        elif self.pours == 0:
            complaints.add(f"{self.strategy} learns on real pours; at least 1 (D1 plans without any)", "pours")

    @property
    def order(self) -> Order:
        """The order in which outcomes are told: 'completion' only where the clock takes part in the decisions."""
        return "logical"

    @property
    def needs_posterior(self) -> bool:
        """Whether it plans with draws of θ given the pours of a calibration."""
        return False

    @property
    def learns_of_benches(self) -> bool:
        """Whether it goes by what calibration, or pours into another receiver, said about the bench."""
        return False

    def draws(self, plan: DeploymentPlan, parameters: SimulationParameters, count: int, seed: int) -> Sequence[Draw]:
        """Ways in which what it recommends may go otherwise than planned, for a prediction; none: as planned."""
        return ()

    @property
    def simulations(self) -> int:
        """Simulations that it makes into one receiver, at most."""
        return 0

    @property
    def simulations_before(self) -> int:
        """Those of them before the first pour."""
        return self.simulations

    @property
    def simulations_beside(self) -> int:
        """Those beside every pour."""
        return 0

    @property
    def spending(self) -> str:
        """What it spends into one receiver, in words."""
        return f"{self.pours} pours"

    @abstractmethod
    def build(self, plan: DeploymentPlan, scene: Scene, parameters: SimulationParameters, seed: int) -> Strategy:
        """The strategy itself."""
