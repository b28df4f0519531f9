"""What a deployment has learnt: D1, D2 and D3 alike, with what only some of them look for."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

from actors.optimizer.questions import Suggestion
from orchestrator.strategies.deployment.model_monitoring import Believed, BenchFound
from orchestrator.strategies.deployment.real_pours import PourRow, PredictionCheck
from orchestrator.strategies.deployment.safe_window import WindowFound
from orchestrator.strategies.stage_result import DisplayedMap, ResultPart, StageResult, displayed_action
from sim_engine.prediction_band import SampleStatistics
from sim_engine.search_space import Space


class Recommended(ResultPart):
    """The action to use from now on, and what to expect of it."""

    action: dict[str, float | None]
    """Searched dimensions in display units."""

    action_si: dict[str, float]
    """The same in SI."""

    predicted_loss: float
    """Expected, in the loss' own unit."""

    predicted_deviation: float
    """How well that mean is known."""

    predicted_scatter: float | None
    """How much a single pour differs from it; None where nobody knows."""

    predicted_spillage: float | None = None
    """D1: mean r = spilled / poured of its simulations, whose seeds took part in choosing it."""

    predicted_spillage_deviation: float | None = None
    """D1: standard deviation of r over these seeds."""

    hyperparameters: dict[str, float] | None = None
    """Those of the surrogate."""

    @classmethod
    def of(
        cls, final: Suggestion, actions: Space, scatter: float | None, spillage: SampleStatistics | None
    ) -> Recommended | None:
        """What the last answer recommends; None if it does not.

        Args:
            final: the answer.
            actions: space that was searched.
            scatter: of a single pour.
            spillage: r of its simulations, where they are kept.
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
        )


class RiskFound(ResultPart):
    """What errors of execution and θ that fit do to the recommended action."""

    measure: Literal["expected", "cvar"]
    """What was minimised."""

    level: float
    """Share of the worst cases that a CVaR is the mean of."""

    value: float
    """The measure, in the loss' own unit."""

    expected: float
    """Mean over the disturbances."""

    spread: float
    """Standard deviation over them."""

    thetas: int
    """θ of a posterior among them; 0 where θ is one."""


class ParetoAction(ResultPart):
    """An action that no other one beats in all objectives."""

    action: dict[str, float | None]
    """Searched dimensions in display units."""

    action_si: dict[str, float]
    """The same in SI."""

    objectives: dict[str, float]
    """Expected, by name."""

    deviations: dict[str, float]
    """How well each is known."""


class SimulatedAction(ResultPart):
    """An action that was simulated, and what came of it."""

    action_si: dict[str, float]
    """Searched dimensions [SI]."""

    loss: float
    """Mean over its simulations, in the loss' own unit."""


class Deployed(StageResult):
    """What a deployment has learnt in one scene."""

    kind: Literal["deployment"] = "deployment"

    strategy: str
    """'D1' to 'D3', or another one's name."""

    scene: str
    """Name of the scene."""

    loss: str
    """Name of what is minimised."""

    simulations: int
    """Those that were answered."""

    simulations_lost: int
    """Those of them that could not be used."""

    simulations_refused: int
    """Actions that were refused before anything was simulated."""

    pours: tuple[PourRow, ...]
    """All that are over, in the order made."""

    simulated: tuple[SimulatedAction, ...]
    """Actions whose simulations gave a loss, in the order of asking."""

    former_pours: int
    """Pours of before the campaign that it learnt from."""

    refused_pours: int
    """Actions that were refused before anything moved."""

    failed_pours: int
    """Pours that went wrong."""

    model_check: PredictionCheck | Believed
    """How far the first pours were from what was predicted, or what all of them say of the simulator."""

    gave_up: str | None = None
    """Why it ended early."""

    ended: str | None = None
    """Why it ended before all pours were made: nothing more to gain, or a limit."""

    bench: BenchFound | None = None
    """How the bench differs from the simulator, for the next receiver."""

    objectives: tuple[str, ...] = ()
    """Names of several objectives; empty with a plain loss."""

    pareto_front: tuple[ParetoAction, ...] | None = None
    """What nothing beats, where that was looked for."""

    map: DisplayedMap | None = None
    """The loss over the two dimensions that matter most."""

    recommended: Recommended | None = None
    """None before the end, or if nothing was learnt."""

    risk: RiskFound | None = None
    """What was found where one plans under errors."""

    window: WindowFound | None = None
    """How far the recommended action may be missed, where that was asked for."""

    @property
    def weighed(self) -> Sequence[PourRow]:
        """The pours that were weighed and gave a loss."""
        return [pour for pour in self.pours if pour.status == "weighed" and pour.loss is not None]

    @property
    def best(self) -> PourRow | None:
        """The pour with the least loss."""
        return min(self.weighed, key=lambda pour: pour.loss or 0.0, default=None)
