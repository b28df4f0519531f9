"""Wanted amounts, one after the other: the strategy of `decant dose`.

`Dispense` requests one pour with a `DoseTarget` for each amount; `Dispensed` is its result. A dose that failed is not
repeated, and the next one is requested.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

from actors.interfaces import DoseTarget
from orchestrator.requests import Decision, Failed, Outcome, Pour, Poured, Request, Slots
from orchestrator.strategies.stage_result import ResultPart, StageResult
from orchestrator.strategies.strategy import Progress
from orchestrator.strategies.trials import SeedStream
from sim_engine.action import Action
from sim_engine.scene import Scene

DOSE = "dose"
"""Purpose of these pours."""


class DoseSignals(ResultPart):
    """Signals of a dose; empty where the bench reports none."""

    times: tuple[float, ...] = ()
    """Times of the tilt from the first motion [s]."""

    tilt_deg: tuple[float, ...] = ()
    """Tilt of the pourer [deg]."""

    read_at: tuple[float, ...] = ()
    """Times of the readings [s]."""

    readings_g: tuple[float, ...] = ()
    """Readings of the balance, without the receiver [g]."""


class Dose(ResultPart):
    """One dose."""

    number: int
    """Number of the dose, from 1."""

    wanted_g: float
    """Wanted amount [g]."""

    received_g: float | None
    """Amount weighed in the receiver [g]; None if it is unknown."""

    spilled_g: float | None
    """Mass outside the receiver [g]; None if it is unknown."""

    duration_s: float | None
    """Time from the first motion until it was weighed [s]."""

    end: str
    """How the dose ended, or why it failed."""

    signals: DoseSignals = DoseSignals()
    """Signals over time."""


class Dispensed(StageResult):
    """Results of a series of doses."""

    kind: Literal["doses"] = "doses"

    scene: str
    """Name of the scene."""

    doses: tuple[Dose, ...]
    """Completed doses, in the order made."""


class Dispense:
    """Pour amounts, one after the other.

    Args:
        scene: scene to pour in.
        action: place of the pourer, and range of the tilt.
        doses: wanted amounts, in order.
        seed: seed of a virtual bench's random numbers.
    """

    def __init__(self, scene: Scene, action: Action, doses: Sequence[DoseTarget], seed: int) -> None:
        self._scene, self._action, self._targets = scene, action, tuple(doses)
        self._seeds = SeedStream(seed, f"dispense {scene.name}")
        self._pouring: Pour | None = None
        self._doses: list[Dose] = []
        self.decisions: list[Decision] = []

    @property
    def finished(self) -> bool:
        """Whether all doses are completed."""
        return len(self._doses) == len(self._targets)

    def ask(self, slots: Slots) -> list[Request]:
        """Return the next dose, if none is running."""
        if self.finished or self._pouring is not None or slots.pours < 1:
            return []
        number = len(self._doses) + 1
        target = self._targets[number - 1]
        self._pouring = Pour(self._scene.name, self._action, number, self._seeds.next(), purpose=DOSE, dose=target)
        self.decisions.append(Decision(f"dose {number}/{len(self._targets)}: {1e3 * target.amount:g} g"))
        return [self._pouring]

    def tell(self, request: Request, outcome: Outcome) -> None:
        """Record the outcome of a dose.

        Raises:
            ValueError: the dose was not requested, or has another kind of outcome.
        """
        pour = self._pouring
        if pour is None or request != pour:
            raise ValueError(f"this dose was not asked for: {request}")
        assert pour.dose is not None
        self._pouring = None
        wanted = 1e3 * pour.dose.amount
        match outcome:
            case Poured(measured):
                about: dict[str, Any] = measured.notes.get(DOSE, {})
                self._doses.append(
                    Dose(
                        number=pour.number,
                        wanted_g=wanted,
                        received_g=1e3 * float(about.get("received", measured.delivered)),
                        spilled_g=1e3 * measured.spilled,
                        duration_s=about.get("duration"),
                        end=str(about.get("end", "")),
                        signals=DoseSignals(**{name: about.get(name, ()) for name in DoseSignals.model_fields}),
                    )
                )
            case Failed(kind, reason):
                self._doses.append(
                    Dose(
                        number=pour.number,
                        wanted_g=wanted,
                        received_g=None,
                        spilled_g=None,
                        duration_s=None,
                        end=f"{kind}: {reason}",
                    )
                )
            case _:
                raise ValueError(f"a dose can't be answered by {type(outcome).__name__}")

    def progress(self) -> Progress:
        """Doses made, and their total number."""
        return Progress(pours=len(self._doses), of_pours=len(self._targets))

    def result(self) -> Dispensed:
        """The doses so far."""
        return Dispensed(scene=self._scene.name, doses=tuple(self._doses))
