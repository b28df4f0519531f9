"""The package that compiles the solver: its choice, its version, and a check of its first pour.

- `engine_name` chooses Taichi or Quadrants, the maintained fork of Taichi: `DECANT_ENGINE`, else the first one that is
  installed and has its shared libraries. Outcomes of the two agree within the spread of seeds, not bit for bit.
- `engine_version` names the package and its version. Runs record it, and nodes of a cluster compare it.
- `check_engine` compares one small pour with a stored outcome, once for each version. Compiled for some devices, the
  kernels report no error and leave all liquid in the cup; such an engine is refused.

This module has no slow imports.
"""

from __future__ import annotations

import contextlib
import ctypes
import functools
import importlib.metadata
import importlib.util
import logging
import os
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from sim_engine.errors import EngineError, WrongOutcomeError
from sim_engine.settings.plugin_registry import DISTRIBUTION

if TYPE_CHECKING:
    from sim_engine.outcome import PourOutcome
    from sim_engine.scene import PourTask

VARIABLE = "DECANT_ENGINE"

LONGEST_COMPILATION = 90.0
"""Longest wait for the kernels of another process [s], ten times the usual time."""

ENGINES = ("taichi", "quadrants")
"""Supported packages; without `DECANT_ENGINE` the first one that can be loaded is used."""

LIBRARIES = {"taichi": {"libX11.so.6": "libx11-6", "libz.so.1": "zlib1g"}}
"""Shared libraries that a wheel needs on Linux in addition to glibc, and the Debian packages that have them."""

_log = logging.getLogger(__name__)


def engine_name() -> str:
    """The package that compiles the solver.

    If an earlier one of `ENGINES` is installed and cannot be loaded, each process logs this once, with the remedy. Its
    child processes find the same libraries, and so use the same package.

    Raises:
        EngineError: `DECANT_ENGINE` names an unknown package, or none can be used; the text gives the remedy.
    """
    chosen = os.environ.get(VARIABLE)
    if chosen:
        if chosen not in ENGINES:
            raise EngineError(f"{VARIABLE}={chosen}: there is no such engine; there are {' and '.join(ENGINES)}")
        if (problem := _problem(chosen)) is not None:
            raise EngineError(f"{VARIABLE}={chosen}: {problem}")
        return chosen
    problems = {name: _problem(name) for name in ENGINES}
    usable = next((name for name in ENGINES if problems[name] is None), None)
    if usable is None:
        raise EngineError(f"no engine can be used: {'; '.join(str(problem) for problem in problems.values())}")
    for name in ENGINES[: ENGINES.index(usable)]:
        if _is_installed(name):
            _report(f"{problems[name]}. {usable.title()} is used; outcomes agree within the spread of seeds")
    return usable


@functools.cache
def _report(text: str) -> None:
    _log.warning("%s", text)


def engine_version() -> str:
    """Name and version of the package that compiles the solver, for example 'taichi 1.7.4'; 'none' without one."""
    try:
        name = engine_name()
        return f"{name} {importlib.metadata.version(name)}"
    except (EngineError, importlib.metadata.PackageNotFoundError):
        return "none"


def _is_installed(name: str) -> bool:
    return importlib.util.find_spec(name) is not None


def _problem(name: str) -> str | None:
    """Why a package cannot be used on this machine, with the remedy; None if it can."""
    if not _is_installed(name):
        wanted = f"'{DISTRIBUTION}[{name}]'" if name == "quadrants" else name
        return f"the package '{name}' is not installed: pip install {wanted}"
    libraries = LIBRARIES.get(name, {}) if sys.platform == "linux" else {}
    missing = [library for library in libraries if not _is_loadable(library)]
    if missing:
        packages = " ".join(libraries[library] for library in missing)
        return f"{name.title()} can't be loaded without {' and '.join(missing)}: apt install {packages}"
    return None


def _is_loadable(library: str) -> bool:
    try:
        ctypes.CDLL(library)
    except OSError:
        return False
    return True


EXPECTED = {
    "retained": (0.51, 0.05),
    "received": (0.47, 0.10),
    "spilled": (0.025, 0.075),
    "compression": (0.004, 0.016),
}
"""Outcome of `check_task`, and the largest accepted deviations: fractions of the load, and the mean compression.

Means over 12 seeds; the standard deviations are 0.005, 0.013, 0.013 and below 0.0001. A scene that does not flow
retains 1.0; without density iterations the liquid is compressed."""


def check_task() -> PourTask:
    """The pour of the check: a straight cup is turned to 80° within half a second, and half of the liquid stays."""
    from sim_engine.action import DEG, Action
    from sim_engine.liquids import Liquid, SimulationParameters
    from sim_engine.scene import PourTask, Scene
    from sim_engine.vessel.shapes import cylinder

    scene = Scene(
        "check of the engine",
        cylinder("cup", inner_radius=0.04, inner_height=0.1),
        cylinder("glass", inner_radius=0.045, inner_height=0.09),
        Liquid(mass=0.2),
    )
    action = Action(angular_velocity=180 * DEG, x_offset=0.08, height=0.11, max_angle=80 * DEG, hold_time=0.1)
    return PourTask(scene, action, SimulationParameters(particles=200), seed=1)


@contextlib.contextmanager
def compiling_alone(cancelled: Callable[[], bool]) -> Iterator[None]:
    """Context of a process's first pours: on a machine that has no kernels yet, one process compiles them at a time.

    Compiling takes eight seconds of a core, and loading what another process has compiled takes one. If the cache
    cannot be written, or if the others take longer than `LONGEST_COMPILATION`, each process compiles.

    Args:
        cancelled: ends the wait for another process.
    """
    with contextlib.ExitStack() as held:
        with contextlib.suppress(ImportError, OSError, EngineError):
            import fcntl  # Windows has none

            record = _record()
            lock = held.enter_context((record.parent / "compiling").open("a", encoding="utf-8"))
            end = time.monotonic() + LONGEST_COMPILATION
            while not cancelled() and time.monotonic() < end:
                try:
                    fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                    break
                except BlockingIOError:
                    time.sleep(0.1)
            if record.exists():
                held.close()
        yield


def _record() -> Path:
    """The file that says that this version of engine and solver has passed its check on this machine."""
    from sim_engine.resources import cache_directory
    from sim_engine.solver_fingerprint import ROOT, folder_digest

    solver = folder_digest(ROOT / "sim_engine" / "fluid")
    return cache_directory() / f"checked-{engine_version().replace(' ', '-')}-{solver}.txt"


def check_engine(pour: Callable[[PourTask], PourOutcome]) -> None:
    """Compare a pour with its stored outcome, unless a record in the cache says that this version has passed.

    A changed solver or another version of the package is checked again.

    Args:
        pour: simulates with the engine of this process.

    Raises:
        WrongOutcomeError: the outcome lies outside the accepted deviations.
    """
    from sim_engine.resources import cache_directory

    version, record = engine_version(), _record()
    if record.exists():
        return
    outcome = pour(check_task())
    problem = outcome.invalid or _deviation(outcome)
    if problem is not None:
        raise WrongOutcomeError(
            f"{version} gives a wrong outcome on this machine, so that nothing is simulated with it: {problem}. Delete "
            f"its compiled kernels in {cache_directory()}; if that does not help, use another engine ({VARIABLE}, one "
            f"of: {', '.join(ENGINES)}) or the version that Decant requires"
        )
    try:
        record.write_text(f"{outcome.received:.4f} received, {outcome.retained:.4f} retained\n", encoding="utf-8")
    except OSError:  # a full or read-only disk costs time on the next start, not now
        return


def _deviation(outcome: PourOutcome) -> str | None:
    """The first quantity of the check that deviates too much, as a message."""
    values = {
        "retained": outcome.retained,
        "received": outcome.received,
        "spilled": outcome.spilled,
        "compression": outcome.density_error,
    }
    for name, (expected, most) in EXPECTED.items():
        if not abs(values[name] - expected) <= most:  # NaN deviates, too
            return f"{name} {values[name]:.3g} in the check's pour instead of {expected:g} ± {most:g}"
    return None
