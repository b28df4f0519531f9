"""Simulations, pours and answers of the optimiser as formulas, in arithmetic that is the same on any machine."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Sequence
from typing import Any

from actors.interfaces import PourProgress, ProgressCallback
from actors.optimizer.questions import (
    BenchOffset,
    CalibrationQuery,
    Data,
    DiscrepancyFound,
    Posterior,
    PourQuery,
    SpaceFillingQuery,
    Suggestion,
    SuggestionQuery,
    SurrogateMap,
)
from orchestrator.learning.requests import (
    Failed,
    Outcome,
    Pour,
    Poured,
    Request,
    Simulate,
    Simulated,
    Suggest,
    Suggested,
)
from sim_engine.action import Action
from sim_engine.liquids import SimulationParameters
from sim_engine.outcome import PourMeasurement, PourOutcome, SimulatedPour
from sim_engine.scene import PourTask, Scene

LOAD = 0.2
"""Of a weighed pour [kg]."""


def noise(*what: object) -> float:
    """A number from 0 to 1 that depends on everything that is named."""
    return int.from_bytes(hashlib.sha256(repr(what).encode()).digest()[:6], "big") / 2**48


def spilled(action: Action, theta: SimulationParameters, seed: int) -> float:
    """Share that is spilled. Least at 70 deg/s and 115 mm, and with θ near its truth."""
    speed, miss = action.angular_velocity / 1.2217, (action.x_offset - 0.115) / 0.05
    wrong = abs(theta.friction - 0.35) + abs(theta.wall_distance - 0.8) + abs(theta.viscosity_factor - 0.77)
    share = 0.02 + 0.1 * (speed - 1.0) * (speed - 1.0) + 0.2 * miss * miss + 0.05 * wrong * (1.0 + speed)
    return min(share + 0.01 * noise("spilled", seed), 0.95)


REAL = SimulationParameters(particles=2000, friction=0.35, wall_distance=0.8, viscosity_factor=0.77)

LOST, UNFIT = 0.02, 0.03
"""Shares of simulations that come to nothing, and of those whose action can't be carried out."""


def outcome_of(request: Request) -> Outcome:
    """What comes of a request."""
    match request:
        case Suggest(query):
            return Suggested(answer(query))
        case Simulate():
            chance = noise("lost", request.seed)
            if chance < LOST:
                return Failed("simulation", "the liquid diverged")
            if chance > 1.0 - UNFIT:
                return Failed("invalid_action", "the vessels touch")
            error = request.pose_error
            action = request.action
            if error is not None:
                action = action.with_values(x_offset=action.x_offset + error.x)
            return Simulated(simulated(action, request.parameters, request.seed))
        case Pour():
            if noise("failed pour", request.seed) < LOST:
                return Failed("pour_failed", "the balance did not settle")
            return Poured(weighed(request.action, request.seed, LOAD))


def simulated(action: Action, theta: SimulationParameters, seed: int) -> PourOutcome:
    """A simulation that comes to something."""
    share, retained = spilled(action, theta, seed), 0.01 * noise("kept", seed)
    return PourOutcome(
        received=1.0 - share - retained,
        spilled=share,
        retained=retained,
        in_flight=0.0,
        escaped=0.0,
        particles=theta.particles,
        spacing=0.005,
        density_error=0.01,
        simulated_time=3.0,
        steps=1000,
        cpu_s=1.0,
        seed=seed,
    )


def weighed(action: Action, seed: int, load: float) -> PourMeasurement:
    """A pour on the bench."""
    return PourMeasurement(loaded=load, spilled=load * spilled(action, REAL, seed), retained=0.01 * load)


def answer(query: SuggestionQuery) -> Suggestion:
    """Everything that may be asked, answered from the question by arithmetic."""
    dimension = query.space.dimension
    data = Data(query.known, (0.0,) * len(query.known)) if isinstance(query, SpaceFillingQuery) else query.data
    simulated = query.simulated if isinstance(query, PourQuery) else Data()
    name = (query.seed, len(data), *_words(query))
    cost = [*data.costs, *simulated.costs]
    places = [point[:dimension] for point in (*data.points, *simulated.points)]
    best = min(range(len(cost)), key=cost.__getitem__) if cost else None
    centre = places[best] if best is not None else (0.5,) * dimension
    points = tuple(
        tuple(min(max(0.5 * centre[axis] + 0.5 * noise(name, i, axis), 0.0), 1.0) for axis in range(dimension))
        for i in range(getattr(query, "count", 0))
    )
    if len(cost) < 2 or isinstance(query, SpaceFillingQuery):
        return Suggestion(points)

    def mean(point: Sequence[float]) -> float:
        return 0.05 + 0.1 * math.fsum((u - c) * (u - c) for u, c in zip(point, centre, strict=False))

    def answers(at: Sequence[Sequence[float]], about: str) -> tuple[float, ...]:
        return tuple(mean(point) + 0.01 * noise(name, about, i) for i, point in enumerate(at))

    size = query.map_resolution if dimension > 1 else 0
    row = tuple(0.1 + 0.01 * i for i in range(size))
    grid = SurrogateMap((row,) * size, (row,) * size, query.space.names[:2], tuple(centre)) if size else None
    adaptive = isinstance(query, PourQuery) and query.discrepancy is not None
    calibration = isinstance(query, CalibrationQuery)
    thetas = tuple(tuple(noise(name, "theta", i, axis) for axis in range(dimension)) for i in range(20))
    asked = len(query.predict_at)
    return Suggestion(
        points=points,
        means=answers(points, "mean"),
        deviations=tuple(0.02 + 0.01 * noise(name, "deviation", i) for i in range(len(points))),
        best_point=tuple(centre),
        best_mean=mean(centre),
        best_deviation=0.01,
        hyperparameters={"noise": 0.01, "signal": 0.1},
        surrogate=grid,
        seconds=0.0,
        predictions=answers(query.predict_at, "prediction"),
        prediction_deviations=tuple(0.01 + 0.01 * noise(name, "far", i) for i in range(asked)),
        noises=tuple(0.01 for _ in points),
        bands=tuple((0.02, 0.12) for _ in points) if adaptive else (),
        posterior=Posterior(thetas, (0.02,) * len(thetas), 15.0) if calibration and query.posterior else None,
        best_noise=0.01,
        gains=tuple(noise(name, "gain", i) for i in range(len(query.design.candidates)))
        if calibration and query.design
        else (),
        uncertainty=1.0 / (1 + len(data)) if calibration and query.design else None,
        discrepancy=_discrepancy(query, dimension) if isinstance(query, PourQuery) and adaptive else None,
    )  # fmt: skip


def _words(query: SuggestionQuery) -> tuple[str, str]:
    """Mean and acquisition of a query, which its answer depends on."""
    match query:
        case SpaceFillingQuery():
            return "constant", "sobol"
        case PourQuery():
            return "simulated" if query.discrepancy is None else "adaptive", query.acquisition
    return getattr(query, "mean", "constant"), getattr(query, "acquisition", "lcb")


def _discrepancy(query: PourQuery, dimension: int) -> DiscrepancyFound:
    assert query.discrepancy is not None
    limited = query.discrepancy.limit is not None
    drawn = (
        BenchOffset((1.0,) * dimension, (0.05,) * dimension),
        BenchOffset((0.98,) * dimension, (0.0,) * dimension),
    )
    return DiscrepancyFound(
        uninformative=0.05,
        shifts=(0.05,) * dimension,
        deviations=(0.02,) * dimension,
        factor=1.1,
        gain=0.02 / (1 + len(query.data) * len(query.data)),
        exceedances=(0.02,) * query.count if limited else (),
        least_exceedance=0.01 if limited else None,
        drawn=drawn if query.count == 0 else (),
    )


# -- a laboratory in it ------------------------------------------------------------------------------------------------


class Simulators:
    """Two of them, which answer at once."""

    size, separate = 2, False

    async def simulate(self, task: PourTask) -> SimulatedPour:
        """The outcome of a simulation that is not lost."""
        return SimulatedPour(simulated(task.action, task.parameters, task.seed))


class Bench:
    """A virtual bench, whose liquid is `REAL`."""

    mode = "virtual"

    async def pour(
        self, scene: Scene, action: Action, *, seed: int, progress: ProgressCallback | None = None, dose: Any = None
    ) -> PourMeasurement:
        """One weighed pour."""
        if progress is not None:
            progress(PourProgress("tilt", 0.5))
        return weighed(action, seed, scene.liquid.mass)


class Optimizer:
    """Answers by arithmetic."""

    async def suggest(self, query: SuggestionQuery) -> Suggestion:
        """See `answer`."""
        return answer(query)


class FormulaLaboratory:
    """A laboratory of all these; an asynchronous context manager, as others are."""

    def __init__(self) -> None:
        self.simulators, self.bench, self.optimizer = Simulators(), Bench(), Optimizer()

    async def __aenter__(self) -> FormulaLaboratory:
        return self

    async def __aexit__(self, *error: Any) -> None:
        return None
