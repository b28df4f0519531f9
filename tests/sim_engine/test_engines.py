"""The packages that can compile the solver: choice, check of the first pour, and the same physics."""

from __future__ import annotations

import dataclasses
import json
import math
import subprocess
import sys
from pathlib import Path

import pytest

from actors.interfaces import LaboratoryError
from actors.runtime.child_process import child_environment
from actors.simulators.job_runner import JobRunner
from sim_engine import engine_package
from sim_engine.engine_package import ENGINES, EXPECTED, check_engine, check_task, engine_name, engine_version
from sim_engine.errors import EngineError, WrongOutcomeError
from sim_engine.outcome import PourOutcome
from sim_engine.resources import ENVIRONMENT_VARIABLE, installed
from sim_engine.scene import PourTask
from sim_engine.simulator import PourSimulator
from tests.support.waiting import PATIENCE

POUR = """
import json, sys
from sim_engine.engine_package import check_task, engine_version
from sim_engine.simulator import PourSimulator
simulator = PourSimulator()
retained = simulator.simulate(check_task()).outcome.retained
imported = sorted({"taichi", "quadrants"} & set(sys.modules))
print(json.dumps({"engine": engine_version(), "retained": retained, "imported": imported}))
simulator.close()
"""


@pytest.fixture(scope="module")
def right() -> PourOutcome:
    return PourSimulator().simulate(check_task()).outcome


def test_an_unknown_engine_is_refused_before_anything_starts(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DECANT_ENGINE", "vulkan")
    with pytest.raises(EngineError, match="DECANT_ENGINE=vulkan: there is no such engine; there are ta"):
        PourSimulator()
    assert engine_version() == "none"


def test_an_engine_that_is_not_installed_is_refused_with_the_remedy(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(engine_package, "_is_installed", lambda name: name == "taichi")
    monkeypatch.delenv("DECANT_ENGINE", raising=False)
    assert engine_name() == "taichi"
    monkeypatch.setenv("DECANT_ENGINE", "quadrants")
    with pytest.raises(EngineError, match=r"not installed: pip install 'decant-pouring\[quadrants\]'"):
        engine_name()


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"retained": 0.999, "received": 0.0, "spilled": 0.001}, r"retained 0\.999 .* instead of 0\.51 ± 0\.05"),
        ({"density_error": 0.2}, r"compression 0\.2 "),
        ({"received": math.nan}, "received nan"),
        ({"invalid": "the solver diverged"}, "the solver diverged"),
    ],
)
def test_an_engine_with_a_wrong_outcome_is_refused_at_every_start(
    right: PourOutcome, change: dict[str, float], said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The first change is what today's kernels give on a software device for Vulkan, without an error."""
    monkeypatch.setenv(ENVIRONMENT_VARIABLE, str(tmp_path))
    wrong = dataclasses.replace(right, **change)  # type: ignore[arg-type]
    for _ in range(2):
        with pytest.raises(WrongOutcomeError, match=said):
            check_engine(lambda task: wrong)


def test_an_engine_is_checked_once_for_each_version(
    right: PourOutcome, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(ENVIRONMENT_VARIABLE, str(tmp_path))
    poured: list[PourTask] = []

    def pour(task: PourTask) -> PourOutcome:
        poured.append(task)
        return right

    for version in ("taichi 1.7.4", "taichi 1.7.4", "taichi 1.7.5"):
        monkeypatch.setattr(engine_package, "engine_version", lambda version=version: version)
        check_engine(pour)
    assert len(poured) == 2


def test_a_pour_checks_its_engine_and_a_wrong_one_ends_the_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A campaign would otherwise count each of its simulations as failed."""
    monkeypatch.setenv(ENVIRONMENT_VARIABLE, str(tmp_path))
    monkeypatch.setitem(EXPECTED, "retained", (0.9, 0.05))
    runner = JobRunner(PourSimulator)
    with pytest.raises(LaboratoryError, match="gives a wrong outcome on this machine") as refused:
        runner.simulate(check_task(), lambda: False)
    assert type(refused.value) is LaboratoryError


@pytest.mark.slow
@pytest.mark.parametrize("engine", ENGINES)
def test_both_engines_pour_the_same_and_pass_quick_cases(engine: str) -> None:
    if not installed(engine):
        pytest.skip(f"{engine} is not installed")
    env = child_environment({"DECANT_ENGINE": engine})
    poured = subprocess.run(
        [sys.executable, "-c", POUR], env=env, capture_output=True, text=True, timeout=PATIENCE * 10
    )
    assert poured.returncode == 0, poured.stderr
    found = json.loads(poured.stdout)  # stdout has the result alone: no header of the package
    assert found["engine"].startswith(f"{engine} ")
    assert found["imported"] == [engine]
    expected, most = EXPECTED["retained"]
    assert abs(found["retained"] - expected) <= most
    code = "from orchestrator.cli.app import main; main()"
    command = [sys.executable, "-c", code, "validate-solver", "rest", "outflow"]
    judged = subprocess.run(command, env=env, capture_output=True, text=True, timeout=900)
    assert judged.returncode == 0, judged.stdout + judged.stderr
