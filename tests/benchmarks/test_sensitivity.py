"""`benchmarks/sensitivity.py`: what a parameter does to the spillage, in made-up pours and in a real one."""

from __future__ import annotations

import math
import sys
from contextlib import closing
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sim_engine.liquids import SimulationParameters
from sim_engine.outcome import PourOutcome
from sim_engine.scene import PourTask
from sim_engine.simulator import PourSimulator
from tests.support.hypothesis_examples import examples

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))
try:
    from sensitivity import PARTICLES, POURS, Extent, Sensitivity, analyse, draw, effects_table, grid, sensitivity
finally:
    sys.path.pop(0)

INFOS = {name: info for name, info in SimulationParameters.info().items() if not info.nuisance}
NOISE = 0.01


def analysed(curve: Any, *, points: int = 7, seeds: int = 5, noise: float = NOISE, seed: int = 1) -> Sensitivity:
    """The analysis of a spillage that is a function of the parameter, plus noise from seed to seed."""
    rng = np.random.default_rng(seed)
    values = np.linspace(0.0, 1.0, points)
    samples = [curve(v) + noise * rng.standard_normal(seeds) for v in values]
    return analyse("friction", "fast", values, samples, 1e-3)


@pytest.mark.parametrize("name", INFOS)
@pytest.mark.parametrize("count", [3, 6, 8])
def test_a_grid_has_the_default_and_both_ends(name: str, count: int) -> None:
    info, default = INFOS[name], float(getattr(SimulationParameters(particles=1_000), name))
    values = grid(info, default, count)
    ends = PARTICLES if name == "particles" else (info.lower, info.upper)
    assert (values[0], values[-1]) == ends
    assert default in values
    assert len(values) == count
    assert list(values) == sorted(values)
    assert all(SimulationParameters.from_values({name: v}) for v in values)


@settings(max_examples=examples(30), deadline=None)
@given(st.floats(0.1, 0.6), st.booleans(), st.integers(0, 10_000))
def test_a_monotone_effect_is_found_over_the_whole_range_with_its_size_and_slope(
    size: float, falls: bool, seed: int
) -> None:
    sign = -1 if falls else 1
    found = analysed(lambda v: 0.7 * falls + sign * size * v, seed=seed)
    assert found.direction == sign
    assert abs(found.change - sign * size) < 5 * found.change_error
    assert abs(found.slope - sign * size) < 5 * found.slope_error
    assert found.upper - found.lower > 0.8


def test_where_an_effect_turns_round_its_range_ends() -> None:
    """Spillage rises up to 2/3 and falls from there."""
    found = analysed(lambda v: 0.3 - 0.5 * abs(v - 2 / 3), points=10)
    assert (found.direction, found.lower) == (1, 0.0)
    assert found.upper == pytest.approx(2 / 3)
    assert found.change == pytest.approx(0.5 * 2 / 3, abs=0.03)


def test_noise_alone_is_no_effect() -> None:
    found = [analysed(lambda v: 0.2, seed=seed) for seed in range(40)]
    assert sum(one.direction == 0 for one in found) >= 34  # 95 % of them, but for chance
    assert all(abs(one.slope) < 5 * one.slope_error for one in found)


def test_more_noise_hides_what_less_noise_shows() -> None:
    assert analysed(lambda v: 0.2 + 0.03 * v, noise=0.002).direction == 1
    assert analysed(lambda v: 0.2 + 0.03 * v, noise=0.2).direction == 0


def test_seeds_that_all_spill_alike_are_no_better_known_than_to_a_particle() -> None:
    found = analysed(lambda v: 0.1, noise=0.0)
    assert (found.direction, found.change) == (0, 0.0)
    assert found.change_error == pytest.approx(math.hypot(1e-3, 1e-3))


class MadeUp:
    """Spills with friction, less with cohesion, and otherwise whatever; leaks where lips are lowered most."""

    def __init__(self) -> None:
        self.tasks: list[PourTask] = []

    def simulate(self, task: PourTask) -> Any:
        self.tasks.append(task)
        theta = task.parameters
        spilled = 0.2 + 0.3 * theta.friction - 0.5 * theta.cohesion
        spilled += 0.002 * np.random.default_rng(task.seed).standard_normal()
        leak = "it leaked" if theta.rim_correction == 1.0 else None
        o = PourOutcome(
            1 - spilled, spilled, 0.0, 0.0, 0.0, theta.particles, 0.005, 0.0, 3.0, 1, 0.0, task.seed, invalid=leak
        )
        return SimpleNamespace(outcome=o)


def test_every_parameter_is_turned_alone_and_the_defaults_are_simulated_once(tmp_path: Path) -> None:
    made_up = MadeUp()
    _, sensitivities = sensitivity(made_up, Extent(1_000, 5, 3, ("slow", "fast")))  # type: ignore[arg-type]
    base = SimulationParameters(particles=1_000)
    turned = [{n for n in INFOS if getattr(t.parameters, n) != getattr(base, n)} for t in made_up.tasks]
    assert max(len(names) for names in turned) == 1
    assert len(made_up.tasks) == 2 * 3 * (1 + 4 * len(INFOS))
    assert turned.count(set()) == 2 * 3
    assert {t.action for t in made_up.tasks} == {POURS["slow"], POURS["fast"]}
    known = {(row.parameter, row.pour): row for row in sensitivities}
    assert len(known) == 2 * len(INFOS)
    friction, cohesion = known["friction", "slow"], known["cohesion", "fast"]
    assert (friction.direction, friction.lower, friction.upper) == (1, 0.0, 1.0)
    assert friction.change == pytest.approx(0.3, abs=0.01)
    assert (cohesion.direction, cohesion.upper) == (-1, 0.2)
    assert known["xsph_rate", "fast"].direction == 0
    assert known["rim_correction", "fast"].upper == 0.75  # what leaked does not count
    head, rows = effects_table(sensitivities, ("slow", "fast"))
    assert head == ["name", "unit", "slow pour", "fast pour"]
    shown = {row[0]: row[1:] for row in rows}
    assert shown["`friction`"][1].startswith("rises, 0 … 1: +0.3")
    assert shown["`cohesion`"][2].startswith("falls, 0 … 0.2 N/m: -0.1")
    assert shown["`xsph_rate`"][1:] == ["none", "none"]
    draw(sensitivities, base, tmp_path / "sensitivity.png")
    assert (tmp_path / "sensitivity.png").stat().st_size > 10_000


def test_what_the_defaults_spill_is_told_by_seed() -> None:
    seeds, _ = sensitivity(MadeUp(), Extent(1_000, 3, 4, ("fast",), ("friction",)))  # type: ignore[arg-type]
    assert seeds["fast"].mean() == pytest.approx(0.19, abs=0.01)
    assert 0.0 < seeds["fast"].std(ddof=1) < 0.01


@pytest.mark.slow
def test_walls_that_rub_spill_more_in_a_real_pour() -> None:
    with closing(PourSimulator()) as simulator:
        _, (effect,) = sensitivity(simulator, Extent(300, 3, 2, ("fast",), ("friction",)))
    assert effect.direction == 1
