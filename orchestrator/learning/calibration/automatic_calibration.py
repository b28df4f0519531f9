"""Calibration that ends when further simulations no longer change the posterior of θ: `simulations: auto`.

`AutomaticCalibration` is the strategy; `simulation_limit` is its largest number of simulations.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from copy import deepcopy
from dataclasses import replace

from actors.optimizer.questions import (
    CalibrationQuery,
    Data,
    Point,
    PosteriorQuestion,
    RememberedGroup,
    SpaceFillingQuery,
    Suggestion,
)
from orchestrator.learning.calibration.action_prior import Contexts
from orchestrator.learning.calibration.calibration_base import THETA_MAP_RESOLUTION, Calibrated
from orchestrator.learning.calibration.campaign_memory import log_memory, remembered_point
from orchestrator.learning.calibration.pointwise_calibration import DiscrepancyOverPours, discrepancies
from orchestrator.learning.calibration.posterior_summary import (
    left_open,
    posterior_change,
    unit_prior,
)
from orchestrator.learning.campaign_plan import CalibrationPlan, CalibrationSettings, MeasuredPour
from orchestrator.learning.requests import Decision, Outcome, Request, Simulate
from orchestrator.learning.strategy import Progress
from orchestrator.learning.trials import OptimizerQueries, Trial, Trials
from sim_engine.liquids import SimulationParameters

STARTS_PER_PARAMETER = 10
"""Space-filling θ per searched parameter before the first posterior.

Source: Loeppky, Sacks & Welch, Choosing the sample size of a computer experiment, 2009: ten per dimension."""

CANDIDATES = 4
"""Draws of the posterior that are simulated on all training pours before the next posterior."""

UNCHANGED = 0.5
"""Change of the posterior below which it counts as unchanged, in standard deviations; two samples of the same posterior
differ by about 0.1."""

WEIGHED = 0.02
"""Standard deviation of a weighed pour around the bench's mean, as a fraction of the poured liquid."""

THETAS_AT_MOST, OBSERVATIONS_AT_MOST = 50, 1_500
"""Limit of the number of θ on all training pours; and of simulations, because the surrogate takes the cube of it."""


def simulation_limit(train: int) -> int:
    """Largest number of simulations of an automatic calibration on `train` training pours."""
    return min(THETAS_AT_MOST * train, OBSERVATIONS_AT_MOST)


class AutomaticCalibration(DiscrepancyOverPours[CalibrationSettings]):
    """Simulate θ on the training pours until further simulations no longer change the posterior of θ.

    - The uncalibrated θ and space-filling θ are simulated on all training pours. These simulations depend on the
      actions alone, so that they run while the pours are made.
    - A GP of the signed differences r_i − c_s(a_i, θ) over (θ, a) yields the posterior of θ. Draws of it, and the
      minimiser of the expected mean difference, are the next candidates.
    - The candidates are simulated on all training pours. A candidate is dropped as soon as its differences add up to
      more than those of the best θ on all pours, because it cannot become the best.
    - The calibration ends when the last candidates have changed the posterior by less than `UNCHANGED`, or at
      `simulation_limit`. Clocks and the number of simulators have no influence.

    θ* is the θ with the lowest mean |r_i − c_s(a_i, θ)| of all that were simulated on every training pour. It never
    describes them worse than the uncalibrated θ, if that lies in the searched box: the evaluation repeats the same
    simulations. With a memory, half of the space-filling θ lie where it expects them, and θ* has the highest posterior
    density. The uncalibrated θ is then the expected one, which has the highest prior density, so that the same holds.

    As soon as a posterior contradicts the memory of a group, the calibration starts again without any memory, with all
    of its simulations. It then makes the same requests as a campaign without a memory, and ends with the same θ*.

    Source: candidates from the posterior on a surrogate: Wang & Li, Adaptive Gaussian process approximation for
    Bayesian inference with expensive likelihood functions, 2018.
    Limitations: the lowest of many means is biased low. With more than 75 training pours, a space-filling θ is
    simulated on a part of them. Simulations of an active design are not used.
    """

    def __init__(
        self, plan: CalibrationPlan, measured: Sequence[MeasuredPour], seed: int, *, kappa: float = 2.0
    ) -> None:
        super().__init__(plan, measured, seed)
        self._kappa = kappa
        contexts = Contexts.of(plan)
        self._places = {seed: contexts.point(pour) for seed, pour in zip(self._seed_of_pour, self._usable, strict=True)}
        self._earlier = Trials()
        self._ended: str | None = None
        self._initial_seeds = deepcopy(self._seeds)
        self._begin()

    def _begin(self) -> None:
        """Begin, or begin again after a contradiction, without a memory."""
        self._seeds = deepcopy(self._initial_seeds)
        self._questions = OptimizerQueries(self._seeds)
        self._trials = Trials(self._trials.width)
        self._posterior = None
        self._before, self._starts = 0, 0
        space = self._plan.parameters
        self._plain = (self._plan if self._memory else replace(self._plan, memory=None)).uncalibrated
        values = {axis.name: float(getattr(self._plain, axis.name)) for axis in space.axes}
        inside = all(axis.lower <= values[axis.name] <= axis.upper for axis in space.axes)
        self._plain_at: Point = tuple(map(float, space.encode(values))) if inside else ()

    # -- asking ----------------------------------------------------------------------------------------------------

    def _next(self) -> None:
        """Simulate candidates; when all are answered, query the posterior, and end or add further candidates."""
        if not self._trials.all:
            plain = (self._plain_at,) if self._plain_at else ()
            count = STARTS_PER_PARAMETER * self._plan.parameters.dimension
            query = SpaceFillingQuery(self._plan.parameters, known=plain, count=count)
            self._questions.put(query, "start", lambda suggestion: self._start(plain, suggestion))
        elif self._trials.idle and self._ended is None:
            self._ask_posterior()

    def _start(self, plain: Sequence[Point], suggestion: Suggestion) -> None:
        for point in plain:
            self._try(point)
        pours, share = len(self._usable), self._budget // 2
        step = -(-len(suggestion.points) * pours // max(share, 1))
        for k, point in enumerate(suggestion.points):
            # where the memory expects θ, the surrogate has to be exact
            moves = self._memory is not None and k % 2 == 1
            start = remembered_point(point, self._memory or ()) if moves else point
            self._try(start, only=range(k % step, pours, step))
        self._starts = len(self._trials)
        text = f"{len(self._trials)} θ, the uncalibrated one among them, on {pours} pours"
        self.decisions.append(Decision(text if plain else f"{len(self._trials)} θ on {pours} pours"))

    def _ask_posterior(self) -> None:
        question = self._weighed_pours(self._memory)
        left = (self._budget - self._trials.answered) // len(self._usable)
        query = self._query(count=1 if left else 0, posterior=question)

        def drawn(suggestion: Suggestion) -> None:
            if suggestion.posterior is None:
                raise self._no_discrepancies()
            if self._contradicts(suggestion.posterior):
                self._earlier = self._trials
                self._begin()
                self.decisions.append(Decision(f"calibration starts again after {self._spent} simulations"))
                return
            before, self._posterior = self._posterior, suggestion.posterior
            new, self._before = self._trials.answered - self._before, self._trials.answered
            change = None if before is None else posterior_change(before, suggestion.posterior)
            if change is not None and change < UNCHANGED:
                text = f"changed the posterior by only {change:.2f} standard deviations"
                self._end(f"the last {new} of {self._before} simulations {text}")
            elif not left:
                self._end(f"the limit of {self._budget} simulations is reached")
            else:
                draws = suggestion.posterior.points
                points = [*suggestion.points, *(draws[k * len(draws) // CANDIDATES] for k in range(CANDIDATES))]
                for point in list(dict.fromkeys(points))[:left]:
                    self._try(point)

        self._questions.put(query, "posterior", drawn)

    def _weighed_pours(self, memory: tuple[RememberedGroup, ...] | None) -> PosteriorQuestion:
        pours = tuple(self._places.values())
        return PosteriorQuestion(pours, (0.0,) * len(pours), WEIGHED, prior=unit_prior(self._plan), memory=memory)

    def _end(self, reason: str) -> None:
        assert self._posterior is not None
        self._ended = reason
        self.decisions.append(Decision(f"calibration ends: {reason}"))
        self.decisions += [Decision(text) for text in left_open(self._posterior, self._plan.parameters.names)]
        self._settle_at_lowest()
        assert self._best is not None
        alone = None if self._memory is None else self._weighed_pours(None)
        query = self._query(count=0, posterior=alone, map_at=self._best, map_resolution=THETA_MAP_RESOLUTION)

        def mapped(suggestion: Suggestion) -> None:
            self._mapped(suggestion)
            self._remember(suggestion.posterior)

        self._questions.put(query, "map", mapped)

    def _query(
        self,
        *,
        count: int,
        posterior: PosteriorQuestion | None = None,
        map_at: Point = (),
        map_resolution: int = 0,
    ) -> CalibrationQuery:
        """A query about the mean |r_i − c_s(a_i, θ)| over the training pours."""
        points, differences = [], []
        for trial in self._trials.all:
            for i, cost in sorted(trial.costs.items()):
                if cost is not None:
                    points.append((*trial.point, *self._places[trial.requests[i].seed]))
                    differences.append(cost)
        return CalibrationQuery(
            self._plan.parameters,
            Data(tuple(points), tuple(differences)),
            contexts=tuple(self._places.values()),
            kappa=self._kappa,
            count=count,
            posterior=posterior,
            map_at=map_at,
            map_resolution=map_resolution,
        )

    # -- outcomes --------------------------------------------------------------------------------------------------

    def tell(self, request: Request, outcome: Outcome) -> None:
        """As in the base class; in addition, drop candidates that cannot become the best."""
        super().tell(request, outcome)
        if not isinstance(request, Simulate):
            return
        merits = [self._merit(trial, score) for trial in self._compared() if (score := self._score(trial)) is not None]
        for trial in self._trials.all[self._starts :] if merits else ():
            least = sum(discrepancies(trial)) / len(self._usable)
            if not trial.closed and self._merit(trial, least) > min(merits):
                self._trials.abandon(trial)

    def _merit(self, trial: Trial, score: float) -> float:
        """The mean |r_i − c_s(a_i, θ)|; with a memory, minus the logarithm of the posterior density.

        The likelihood is that of independent errors of an unknown common scale.
        """
        if self._memory is None:
            return score
        return len(self._usable) * math.log(WEIGHED + score) - log_memory(trial.point, self._memory)

    def _discrepancy(self, request: Simulate, simulated: float) -> float:
        """r_i − c_s(a_i, θ), with its sign."""
        return self._measured[request.seed] - simulated

    def _compared(self) -> Sequence[Trial]:
        return [trial for trial in self._trials.all if trial.closed and len(trial.requests) == len(self._usable)]

    # -- results ---------------------------------------------------------------------------------------------------

    def parameters_at(self, point: Point) -> SimulationParameters:
        """θ_s at a point of the unit cube; exactly the uncalibrated θ at its point."""
        return self._plain if point and point == self._plain_at else super().parameters_at(point)

    @property
    def _spent(self) -> int:
        """Number of simulations answered before the last beginning."""
        return self._earlier.answered

    def progress(self) -> Progress:
        """As in the base class; no further simulations after the end."""
        answered = self._trials.answered
        total = self._spent + (self._budget if self._ended is None else answered)
        return Progress(self._spent + answered, total, limited=True)

    def result(self) -> Calibrated:
        """As in the base class, with the reason of the end and the seeds of the training pours."""
        calibrated = super().result()
        before = [trial for trial in self._earlier.all if trial.closed]
        return calibrated.model_copy(
            update={
                "ended": self._ended,
                "pour_seeds": tuple(self._seed_of_pour),
                "simulations": self._spent + calibrated.simulations,
                "lost": self._earlier.lost + calibrated.lost,
                "trials": (*(self._row(i, trial) for i, trial in enumerate(before)), *calibrated.trials),
            }
        )
