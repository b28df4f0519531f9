"""Result of a deployment: the same class for D1, D2 and D3, with optional parts."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

from actors.optimizer.questions import Suggestion
from orchestrator.learning.deployment.model_monitoring import Believed, BenchFound
from orchestrator.learning.deployment.real_pours import DeploymentRow, PredictionCheck
from orchestrator.learning.stage_result import DisplayedMap, ResultPart, StageResult, displayed_action
from sim_engine.prediction_band import SampleStatistics
from sim_engine.search_space import Space


class Recommended(ResultPart):
    """The recommended action with its prediction."""

    action: dict[str, float | None]
    """Searched dimensions in display units."""

    action_si: dict[str, float]
    """The same in SI."""

    predicted_loss: float
    """Expected loss, in its own unit."""

    predicted_deviation: float
    """Standard deviation of the expected loss."""

    predicted_scatter: float | None
    """Scatter of a single pour around it; None if unknown."""

    predicted_spillage: float | None = None
    """D1: mean r = spilled / poured of its simulations, whose seeds took part in choosing it."""

    predicted_spillage_deviation: float | None = None
    """D1: standard deviation of r = spilled / poured over these seeds."""

    hyperparameters: dict[str, float] | None = None
    """Those of the surrogate."""

    equal_ranges: dict[str, tuple[float, float]] | None = None
    """Ends of the ranges in which the expected loss is as small [SI], one dimension changed at a time."""

    @classmethod
    def of(
        cls, final: Suggestion, actions: Space, scatter: float | None, spillage: SampleStatistics | None
    ) -> Recommended | None:
        """The recommendation of the last answer; None if there is none.

        Args:
            final: the answer.
            actions: space that was searched.
            scatter: of a single pour.
            spillage: r of its simulations, if they are recorded.
        """
        if final.best_point is None or final.best_mean is None or final.best_deviation is None:
            return None
        values = actions.decode(final.best_point)
        return cls(
            action=displayed_action(values),
            action_si=values,
            predicted_loss=final.best_mean,
            predicted_deviation=final.best_deviation,
            predicted_scatter=scatter,
            predicted_spillage=None if spillage is None else spillage.mean,
            predicted_spillage_deviation=None if spillage is None else spillage.deviation,
            hyperparameters=final.hyperparameters,
            equal_ranges=None
            if final.equal_ranges is None
            else {
                axis.name: (axis.decode(low), axis.decode(high))
                for axis, (low, high) in zip(actions.axes, final.equal_ranges, strict=True)
            },
        )


class SimulatedAction(ResultPart):
    """A simulated action with its loss."""

    action_si: dict[str, float]
    """Searched dimensions [SI]."""

    loss: float
    """Mean over its simulations, in the unit of the loss."""


# More than 20 fields: its JSON is in journals, and keeps its form.
class Deployed(StageResult):
    """Result of a deployment in one scene."""

    kind: Literal["deployment"] = "deployment"

    strategy: str
    """'D1' to 'D3', or the name of another strategy."""

    scene: str
    """Name of the scene."""

    loss: str
    """Name of the minimised loss."""

    simulations: int
    """Number of simulations with an answer."""

    simulations_lost: int
    """Number of answered simulations that could not be used."""

    simulations_refused: int
    """Number of actions refused before the simulation."""

    pours: tuple[DeploymentRow, ...]
    """All completed pours, in the order made."""

    simulated: tuple[SimulatedAction, ...]
    """Actions whose simulations yielded a loss, in request order."""

    former_pours: int
    """Number of pours from before the campaign among the data."""

    refused_pours: int
    """Number of pours refused before anything moved."""

    failed_pours: int
    """Number of failed pours."""

    model_check: PredictionCheck | Believed
    """Deviation of the first pours from their predictions, or the conclusions of all pours about the simulator."""

    gave_up: str | None = None
    """Reason of an early end, after too many refusals."""

    ended: str | None = None
    """Reason of an end before all pours were made: no further gain, or a limit."""

    bench: BenchFound | None = None
    """Deviation of the bench from the simulator, for the next receiver."""

    map: DisplayedMap | None = None
    """The loss over the two most important dimensions."""

    recommended: Recommended | None = None
    """The recommended action; None before the end, and without any usable outcome."""

    @property
    def weighed(self) -> Sequence[DeploymentRow]:
        """Weighed pours with a loss."""
        return [pour for pour in self.pours if pour.status == "weighed" and pour.loss is not None]

    @property
    def best(self) -> DeploymentRow | None:
        """The pour with the least loss."""
        return min(self.weighed, key=lambda pour: pour.loss or 0.0, default=None)
