"""Confirmation: repetitions of the action that a deployment recommends, independent of its selection.

`Confirmation` requests the pours; `Confirmed` is its result. It does not change the recommendation.
"""

from __future__ import annotations

from typing import Literal

from orchestrator.requests import Decision, Failed, Outcome, Pour, Poured, Prediction, Request, Slots
from orchestrator.strategies.deployment.costing import Costing
from orchestrator.strategies.deployment.deployment_result import Recommended
from orchestrator.strategies.stage_result import ResultPart, StageResult
from orchestrator.strategies.strategy import Progress, is_sound
from orchestrator.strategies.trials import SeedStream
from sim_engine.outcome import normalised_spillage
from sim_engine.prediction_band import SampleStatistics

PURPOSE = "confirm"
"""Purpose of these pours."""


class ConfirmingPour(ResultPart):
    """A pour of the recommended action."""

    number: int
    """Number of the pour, from 1."""

    failed: str
    """Reason why nothing was weighed; '' if it was weighed."""

    loss: float | None
    """Loss in its own unit; None if nothing was weighed."""

    spillage: float | None
    """r = spilled / poured; None below 5 % poured, and if nothing was weighed."""

    delivered_g: float | None
    """Mass in the receiver [g]."""

    delivered_ml: float | None
    """The same as a volume [ml], from the liquid's density."""


class Confirmed(StageResult):
    """Losses of the recommended action, without the bias of its selection."""

    kind: Literal["confirmation"] = "confirmation"

    scene: str
    """Name of the scene."""

    pours: tuple[ConfirmingPour, ...]
    """All completed pours, in the order made."""

    loss: SampleStatistics | None
    """Mean and scatter of the weighed pours; None without any."""

    delivered_g: SampleStatistics | None
    """Mean and scatter of the mass in the receiver [g]."""

    delivered_ml: float | None
    """Mean volume in the receiver [ml], from the liquid's density."""


class Confirmation:
    """Repeat the pour that a deployment recommends.

    The smallest of several measured losses is biased low. Pours after the selection give an unbiased estimate of the
    recommended action's loss. A failed pour is recorded as failed, and the next one is made. If the action is refused,
    no further pour is made.
    """

    def __init__(self, costing: Costing, recommended: Recommended | None, count: int, seed: int) -> None:
        """Plan the pours.

        Args:
            costing: scene and loss of the deployment.
            recommended: the recommendation; with None, nothing is poured.
            count: number of pours.
            seed: seed of a virtual bench's random numbers.
        """
        self._costing = costing
        self._recommended = recommended
        self._count = 0 if recommended is None else count
        self._seeds = SeedStream(seed, f"confirm {costing.scene.name}")
        self._pouring: Pour | None = None
        self._pours: list[ConfirmingPour] = []
        self.decisions: list[Decision] = []
        if recommended is None:
            self.decisions.append(Decision("nothing was recommended, so that there is nothing to confirm"))

    @property
    def finished(self) -> bool:
        """Whether all pours are completed."""
        return len(self._pours) >= self._count

    def ask(self, slots: Slots) -> list[Request]:
        """Return the next pour, if none is running."""
        recommended = self._recommended
        if recommended is None or self.finished or self._pouring is not None or slots.pours < 1:
            return []
        predicted = Prediction(
            recommended.predicted_loss, recommended.predicted_deviation, recommended.predicted_scatter
        )
        action, number = self._costing.scene.action(dict(recommended.action_si)), len(self._pours) + 1
        self._pouring = Pour(self._costing.scene.name, action, number, self._seeds.next(), predicted, PURPOSE)
        self.decisions.append(Decision(f"confirm {number}/{self._count} what is recommended"))
        return [self._pouring]

    def tell(self, request: Request, outcome: Outcome) -> None:
        """Record the outcome of a pour.

        Raises:
            ValueError: the pour was not requested.
        """
        pour = self._pouring
        if pour is None or request != pour:
            raise ValueError(f"this pour was not asked for: {request}")
        self._pouring = None
        failed, loss, spillage, delivered = "", None, None, None
        match outcome:
            case Poured(measurement) if is_sound(measurement.fractions):
                loss = self._costing.total(self._costing.poured(measurement, pour.action))
                spillage, delivered = normalised_spillage(measurement.fractions), measurement.delivered
            case Poured():
                failed = "weighing: the balance gave no numbers"
            case Failed(kind, reason):
                failed = f"{kind}: {reason}"
                if kind == "invalid_action":
                    self._count = len(self._pours) + 1  # it would be refused again
            case _:
                raise ValueError(f"a pour can't be answered by {type(outcome).__name__}")
        self._pours.append(
            ConfirmingPour(
                number=pour.number,
                failed=failed,
                loss=loss,
                spillage=spillage,
                delivered_g=None if delivered is None else 1e3 * delivered,
                delivered_ml=None if delivered is None else self._costing.scene.liquid.millilitres(delivered),
            )
        )

    def progress(self) -> Progress:
        """Pours made, and their total number."""
        return Progress(pours=len(self._pours), of_pours=self._count)

    def result(self) -> Confirmed:
        """Outcomes of the pours so far."""
        weighed = [pour for pour in self._pours if not pour.failed]
        volume = SampleStatistics.of([pour.delivered_ml for pour in weighed if pour.delivered_ml is not None])
        return Confirmed(
            scene=self._costing.scene.name,
            pours=tuple(self._pours),
            loss=SampleStatistics.of([pour.loss for pour in weighed if pour.loss is not None]),
            delivered_g=SampleStatistics.of([pour.delivered_g for pour in weighed if pour.delivered_g is not None]),
            delivered_ml=None if volume is None else volume.mean,
        )
