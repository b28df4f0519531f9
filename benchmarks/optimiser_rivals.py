"""Run other optimisers on the problems of `optimiser_problems.py`, in their own environment (see `optimisers.py`).

    python optimiser_rivals.py OPTIMISER < jobs.jsonl

Each line of the input is {"problem": name, "seed": number}; each line of the output is a result. For {"points": [...],
"costs": [...], "seed": number} a BoTorch optimiser returns a point.
"""

from __future__ import annotations

import json
import sys
import time
import warnings
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
from optimiser_problems import BY_NAME, Floats, Instance

Points = list[Floats]
Costs = list[float]
Ask = Callable[[Points, Costs], Floats]
Report = Callable[[Points, Costs], Floats]


def luckiest(points: Points, costs: Costs) -> Floats:
    """Return the point with the lowest observation, as most libraries report it."""
    return points[int(np.argmin(costs))]


def scikit_optimize(world: Instance) -> tuple[Ask, Report]:
    """Use `Optimizer` with its defaults: GP, gp_hedge; native integer and log axes."""
    from skopt import Optimizer
    from skopt.space import Integer, Real

    coordinates = world.problem.coordinates
    space = [
        Integer(int(c.lower), int(c.upper))
        if c.integer
        else Real(c.lower, c.upper, prior="log-uniform" if c.log else "uniform")
        for c in coordinates
    ]
    optimizer = Optimizer(space, n_initial_points=len(world.initial), random_state=world.seed)

    def ask(points: Points, costs: Costs) -> Floats:
        for point, cost in list(zip(points, costs, strict=True))[len(optimizer.Xi) :]:
            values = [c.value(u) for c, u in zip(coordinates, point, strict=True)]
            # fitting while the first points are registered would be wasted
            fit = len(optimizer.Xi) + 1 == len(points)
            optimizer.tell(
                [int(v) if c.integer else v for c, v in zip(coordinates, values, strict=True)], cost, fit=fit
            )
        return np.array([c.unit(float(v)) for c, v in zip(coordinates, optimizer.ask(), strict=True)])

    return ask, luckiest


def bayesian_optimization(world: Instance) -> tuple[Ask, Report]:
    """Use `BayesianOptimization` with its defaults: GP, UCB; native integers, log axes by their logarithm."""
    from bayes_opt import BayesianOptimization

    coordinates = world.problem.coordinates
    names = [f"x{i}" for i in range(len(coordinates))]
    bounds: dict[str, Any] = {
        name: (int(c.lower), int(c.upper), int) if c.integer else (0.0, 1.0)
        for name, c in zip(names, coordinates, strict=True)
    }
    optimizer = BayesianOptimization(
        f=None, pbounds=bounds, random_state=world.seed, verbose=0, allow_duplicate_points=True
    )
    told = 0

    def ask(points: Points, costs: Costs) -> Floats:
        nonlocal told
        for point, cost in zip(points[told:], costs[told:], strict=True):
            own = {
                name: int(c.value(u)) if c.integer else float(u)
                for name, c, u in zip(names, coordinates, point, strict=True)
            }
            optimizer.register(params=own, target=-cost)
        told = len(points)
        proposed = optimizer.suggest()
        return np.array(
            [
                c.unit(float(proposed[name])) if c.integer else float(proposed[name])
                for name, c in zip(names, coordinates, strict=True)
            ]
        )

    return ask, luckiest


def botorch(world: Instance, acquisition: str) -> tuple[Ask, Report]:
    """Use `SingleTaskGP` with standardised outcomes and default priors; the problem rounds integer axes."""
    import torch
    from botorch.acquisition import UpperConfidenceBound, qLogNoisyExpectedImprovement
    from botorch.fit import fit_gpytorch_mll
    from botorch.models import SingleTaskGP
    from botorch.models.transforms import Standardize
    from botorch.optim import optimize_acqf
    from gpytorch.mlls import ExactMarginalLogLikelihood

    torch.set_num_threads(1)
    torch.manual_seed(world.seed)
    d = world.problem.dimension
    bounds = torch.stack([torch.zeros(d), torch.ones(d)]).double()

    def fitted(points: Points, costs: Costs) -> tuple[Any, Any]:
        x = torch.tensor(np.array(points), dtype=torch.double)
        model = SingleTaskGP(x, -torch.tensor(costs, dtype=torch.double)[:, None], outcome_transform=Standardize(m=1))
        fit_gpytorch_mll(ExactMarginalLogLikelihood(model.likelihood, model))
        return model, x

    def ask(points: Points, costs: Costs) -> Floats:
        model, x = fitted(points, costs)
        if acquisition == "ucb":
            score: Any = UpperConfidenceBound(model, beta=4.0)
        else:
            score = qLogNoisyExpectedImprovement(model, X_baseline=x)
        found, _ = optimize_acqf(score, bounds=bounds, q=1, num_restarts=4, raw_samples=128)
        return np.asarray(found.detach().numpy()[0])

    def report(points: Points, costs: Costs) -> Floats:
        model, x = fitted(points, costs)
        with torch.no_grad():
            return points[int(model.posterior(x).mean.argmax())]

    return ask, report


RIVALS: dict[str, Callable[[Instance], tuple[Ask, Report]]] = {
    "scikit-optimize": scikit_optimize,
    "bayesian-optimization": bayesian_optimization,
    "BoTorch UCB": lambda world: botorch(world, "ucb"),
    "BoTorch qLogNEI": lambda world: botorch(world, "nei"),
}


def play(world: Instance, ask: Ask, report: Report) -> dict[str, Any]:
    """Run one optimisation: the first points, then proposals until the budget is spent."""
    points: Points = list(world.initial)
    costs: Costs = [world.observe(point, i) for i, point in enumerate(points)]
    started = time.process_time()
    while len(points) < world.problem.budget:
        point = ask(points, costs)
        costs.append(world.observe(point, len(points)))
        points.append(point)
    spent = time.process_time() - started
    return {
        "problem": world.problem.name,
        "seed": world.seed,
        "reported": world.true(report(points, costs)),
        "visited": min(world.true(point) for point in points),
        "poured": float(np.mean([world.true(point) for point in points])),
        "cpu_s": spent / max(world.problem.budget - len(world.initial), 1),
    }


def main() -> None:
    """Process one job after the other."""
    warnings.simplefilter("ignore")
    name = sys.argv[1]
    for line in sys.stdin:
        job = json.loads(line)
        if "points" in job:  # one proposal instead of an optimisation
            points = [np.array(point) for point in job["points"]]
            about = SimpleNamespace(seed=job["seed"], problem=SimpleNamespace(dimension=len(points[0])))
            proposed = RIVALS[name](about)[0](points, job["costs"])  # type: ignore[arg-type]
            print(json.dumps({"point": proposed.tolist()}), flush=True)
            continue
        world = Instance(BY_NAME[job["problem"]], job["seed"])
        started = time.process_time()
        result = play(world, *RIVALS[name](world))
        print(json.dumps({**result, "total_s": time.process_time() - started}), flush=True)


if __name__ == "__main__":
    main()
