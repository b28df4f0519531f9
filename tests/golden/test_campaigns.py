"""What every shipped campaign asks for and decides, in a world whose pours and answers are formulas.

Outcomes are functions of action, θ and seed, answers of the optimiser are functions of the question, both in plain
arithmetic that is the same on any machine. The optimiser itself has golden answers of its own (`test_optimizer.py`).
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from actors.optimizer.core.mismatch import Displacement, MismatchFound
from actors.optimizer.core.problem import Posterior, RiskAnswer, Suggestion, SuggestProblem, SurrogateMap
from orchestrator.codec import encode_request, to_json
from orchestrator.config.load import load_campaign, load_laboratory, load_vessel
from orchestrator.config.study.sections import load_study
from orchestrator.fingerprint import deciding, fingerprint
from orchestrator.plan import CampaignPlan
from orchestrator.requests import Answered, Ask, Failed, Outcome, Pour, Poured, Request, Simulate, Simulated, Slots
from orchestrator.requests import Suggest, Suggested
from orchestrator.stages import prediction_stages, stage_seed, stages_of
from orchestrator.strategies.learnt import Learnt
from orchestrator.strategies.protocol import Strategy
from orchestrator.study.cells import cells_of
from orchestrator.study.plan import study_fingerprint
from sim_engine.action import Action
from sim_engine.liquid import SimulationParameters
from sim_engine.outcome import PourMeasurement, PourOutcome
from tests.golden.golden import DATA, ROOT, Changes, Golden, columns, compact, normalised

CAMPAIGNS = ROOT / "configs" / "campaigns"
VARIANTS = DATA / "campaigns"
"""Campaigns with strategies and settings that no shipped campaign has."""

SEEDS = (0, 1, 2)
"""Added to the campaign's own seed. Of the first one every request is kept, of the others sums (`folded`)."""

PREDICTION_SEEDS = 3

LOAD = 0.2


# -- a world of formulas -------------------------------------------------------------------------------------------------


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
        case Suggest(problem):
            return Suggested(answer(problem))
        case Ask():
            return Answered(request.options[0])
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
            share, retained = spilled(action, request.parameters, request.seed), 0.01 * noise("kept", request.seed)
            return Simulated(
                PourOutcome(
                    received=1.0 - share - retained,
                    spilled=share,
                    retained=retained,
                    in_flight=0.0,
                    escaped=0.0,
                    particles=request.parameters.particles,
                    spacing=0.005,
                    density_error=0.01,
                    simulated_time=3.0,
                    steps=1000,
                    cpu_s=1.0,
                    seed=request.seed,
                )
            )
        case Pour():
            if noise("failed pour", request.seed) < LOST:
                return Failed("pour_failed", "the balance did not settle")
            share = spilled(request.action, REAL, request.seed)
            return Poured(PourMeasurement(loaded=LOAD, spilled=LOAD * share, retained=0.002))


def answer(problem: SuggestProblem) -> Suggestion:
    """Everything that may be asked, answered from the question by arithmetic."""
    dimension, data = problem.space.dimension, problem.data
    name = (problem.seed, len(data), problem.mean, problem.acquisition)
    cost = [*data.costs, *problem.simulated.costs]
    places = [point[:dimension] for point in (*data.points, *problem.simulated.points)]
    best = min(range(len(cost)), key=cost.__getitem__) if cost else None
    centre = places[best] if best is not None else (0.5,) * dimension
    points = tuple(
        tuple(
            min(max(0.5 * centre[axis] + 0.5 * noise(name, i, axis), 0.0), 1.0) for axis in range(dimension)
        )
        for i in range(problem.count)
    )
    if len(cost) < 2:
        return Suggestion(points)

    def mean(point: Sequence[float]) -> float:
        return 0.05 + 0.1 * math.fsum((u - c) * (u - c) for u, c in zip(point, centre, strict=False))

    def answers(at: Sequence[Sequence[float]], about: str) -> tuple[float, ...]:
        return tuple(mean(point) + 0.01 * noise(name, about, i) for i, point in enumerate(at))

    size = problem.map_resolution if dimension > 1 else 0
    row = tuple(0.1 + 0.01 * i for i in range(size))
    grid = SurrogateMap((row,) * size, (row,) * size, problem.space.names[:2], tuple(centre)) if size else None
    adaptive = problem.mismatch is not None
    thetas = tuple(tuple(noise(name, "theta", i, axis) for axis in range(dimension)) for i in range(20))
    asked = len(problem.predict_at)
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
        predictions=answers(problem.predict_at, "prediction"),
        prediction_deviations=tuple(0.01 + 0.01 * noise(name, "far", i) for i in range(asked)),
        noises=tuple(0.01 for _ in points),
        bands=tuple((0.02, 0.12) for _ in points) if adaptive else (),
        posterior=None if problem.posterior is None else Posterior(thetas, (0.02,) * len(thetas), 15.0),
        best_noise=0.01,
        risk=_risk(problem),
        values=tuple(0.004 / (1 + len(problem.simulated)) for _ in points) if problem.acquisition == "knowledge" else (),
        pour_value=0.01 / (1 + len(data)) if problem.acquisition == "knowledge" else None,
        gains=() if problem.design is None else tuple(
            noise(name, "gain", i) for i in range(len(problem.design.candidates))
        ),
        uncertainty=None if problem.design is None else 1.0 / (1 + len(data)),
        fitted=((0.1, 0.2, 0.3),) if problem.effort is not None else (),
        mismatch=_mismatch(problem, dimension) if adaptive else None,
    )  # fmt: skip


def _risk(problem: SuggestProblem) -> RiskAnswer | None:
    if problem.risk is None:
        return None
    asked, draws = len(problem.predict_at), len(problem.risk.disturbances)
    worst = tuple(tuple(range(min(3, draws))) for _ in range(asked)) if problem.risk.level > 0.0 else ((),) * asked
    expected = tuple(0.05 + 0.01 * noise("expected", problem.seed, i) for i in range(asked))
    return RiskAnswer(expected, (0.01,) * asked, worst)


def _mismatch(problem: SuggestProblem, dimension: int) -> MismatchFound:
    assert problem.mismatch is not None
    limited = problem.mismatch.limit is not None
    drawn = (Displacement((1.0,) * dimension, (0.05,) * dimension), Displacement((0.98,) * dimension, (0.0,) * dimension))
    return MismatchFound(
        ignorance=0.05,
        shifts=(0.05,) * dimension,
        deviations=(0.02,) * dimension,
        factor=1.1,
        gain=0.02 / (1 + len(problem.data) * len(problem.data)),
        exceedances=(0.02,) * problem.count if limited else (),
        least_exceedance=0.01 if limited else None,
        drawn=drawn if problem.count == 0 else (),
    )


# -- playing -------------------------------------------------------------------------------------------------------------


def played(plan: CampaignPlan) -> Iterator[dict[str, Any]]:
    """A campaign's stages from the first to the last: requests, outcomes, decisions, results, one after the other."""
    stages = [*stages_of(plan), *([] if plan.deployment is None else prediction_stages(
        plan, plan.deployment, PREDICTION_SEEDS))]  # fmt: skip
    results: dict[str, Learnt] = {}
    for stage in stages:
        seed = stage_seed(plan.seed, stage.name)
        yield {"stage": stage.name, "seed": seed, "order": stage.order, "pours": stage.pours}
        strategy = stage.build(results, seed)
        yield from _stage(strategy, plan.parallel_simulations)
        results[stage.name] = strategy.result()
        yield {"result": compact(strategy.result().model_dump(mode="json"))}


def _stage(strategy: Strategy, slots: int) -> Iterator[dict[str, Any]]:
    changes, waiting, known, asked = Changes(), list[tuple[int, Request]](), 0, 0
    for _ in range(20_000):
        if strategy.finished and not waiting:
            return
        free = slots - sum(isinstance(request, Simulate) for _, request in waiting)
        arm = 1 - sum(isinstance(request, Pour) for _, request in waiting)
        for request in strategy.ask(Slots(free, arm)):
            asked += 1
            waiting.append((asked, request))
            body = encode_request(request)
            yield {"ask": asked, body["type"]: changes(body.pop("type"), body)}
        decisions = getattr(strategy, "decisions", [])
        for decision in decisions[known:]:
            yield {"decision": decision.text, "values": compact(decision.values), "urgent": decision.urgent}
        known = len(decisions)
        if not waiting:
            assert strategy.finished, "asks for nothing, waits for nothing, is not finished"
            return
        # Questions are answered first. A pour takes as long as three simulations.
        order = {Suggest: 0, Ask: 0, Simulate: 1, Pour: 2 if asked % 4 else 1}
        number, request = min(waiting, key=lambda one: (order[type(one[1])], one[0]))
        waiting.remove((number, request))
        outcome = outcome_of(request)
        if not isinstance(request, Suggest):
            yield {"tell": number, **({"failed": outcome.kind} if isinstance(outcome, Failed) else {})}
        strategy.tell(request, outcome)
    raise AssertionError("not finished after 20,000 steps")


def folded(rows: Iterable[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """The same in a few lines for each stage: sums over its requests, a hash of its decisions, its result."""
    lines: list[dict[str, Any]] = []
    requests: dict[str, list[Mapping[str, Any]]] = {}
    for row in rows:
        if "stage" in row:
            lines, requests = [*lines, dict(row)], {}
        elif "result" in row:
            decisions = requests.pop("decision", [])
            texts = "\n".join(one["decision"] for one in decisions)
            lines += [{"requests": kind, **columns(found)} for kind, found in sorted(requests.items())]
            lines.append({"decisions": len(decisions), "sha256": hashlib.sha256(texts.encode()).hexdigest()})
            lines.append(dict(row))
        else:
            kind = next(iter(set(row) - {"ask", "failed", "values", "urgent"}))
            requests.setdefault(kind, []).append(row)
    return lines


# -- the tests -----------------------------------------------------------------------------------------------------------

PLAYED = sorted(path.stem for path in CAMPAIGNS.glob("*.yaml"))
FURTHER = sorted(path.stem for path in VARIANTS.glob("*.yaml"))

@pytest.mark.parametrize(
    ("name", "further"),
    [
        (name, seed) for name in PLAYED for seed in SEEDS
    ],
)
def test_shipped_campaign_makes_the_same_requests_and_decisions(name: str, further: int, golden: Golden) -> None:
    plan = load_campaign(CAMPAIGNS / f"{name}.yaml")
    rows = played(replace(plan, seed=plan.seed + further))
    golden.check_lines(f"campaigns/played/{name}-{further}.jsonl", folded(rows) if further else rows)


@pytest.mark.parametrize("name", FURTHER)
def test_further_settings_make_the_same_requests_and_decisions(name: str, golden: Golden) -> None:
    plan = load_campaign(VARIANTS / f"{name}.yaml")
    golden.check_lines(f"campaigns/played/{name}.jsonl", played(plan))


def test_no_shipped_campaign_is_left_out() -> None:
    files = {path.stem.rpartition("-")[0] for path in (VARIANTS / "played").glob("*-[0-9].jsonl")}
    assert files == set(PLAYED)


# -- files ---------------------------------------------------------------------------------------------------------------

SHIPPED = sorted(
    path.relative_to(ROOT / "configs").as_posix()
    for folder in ("campaigns", "laboratories", "studies", "vessels")
    for path in (ROOT / "configs" / folder).glob("*.yaml")
)


def read(path: Path) -> tuple[Any, Any]:
    """What a file says with everything filled in, and what of it decides requests; both JSON-ready."""
    match path.parent.name:
        case "campaigns":
            plan = load_campaign(path)
            return plan.resolved, fingerprint(plan)
        case "laboratories":
            laboratory = load_laboratory(path)
            return to_json(laboratory, type(laboratory)), deciding(laboratory)
        case "studies":
            study = load_study(path)
            cells = [dataclasses.asdict(cell) for cell in cells_of(study)]
            return {"base": study.base.resolved, "cells": columns(cells)}, study_fingerprint(study)
        case _:
            vessel = load_vessel(path)
            return to_json(vessel, type(vessel)), deciding(vessel)


@pytest.mark.parametrize("name", SHIPPED)
def test_shipped_file_means_the_same(name: str, golden: Golden) -> None:
    resolved, decides = read(ROOT / "configs" / name)
    text = json.dumps({"resolved": resolved, "fingerprint": decides}, indent=1, ensure_ascii=False, sort_keys=True)
    golden.check(f"files/{name.replace('.yaml', '.json')}", normalised(text))
