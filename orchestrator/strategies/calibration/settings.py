"""What the settings of calibrations share: how many θ are tried, and whether that fits what they may spend."""

from __future__ import annotations

from abc import abstractmethod
from typing import Annotated, ClassVar, Self

from orchestrator.config.yaml.quantities import Quantity
from orchestrator.config.yaml.sections import MOST_SIMULATIONS, Complaints, PositiveSimulationCount
from orchestrator.strategies.settings import CalibrationSettings

Kappa = Annotated[float, Quantity("1", "2.0", 0.0, 100.0)]
"""κ of the lower confidence bound."""


class DesignSettings(CalibrationSettings):
    """Settings of C1, C2 and C3: so many θ, each simulated on all training pours.

    A number of θ is wanted; `simulations` is a limit to it, or alone says how many θ there are.
    """

    examples: ClassVar[dict[str, str]] = {}
    """Keys that say how many θ are tried, each with an example; the last one is asked for where all are missing."""

    simulations: PositiveSimulationCount | None = None
    """Single simulated pours: a limit, or, alone, all that says how many θ are tried."""

    @property
    @abstractmethod
    def thetas(self) -> int:
        """How many θ are tried, once settled."""

    @abstractmethod
    def with_thetas(self, searched: tuple[str, ...], train: int, complaints: Complaints) -> Self | None:
        """The settings with the number of θ that is given, or that `simulations` allows."""

    def simulations_on(self, train: int) -> int:
        """Each θ on all of them."""
        return self.thetas * train

    def settled(self, searched: tuple[str, ...], train: int, complaints: Complaints) -> Self | None:
        """The number of θ, from the one key that says it."""
        given = [key for key in self.examples if getattr(self, key) is not None]
        if len(given) > 1:
            complaints.add(f"stands beside '{given[0]}'; keep one of them", given[1], key=True)
        if not given and self.simulations is None and not complaints.any:
            wanted, example = list(self.examples.items())[-1]
            complaints.add(f"key '{wanted}' is missing; add for example '{wanted}: {example}'", key=True, of=wanted)
        if complaints.any or train < 1 or not searched or not (given or self.simulations):
            return None
        found = self.with_thetas(searched, train, complaints)
        if found is None:
            return None
        key = given[0] if given else "simulations"
        cost, limit = found.simulations_on(train), self.simulations or MOST_SIMULATIONS
        if cost > limit:
            said = "'simulations' allows" if self.simulations is not None else "at most are possible:"
            text = f"makes {found.thetas} θ × {train} training pours = {cost} simulations; {said} {limit}"
            complaints.add(text, key)
            return None
        return found

    def _counted(self, given: int | None, train: int, complaints: Complaints) -> int | None:
        """The number that is given, or that the simulations allow."""
        if given is None and (self.simulations or 0) < train:
            text = f"allows not a single θ: each is simulated on all {train} training pours"
            complaints.add(text, "simulations")
            return None
        return (self.simulations or 0) // train if given is None else given


def check_initial(
    settings: CalibrationSettings, initial: int, budget: int, key: str, unit: str, complaints: Complaints
) -> None:
    """Random parameters must fit into the budget, which a key gives in a unit."""
    if initial > budget:
        at = "initial" if "initial" in settings.model_fields_set else key
        complaints.add(f"{initial} random parameters don't fit into {budget} {unit}", at)
