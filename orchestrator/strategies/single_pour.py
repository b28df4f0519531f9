"""A single pour that a person has chosen."""

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
    """What the balance said of a pour."""

    loaded: float
    """Mass in the pourer before [kg]."""

    spilled: float
    """Mass beside the receiver [kg]."""

    retained: float
    """Mass left in the pourer [kg]."""

    delivered_g: float
    """In the receiver: what is neither beside it nor left in the pourer."""

    delivered_ml: float
    """The same by the liquid's density."""

    poured_fraction: float
    """Share of the load that left the pourer."""

    spillage: float | None
    """r = spilled / poured; None below 5 % poured, where it is undefined."""


class OnePoured(StageResult):
    """A single pour that a person has chosen."""

    kind: Literal["pour"] = "pour"

    weighed: WeighedPour | None = None
    """None before it was weighed, or where it failed."""

    failed: str | None = None
    """Why nothing was weighed."""


class OnePour:
    """Pour once, and keep what was weighed.

    Args:
        scene: to pour in.
        action: how.
        seed: of a virtual bench's chance.
    """

    def __init__(self, scene: Scene, action: Action, seed: int) -> None:
        self._request = Pour(scene.name, action, 1, SeedStream(seed, "one pour").next())
        self._liquid = scene.liquid
        self._asked = False
        self._outcome: PourMeasurement | Failed | None = None
        self.decisions = [Decision(f"one pour, as it was asked for: {action.display()}")]

    @property
    def finished(self) -> bool:
        """It was poured, or came to nothing."""
        return self._outcome is not None

    def ask(self, slots: Slots) -> list[Request]:
        """The pour, once."""
        if self._asked or slots.pours < 1:
            return []
        self._asked = True
        return [self._request]

    def tell(self, request: Request, outcome: Outcome) -> None:
        """What came of it.

        Raises:
            ValueError: it was not asked for.
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
        """Pours done, pours in all."""
        return Progress(pours=int(self.finished), of_pours=1)

    def result(self) -> OnePoured:
        """What was weighed, or why there is nothing."""
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
