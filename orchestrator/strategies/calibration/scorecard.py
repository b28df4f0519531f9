"""The calibrated θ beside its rivals: what calibration was worth."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from statistics import fmean, stdev

from orchestrator.plan import MeasuredPour
from orchestrator.requests import Decision, Outcome, Request, Simulate, Slots
from orchestrator.strategies.calibration.baselines import mean_predictor_discrepancy, regression_discrepancy
from orchestrator.strategies.calibration.contexts import Contexts
from orchestrator.strategies.calibration.evaluation import CalibrationGain, Evaluation, ScoredPair, ScoredPour, Scores
from orchestrator.strategies.calibration.o1 import LEAST_DEFINED
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

JUSTIFIED = "the weighed pours justify θ*"
NOT_JUSTIFIED = "the weighed pours do not justify a change of parameters; the uncalibrated ones are recommended"
"""How the sentence about the gain of a calibration begins."""


STANDARD_ERRORS = 1.0
"""Standard errors of the mean paired difference that the gain of θ* must exceed for θ* to be recommended."""


def calibration_gain(calibrated: Sequence[ScoredPair], uncalibrated: Sequence[ScoredPair]) -> CalibrationGain:
    """Whether weighed pours justify θ* instead of the uncalibrated θ.

    θ* is recommended if its mean |r − c_s| is smaller by more than one standard error of the paired difference. A θ
    that is defined on fewer than half of the pours is never recommended if the other one is defined on enough of them.

    Args:
        calibrated: pairs of θ*, one for each pour.
        uncalibrated: those of the uncalibrated θ: the same pours in the same order, with the same seeds.

    Source: the one-standard-error rule of Breiman, Friedman, Olshen and Stone, Classification and Regression Trees,
    1984, section 3.4.3: of models whose errors differ by less than a standard error the simplest one is chosen.
    Limitations: θ* was fitted to the training pours, which favours it; pours of similar actions count as independent.
    """
    both = [
        (abs(a.measured - a.simulated), abs(a.measured - b.simulated))
        for a, b in zip(calibrated, uncalibrated, strict=True)
        if a.measured is not None and a.simulated is not None and b.simulated is not None
    ]
    gains = [plain - fitted for fitted, plain in both]
    gain = fmean(gains) if gains else None
    error = stdev(gains) / math.sqrt(len(gains)) if len(gains) > 1 else None
    fitted, plain = (fmean(values) if both else None for values in (zip(*both, strict=True) if both else ((), ())))
    count, least = len(calibrated), LEAST_DEFINED * len(calibrated)
    known = [sum(pair.simulated is not None for pair in pairs) for pairs in (calibrated, uncalibrated)]
    if min(known) < least <= max(known):
        justified = known[0] >= least
        name = "the uncalibrated parameters" if justified else "θ*"
        why = f"with {name} only {min(known)} of {count} pours have a simulated spillage"
    elif fitted is None or plain is None or gain is None or error is None:
        justified, why = False, "fewer than two pours could be compared"
    else:
        justified = gain > STANDARD_ERRORS * error
        why = (
            f"mean |Δ| of {len(both)} pours {100 * fitted:.2f} % with θ*, {100 * plain:.2f} % with the uncalibrated "
            f"parameters; gain {100 * gain:.2f} ± {100 * error:.2f} points (± standard error)"
        )
    return CalibrationGain(
        pours=count,
        pairs=len(both),
        calibrated=fitted,
        uncalibrated=plain,
        gain=gain,
        gain_error=error,
        recommended="calibrated" if justified else "uncalibrated",
        text=f"{JUSTIFIED if justified else NOT_JUSTIFIED}: {why}",
    )


def recommended_theta(theta: SimulationParameters, scores: Scores | None) -> SimulationParameters:
    """θ to simulate with from now on: θ*, or the uncalibrated θ if the weighed pours do not justify θ*.

    Args:
        theta: θ*.
        scores: of a scorecard; None, or one of an older version without a comparison: θ*.
    """
    plain = scores is not None and scores.gain is not None and scores.gain.recommended == UNCALIBRATED
    return scores.thetas[UNCALIBRATED] if plain and scores is not None else theta


def shift_left_over(scores: Scores, fitted: int) -> float | None:
    """What the recommended θ left over of the training pours, as a shift (`sim_engine.bands`).

    Args:
        scores: of a scorecard.
        fitted: number of parameters that were searched.
    """
    plain = scores.gain is not None and scores.gain.recommended == UNCALIBRATED
    pairs = [
        (pair.measured, pair.simulated)
        for pair in scores.pairs
        if pair.theta == (UNCALIBRATED if plain else CALIBRATED) and pair.split == "train"
        if pair.measured is not None and pair.simulated is not None
    ]
    return left_over(pairs, 0 if plain else fitted)


class Scorecard:
    """Score θ* on all weighed pours, and its rivals on those that calibration did not see.

    The rivals are the uncalibrated θ, random θ from the same box (their median), the mean of the training pours, and a
    GP regression of the training pours. The regression is judged in the calibration's scene only: of another vessel it
    knows nothing. Random θ are not simulated on training pours, where nothing is to be won by it; the uncalibrated one
    is, for it has seen no pour at all, and on the training and test pours it decides whether θ* is recommended
    (`calibration_gain`). Beside θ* stands what bands are made of: the mean of the simulations over draws of its
    posterior, where there is one.
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
        self._calibrated = Evaluation({CALIBRATED: theta}, [*unseen, *train], seed)
        self._parts = [self._calibrated, Evaluation(random_thetas, unseen, seed)]
        self._uncalibrated: Evaluation | None = None
        if uncalibrated is not None and uncalibrated != theta:
            self._uncalibrated = Evaluation({UNCALIBRATED: uncalibrated}, [*unseen, *train], seed)
            self._parts.append(self._uncalibrated)
        if drawn:  # with other seeds: a draw may be θ* itself
            draws = {f"posterior {k}": theta for k, theta in enumerate(drawn, 1)}
            self._parts.append(Evaluation(draws, unseen, seed + 1))
        self._owner: dict[Simulate, Evaluation] = {}
        self._contexts = contexts
        self._pours: dict[str, list[MeasuredPour]] = {}
        for scored in pours:
            self._pours.setdefault(scored.pour.split, []).append(scored.pour)
        self._baselines: tuple[BySplit, BySplit] | None = None
        self._gain: CalibrationGain | None = None

    @property
    def finished(self) -> bool:
        """Every simulation has been answered."""
        return all(part.finished for part in self._parts)

    @property
    def decisions(self) -> list[Decision]:
        """Why these simulations; at the end which θ is recommended."""
        decisions = [decision for part in self._parts for decision in part.decisions]
        if self._gain is not None:
            numbers = {"gain": self._gain.gain, "gain_error": self._gain.gain_error}
            known = {name: value for name, value in numbers.items() if value is not None}
            decisions.append(Decision(self._gain.text, known))
        return decisions

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
        if self.finished and self._uncalibrated is not None:
            judged = [
                [pair for pair in one.result().pairs if pair.split != "transfer"]
                for one in (self._calibrated, self._uncalibrated)
            ]
            self._gain = calibration_gain(*judged)

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
            gain=self._gain,
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
