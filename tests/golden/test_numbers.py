"""Answers of the optimiser to one question for every way of asking, and one small simulated pour.

On the machine that wrote the golden files numbers agree within 1e-9. Elsewhere libraries of linear algebra and vector
instructions differ in the last bits, and a search for hyperparameters ends when it gains less than its own tolerance:
answers then agree within `ELSEWHERE`. A simulated pour amplifies any difference, because its particles collide. On
another machine it is another draw from the spread of its seeds, so that it may differ by `DEVIATIONS` of those.
"""

from __future__ import annotations

import hashlib
import importlib.metadata
import json
import os
import platform
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from actors.optimizer.questions import (
    BenchOffset,
    CalibrationQuery,
    Data,
    DesignQuestion,
    Limit,
    Linear,
    MinimumQuery,
    ModelDiscrepancy,
    OffsetPrior,
    PosteriorQuestion,
    PourQuery,
    RegressionQuery,
    SpaceFillingQuery,
    Suggestion,
    SuggestionQuery,
)
from actors.optimizer.suggest import propose
from orchestrator.records.codec import to_json
from sim_engine.action import DEG, Action
from sim_engine.engine_package import engine_version
from sim_engine.liquids import Liquid, SimulationParameters
from sim_engine.prediction_band import spreads
from sim_engine.scene import PourTask, Scene
from sim_engine.search_space import Axis, Space
from sim_engine.simulator import PourSimulator
from sim_engine.vessel.shapes import cylinder
from tests.golden.golden import DATA, RTOL, Golden, compact

ELSEWHERE = 1e-4
"""Relative tolerance of the optimiser's answers on other machines: searches end at gradients of about 1e-5."""

SEEDS, DEVIATIONS = 6, 4.0
"""Seeds of the simulated pour, and how many standard deviations it may differ by on another machine."""

MACHINE = DATA / "numbers" / "machine.json"


def machine() -> dict[str, str]:
    """What the last bits of numbers depend on."""
    cpu = Path("/proc/cpuinfo")
    flags = (
        [text for text in cpu.read_text().splitlines() if text.startswith(("flags", "Features"))]
        if cpu.is_file()
        else []
    )
    features = os.environ.get("OPENBLAS_CORETYPE", "") + os.environ.get("NPY_DISABLE_CPU_FEATURES", "")
    packages = {name: importlib.metadata.version(name) for name in ("numpy", "scipy", "scikit-learn")}
    packages["taichi"] = engine_version().removeprefix("taichi ")
    digest = hashlib.sha256("".join([*flags[:1], features]).encode()).hexdigest()[:16]
    return {"platform": platform.machine(), "instructions": digest, **packages}


@pytest.fixture
def here(golden: Golden) -> bool:
    """Whether the golden files were written on such a machine."""
    if golden.regenerate:
        MACHINE.parent.mkdir(parents=True, exist_ok=True)
        MACHINE.write_text(json.dumps(machine(), indent=1) + "\n", encoding="utf-8")
    return bool(json.loads(MACHINE.read_text(encoding="utf-8")) == machine())


# -- the optimiser -----------------------------------------------------------------------------------------------------

PLANE = Space((Axis("x_offset", 0.08, 0.15), Axis("angular_velocity", 0.3, 2.1)))
THETA = Space((Axis("particles", 500, 4000, "log", integer=True), Axis("friction", 0.0, 0.6)))


def points(count: int, seed: int, dimension: int = 2) -> tuple[tuple[float, ...], ...]:
    """Places of the unit cube."""
    return tuple(tuple(map(float, row)) for row in np.random.default_rng(seed).random((count, dimension)))


def cost(point: tuple[float, ...], shift: float = 0.0) -> float:
    """A bowl with a rim; least at (0.4, 0.6)."""
    u, v = point[0] - 0.4 - shift, point[1] - 0.6
    return min(0.02 + u * u + 0.6 * v * v + 0.3 * u * v, 0.5)


def data(count: int, seed: int, shift: float = 0.0) -> Data:
    """Observations of it."""
    places = points(count, seed)
    wobble = np.random.default_rng(seed + 100).normal(0.0, 0.01, count)
    return Data(places, tuple(cost(p, shift) + float(w) for p, w in zip(places, wobble, strict=True)))


def differences(count: int, seed: int) -> Data:
    """Of simulated and weighed spillage, at parameters and actions."""
    places = points(count, seed, 4)
    return Data(places, tuple(0.3 * (p[1] - 0.5) * (0.5 + p[2]) + 0.05 * (p[0] - p[3]) for p in places))


ASKED = points(5, 50)

POURED, SIMULATED = data(7, 1), data(24, 2, shift=0.08)

PLAIN = MinimumQuery(PLANE, POURED, seed=11, predict_at=ASKED)

INFORMED = PourQuery(PLANE, POURED, seed=11, predict_at=ASKED, simulated=SIMULATED)

DISCREPANCY = ModelDiscrepancy((OffsetPrior(shift=0.14), OffsetPrior(factor=0.05, origin=0.2)), pours_left=4)

ADAPTIVE = replace(INFORMED, discrepancy=DISCREPANCY)

CONTEXT = CalibrationQuery(THETA, differences(18, 3), seed=12, contexts=points(6, 4))

QUERIES: dict[str, SuggestionQuery] = {
    "nothing known": MinimumQuery(PLANE, Data(), seed=5, count=4),
    "sobol": SpaceFillingQuery(PLANE, POURED.points, seed=11, count=3),
    "regression": RegressionQuery(PLANE, POURED, seed=11, predict_at=ASKED, map_resolution=4),
    "lcb, constant mean": replace(PLAIN, count=3, pending=points(2, 7), map_resolution=6),
    "lcb, zero mean, plain": replace(PLAIN, mean="zero", plain=True, kappa=1.5),
    "lcb, simulated mean": INFORMED,
    "posterior minimum": replace(PLAIN, acquisition="posterior_minimum", count=2),
    "refusals and failures": replace(PLAIN, infeasible=points(3, 9), refused=points(2, 10), failed=POURED.points[:1]),
    "a constraint": replace(PLAIN, constraints=(Linear((("x_offset", 1.0), ("angular_velocity", 0.05)), 0.17),)),
    "least loss, adaptive mean": replace(ADAPTIVE, acquisition="least_loss", count=3),
    "least loss within a limit": replace(
        ADAPTIVE,
        acquisition="least_loss",
        discrepancy=replace(DISCREPANCY, limit=Limit(0.2, 0.1), drawn=(BenchOffset((1.0, 1.0), (0.05, 0.0)),)),
    ),
    "what adaptive pours taught": replace(ADAPTIVE, count=0),
    "context": CONTEXT,
    "context, posterior": replace(
        CONTEXT, count=0, posterior=PosteriorQuestion(points(6, 4), (0.01, 0.0, -0.01, 0.02, 0.0, 0.01), 0.02, count=20)
    ),
    "context, design": replace(
        CONTEXT,
        count=0,
        posterior=PosteriorQuestion((), (), 0.02, count=20, prior=((0.5, 0.2), (0.5, 0.0))),
        design=DesignQuestion(points(4, 15), points(5, 16)),
    ),
}
"""Queries of every type, with every acquisition, mean and noise."""


@pytest.mark.parametrize("name", QUERIES)
def test_the_optimiser_gives_the_same_answer(name: str, golden: Golden, here: bool) -> None:
    answer: dict[str, Any] = to_json(replace(propose(QUERIES[name]), seconds=0.0), Suggestion)
    file = "".join(letter if letter.isalnum() else "-" for letter in name).replace("--", "-")
    golden.check_json(f"numbers/{file}.json", compact(answer), rtol=RTOL if here else ELSEWHERE)


# -- the simulator -----------------------------------------------------------------------------------------------------


def test_a_simulated_pour_is_the_same(golden: Golden, here: bool) -> None:
    beaker = cylinder("beaker", inner_radius=0.03, inner_height=0.07)
    cup = cylinder("cup", inner_radius=0.02, inner_height=0.09)
    scene = Scene("cup", beaker, cup, Liquid(mass=0.1))
    action = Action(angular_velocity=110 * DEG, x_offset=0.085, height=0.06, max_angle=115 * DEG, hold_time=0.3)
    parameters = SimulationParameters(particles=300, cohesion=0.03, friction=0.2)
    simulator = PourSimulator()
    outcomes = [simulator.simulate(PourTask(scene, action, parameters, seed)).outcome for seed in range(SEEDS)]
    fractions = [[one.received, one.spilled, one.retained, one.simulated_time, float(one.steps)] for one in outcomes]
    found = {
        "received, spilled, retained, simulated time, steps": [compact(row) for row in fractions],
        "spread": {name: compact([one.mean, one.deviation]) for name, one in spreads(outcomes).items()},
    }
    if here:
        golden.check_json("numbers/pour.json", found)
        return
    before = json.loads((DATA / "numbers" / "pour.json").read_text(encoding="utf-8"))["spread"]
    for name, (mean, deviation) in before.items():
        now = found["spread"][name][0]  # type: ignore[index]
        assert abs(now - mean) <= DEVIATIONS * deviation * (2.0 / SEEDS) ** 0.5 + 1.0 / parameters.particles, name
