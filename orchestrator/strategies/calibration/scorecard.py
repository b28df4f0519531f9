"""The calibrated θ beside its rivals: what calibration was worth."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from orchestrator.plan import MeasuredPour
from orchestrator.requests import Decision, Outcome, Request, Simulate, Slots
from orchestrator.strategies.calibration.baselines import mean_predictor_discrepancy, regression_discrepancy
from orchestrator.strategies.calibration.contexts import Contexts
from orchestrator.strategies.calibration.evaluation import Evaluation, ScoredPour, Scores
from orchestrator.strategies.progress import Progress
from sim_engine.bands import left_over
from sim_engine.liquid import SimulationParameters

BySplit = dict[str, float | None]

CALIBRATED = "theta"
"""Label of θ* in the results."""

DRAWS = 5
"""θ of the posterior whose simulations' mean is scored beside θ*."""

UNCALIBRATED = "uncalibrated"
"""Label of the θ that one would take without calibrating."""


def shift_left_over(scores: Scores, fitted: int) -> float | None:
    """What θ* left over of the training pours, as a shift (`sim_engine.bands`).

    Args:
        scores: of a scorecard.
        fitted: number of parameters that were searched.
    """
    pairs = [
        (pair.measured, pair.simulated)
        for pair in scores.pairs
        if pair.theta == CALIBRATED and pair.split == "train"
        if pair.measured is not None and pair.simulated is not None
    ]
    return left_over(pairs, fitted)


class Scorecard:
    """Score θ* on all weighed pours, and its rivals on those that calibration did not see.

    The rivals are the uncalibrated θ, random θ from the same box (their median), the mean of the training pours, and a
    GP regression of the training pours. The regression is judged in the calibration's scene only: of another vessel it
    knows nothing. Random θ are not simulated on training pours, where nothing is to be won by it; the uncalibrated one
    is, for it has seen no pour at all. Beside θ* stands what bands are made of: the mean of the simulations over draws
    of its posterior, where there is one.
    """

    def __init__(
        self,
        theta: SimulationParameters,
        random_thetas: Mapping[str, SimulationParameters],
        pours: Sequence[ScoredPour],
        contexts: Contexts,
        seed: int,
        *,
        uncalibrated: SimulationParameters | None = None,
        drawn: Sequence[SimulationParameters] = (),
    ) -> None:
        """Plan.

        Args:
            random_thetas: by label, 'random 1' … .
            pours: of the splits 'train', 'test' and 'transfer'.
            contexts: in which the regression lives.
            uncalibrated: θ that one would take without calibrating; None, or θ* itself, is not scored.
            drawn: of θ's posterior.
        """
        unseen = [scored for scored in pours if scored.pour.split != "train"]
        train = [scored for scored in pours if scored.pour.split == "train"]
        # The unseen come first in both, so that θ* and random θ meet the same seeds on them.
        self._parts = [
            Evaluation({CALIBRATED: theta}, [*unseen, *train], seed),
            Evaluation(random_thetas, unseen, seed),
        ]
        if uncalibrated is not None and uncalibrated != theta:
            self._parts.append(Evaluation({UNCALIBRATED: uncalibrated}, [*unseen, *train], seed))
        if drawn:  # with other seeds: a draw may be θ* itself
            draws = {f"posterior {k}": theta for k, theta in enumerate(drawn, 1)}
            self._parts.append(Evaluation(draws, unseen, seed + 1))
        self._owner: dict[Simulate, Evaluation] = {}
        self._contexts = contexts
        self._pours: dict[str, list[MeasuredPour]] = {}
        for scored in pours:
            self._pours.setdefault(scored.pour.split, []).append(scored.pour)
        self._baselines: tuple[BySplit, BySplit] | None = None

    @property
    def finished(self) -> bool:
        """Every simulation has been answered."""
        return all(part.finished for part in self._parts)

    @property
    def decisions(self) -> list[Decision]:
        """Why these simulations."""
        return [decision for part in self._parts for decision in part.decisions]

    def ask(self, slots: Slots) -> list[Request]:
        """The next simulations, θ* first."""
        requests: list[Request] = []
        for part in self._parts:
            asked = part.ask(Slots(slots.simulations - len(requests), 0))
            self._owner.update({request: part for request in asked if isinstance(request, Simulate)})
            requests += asked
        return requests

    def tell(self, request: Request, outcome: Outcome) -> None:
        """What came of a simulation. Raises ValueError if it was not asked for."""
        part = self._owner.get(request) if isinstance(request, Simulate) else None
        if part is None:
            raise ValueError(f"this simulation was not asked for: {request}")
        part.tell(request, outcome)

    def progress(self) -> Progress:
        """Simulations answered, simulations in all."""
        return sum((part.progress() for part in self._parts), Progress())

    def result(self) -> Scores:
        """Mean |r − c_s| by label and split, the random θ's median by split, and the rivals without a simulator."""
        parts = [part.result() for part in self._parts]
        mean_predictor, regression = self._without_simulator() if self.finished else ({}, {})
        return Scores(
            simulations=sum(part.simulations for part in parts),
            undefined={label: count for part in parts for label, count in part.undefined.items()},
            discrepancy={label: scores for part in parts for label, scores in part.discrepancy.items()},
            random_median=parts[1].random_median,
            posterior_mean=parts[-1].posterior_mean,
            thetas={label: theta for part in parts for label, theta in part.thetas.items()},
            pairs=tuple(pair for part in parts for pair in part.pairs),
            mean_predictor=mean_predictor,
            regression=regression,
        )

    def _without_simulator(self) -> tuple[BySplit, BySplit]:
        """What the mean predictor and the regression come to; worked out once."""
        if self._baselines is None:
            train = self._pours.get("train", [])
            unseen = {split: pours for split, pours in self._pours.items() if split != "train"}
            test = {split: pours for split, pours in unseen.items() if split == "test"}
            self._baselines = (
                {split: mean_predictor_discrepancy(train, pours) for split, pours in unseen.items()},
                {split: regression_discrepancy(self._contexts, train, pours) for split, pours in test.items()},
            )
        return self._baselines
