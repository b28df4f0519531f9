"""A single pour with an action that the user chooses.

`OnePour` requests the pour; `OnePoured` is its result. It neither simulates nor repeats a failed pour.
"""

from __future__ import annotations

from typing import Literal

from orchestrator.requests import Decision, Failed, Outcome, Pour, Poured, Request, Slots
from orchestrator.strategies.stage_result import ResultPart, StageResult
from orchestrator.strategies.strategy import Progress
from orchestrator.strategies.trials import SeedStream
from sim_engine.action import Action
from sim_engine.outcome import PourMeasurement, normalised_spillage
from sim_engine.scene import Scene


class WeighedPour(ResultPart):
    """Weights and derived quantities of a pour."""

    loaded: float
    """Mass in the pourer before the pour [kg]."""

    spilled: float
    """Mass outside the receiver [kg]."""

    retained: float
    """Mass left in the pourer [kg]."""

    delivered_g: float
    """Mass in the receiver [g]: neither spilled nor left in the pourer."""

    delivered_ml: float
    """The same as a volume [ml], from the liquid's density."""

    poured_fraction: float
    """Fraction of the load that left the pourer."""

    spillage: float | None
    """r = spilled / poured; None below 5 % poured, where it is undefined."""


class OnePoured(StageResult):
    """Result of a single pour with a user's action."""

    kind: Literal["pour"] = "pour"

    weighed: WeighedPour | None = None
    """The weights; None before the weighing and after a failure."""

    failed: str | None = None
    """Reason why there are no weights."""


class OnePour:
    """Pour once and keep the weights.

    Args:
        scene: scene to pour in.
        action: action of the pour.
        seed: seed of a virtual bench's random numbers.
    """

    def __init__(self, scene: Scene, action: Action, seed: int) -> None:
        self._request = Pour(scene.name, action, 1, SeedStream(seed, "one pour").next())
        self._liquid = scene.liquid
        self._asked = False
        self._outcome: PourMeasurement | Failed | None = None
        self.decisions = [Decision(f"one pour, as it was asked for: {action.display()}")]

    @property
    def finished(self) -> bool:
        """The pour has been made or has failed."""
        return self._outcome is not None

    def ask(self, slots: Slots) -> list[Request]:
        """Return the pour, once."""
        if self._asked or slots.pours < 1:
            return []
        self._asked = True
        return [self._request]

    def tell(self, request: Request, outcome: Outcome) -> None:
        """Record the outcome of the pour.

        Raises:
            ValueError: the pour was not requested.
        """
        if request != self._request or not self._asked:
            raise ValueError(f"this pour was not asked for: {request}")
        match outcome:
            case Poured(measurement):
                self._outcome = measurement
            case Failed():
                self._outcome = outcome
            case _:
                raise ValueError(f"a pour can't be answered by {type(outcome).__name__}")

    def progress(self) -> Progress:
        """Pours done, and their total number."""
        return Progress(pours=int(self.finished), of_pours=1)

    def result(self) -> OnePoured:
        """The weights, or the reason why there are none."""
        match self._outcome:
            case PourMeasurement() as measured:
                fractions = measured.fractions
                weighed = WeighedPour(
                    loaded=measured.loaded,
                    spilled=measured.spilled,
                    retained=measured.retained,
                    delivered_g=1e3 * measured.delivered,
                    delivered_ml=self._liquid.millilitres(measured.delivered),
                    poured_fraction=fractions.poured,
                    spillage=normalised_spillage(fractions),
                )
                return OnePoured(weighed=weighed)
            case Failed(kind, reason):
                return OnePoured(failed=f"{kind}: {reason}")
        return OnePoured()
