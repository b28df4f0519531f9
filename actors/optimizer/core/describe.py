"""What a fitted surrogate says, for the answer: predictions, the best observation, a map, draws of θ."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from actors.optimizer.core.asked import Asked, array, tuples
from actors.optimizer.core.design import Weighed, expected_reductions
from actors.optimizer.core.models import Model
from actors.optimizer.core.posterior import DISCREPANCY_PRIOR, drawn_beforehand, sample_posterior
from actors.optimizer.core.problem import (
    DesignQuestion,
    Point,
    Posterior,
    PosteriorQuestion,
    SuggestProblem,
    SurrogateMap,
)
from actors.optimizer.core.region import Feasibility, Region
from actors.optimizer.core.risk import RiskProcess
from sim_engine.bands import LEVEL

Array = NDArray[np.float64]

WORST = 8
"""Disturbances that an answer names as the worst of a request."""


def describe(
    problem: SuggestProblem, asked: Asked, model: Model, points: Array, feasibility: Feasibility | None
) -> dict[str, object]:
    """What the surrogate says about the proposals, the observations and the rest."""
    known = asked.known if len(asked.known) else asked.simulated
    if problem.risk is not None:
        known = asked.region.snap(array(problem.predict_at, problem.space.dimension))
    elif feasibility is not None:
        known = known[feasibility.likely(known)]
    if problem.risk is None and (allowed := asked.region.allows(known)).any():
        known = known[allowed]  # former data may lie beside what is allowed today
    means, deviations = model.surrogate.predict(points) if len(points) else (np.empty(0), np.empty(0))
    at_known, known_deviations = model.surrogate.predict(known)
    expected = at_known
    if problem.risk is None and feasibility is not None and len(asked.costs):
        made = feasibility.made(known)
        expected = made * at_known + (1.0 - made) * asked.costs.max()
    best = int(np.argmin(expected))
    process = model.process
    description: dict[str, object] = {
        "means": tuple(map(float, means)),
        "deviations": tuple(map(float, deviations)),
        "noises": () if problem.beside or problem.risk else tuple(map(float, model.noise_at(points))),
        "best_point": tuple(map(float, known[best])),
        "best_mean": float(at_known[best]),
        "best_deviation": float(known_deviations[best]),
        "best_noise": None if problem.beside or problem.risk else float(model.noise_at(known[best : best + 1])[0]),
        "hyperparameters": {
            "signal": process.signal,
            "noise": process.noise,
            **process.hyperparameters,
            **({} if model.averaged is None else model.averaged.hyperparameters),
            **dict(zip((f"length.{name}" for name in _axis_names(problem)), map(float, process.lengths), strict=True)),
        },
    }
    if model.averaged is not None and len(points):
        description["bands"] = tuples(model.averaged.bands(points, LEVEL))
    if problem.predict_at:
        predictions, spreads = model.surrogate.predict(
            asked.region.snap(array(problem.predict_at, problem.space.dimension))
        )
        description["predictions"] = tuple(map(float, predictions))
        description["prediction_deviations"] = tuple(map(float, spreads))
        if isinstance(model.surrogate, RiskProcess):
            description["risk"] = model.surrogate.answer(known, WORST)
    if problem.map_resolution and problem.space.dimension >= 2:
        sought = problem.acquisition == "posterior_minimum" and len(points) > 0
        at = np.array(problem.map_at) if problem.map_at else points[0] if sought else known[best]
        across, up = sorted(int(i) for i in np.argsort(model.lengths, kind="stable")[:2])
        description["surrogate"] = mapped(problem, asked.region, model, at, (across, up), problem.map_resolution)
    return description


def posterior_of(
    problem: SuggestProblem, question: PosteriorQuestion, region: Region, model: Model, rng: np.random.Generator
) -> Posterior:
    """Draws of θ given weighed pours."""
    contexts = array(question.contexts, model.process.points.shape[1] - problem.space.dimension)
    if not len(contexts):
        drawn = drawn_beforehand(question.count, problem.space.dimension, array(question.prior, 2), rng)
        lack = (DISCREPANCY_PRIOR[0],) * question.count
        return Posterior(tuples(region.snap(drawn)), lack, float(question.count))
    sampled = sample_posterior(
        model.process,
        contexts,
        np.array(question.offsets),
        noise=question.noise,
        count=question.count,
        snap=region.snap,
        rng=rng,
        prior=array(question.prior, 2),
    )
    return Posterior(tuples(sampled.points), tuple(map(float, sampled.discrepancies)), sampled.effective)


def design_of(
    problem: SuggestProblem, question: DesignQuestion, made: PosteriorQuestion, model: Model, posterior: Posterior
) -> dict[str, object]:
    """What weighing a pour at each candidate would tell, beside those made."""
    beside = model.process.points.shape[1] - problem.space.dimension
    gains, variance = expected_reductions(
        model.process,
        np.array(posterior.points),
        np.array(posterior.discrepancies),
        Weighed(array(made.contexts, beside), np.array(made.offsets), made.noise),
        array(question.candidates, beside),
        array(question.targets, beside),
    )
    return {"gains": tuple(map(float, gains)), "uncertainty": variance}


def _axis_names(problem: SuggestProblem) -> list[str]:
    return [*problem.space.names, *(f"context{i + 1}" for i in range(problem.beside))]


def mapped(
    problem: SuggestProblem, region: Region, model: Model, at: Array, axes: tuple[int, int], resolution: int
) -> SurrogateMap:
    """The surrogate on the plane through `at`, shape (dimension,), that two axes of the space span."""
    across, up = axes
    places = np.linspace(0.0, 1.0, resolution)
    first, second = np.meshgrid(places, places)
    grid = np.tile(at, (first.size, 1))
    grid[:, across], grid[:, up] = first.ravel(), second.ravel()
    mean, deviation = model.surrogate.predict(region.snap(grid))
    shape, names = first.shape, problem.space.names
    cut: tuple[tuple[str, ...], Point] = ((), ())
    if problem.space.dimension > 2:
        cut = (names[across], names[up]), tuple(map(float, at))
    return SurrogateMap(tuples(mean.reshape(shape)), tuples(deviation.reshape(shape)), *cut)
