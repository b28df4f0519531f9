"""`engine_package`: the packages that can compile the solver: choice, check of the first pour, and the same physics."""

from __future__ import annotations

import dataclasses
import json
import math
import os
import subprocess
import sys
from pathlib import Path

import pytest

from actors.interfaces import LaboratoryError
from actors.runtime.child_process import child_environment
from actors.simulators.job_runner import JobRunner
from sim_engine import engine_package
from sim_engine.engine_package import (
    ENGINES,
    EXPECTED,
    LIBRARIES,
    check_engine,
    check_task,
    engine_name,
    engine_version,
)
from sim_engine.errors import EngineError, WrongOutcomeError
from sim_engine.outcome import PourOutcome
from sim_engine.resources import ENVIRONMENT_VARIABLE, cache_directory, installed
from sim_engine.scene import PourTask
from sim_engine.simulator import PourSimulator
from tests.support.waiting import PATIENCE

ROOT = Path(__file__).parents[2]

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
    monkeypatch.setitem(LIBRARIES, "taichi", {})
    monkeypatch.delenv("DECANT_ENGINE", raising=False)
    assert engine_name() == "taichi"
    monkeypatch.setenv("DECANT_ENGINE", "quadrants")
    with pytest.raises(EngineError, match=r"not installed: pip install 'decant-pouring\[quadrants\]'"):
        engine_name()


def test_where_taichi_lacks_a_library_quadrants_is_used_and_it_is_said_once(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """A bare Debian has no libX11, which Taichi's wheel needs."""
    monkeypatch.setenv("DECANT_ENGINE", "")
    monkeypatch.setattr(engine_package, "_is_installed", lambda name: True)
    monkeypatch.setitem(LIBRARIES, "taichi", {"libNone.so.6": "libnone-6"})
    assert [engine_name(), engine_name()] == ["quadrants"] * 2
    (record,) = caplog.records
    assert "Taichi can't be loaded without libNone.so.6: apt install libnone-6. Quadrants is used" in record.message
    monkeypatch.setenv("DECANT_ENGINE", "")
    monkeypatch.setattr(engine_package, "_is_installed", lambda name: name == "taichi")
    with pytest.raises(EngineError, match=r"apt install libnone-6; the package 'quadrants' is not installed: pip inst"):
        engine_name()


@pytest.mark.parametrize("engine", [name for name in ENGINES if installed(name)])
def test_a_pour_is_simulated_without_a_home_directory(engine: str, tmp_path: Path) -> None:
    """As by cron, or a service's user."""
    environment = {"PATH": os.environ["PATH"], "DECANT_ENGINE": engine, ENVIRONMENT_VARIABLE: str(cache_directory())}
    if engine_package._problem(engine) is not None:
        pytest.skip(f"{engine} can't be loaded here")
    poured = subprocess.run(
        [sys.executable, "-c", POUR], env=environment, capture_output=True, text=True, timeout=PATIENCE
    )
    assert poured.returncode == 0, poured.stderr
    assert json.loads(poured.stdout)["imported"] == [engine]


def test_without_a_home_directory_the_cache_is_a_folder_of_this_user(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def homeless() -> Path:
        raise RuntimeError("Could not determine home directory.")

    for name in (ENVIRONMENT_VARIABLE, "XDG_CACHE_HOME"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(Path, "home", homeless)
    monkeypatch.setattr("tempfile.gettempdir", lambda: str(tmp_path))
    assert cache_directory() == tmp_path / f"decant-cache-{os.getuid()}"
    assert "this user has no home directory" in caplog.text


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
    command = [sys.executable, "-m", "benchmarks.validation", "rest", "outflow"]
    judged = subprocess.run(command, env=env, cwd=ROOT, capture_output=True, text=True, timeout=900)
    assert judged.returncode == 0, judged.stdout + judged.stderr
