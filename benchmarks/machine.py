"""Where and when something was measured, and on which core."""

from __future__ import annotations

import datetime
import functools
import json
import os
import platform
import subprocess
import sys
from collections.abc import Iterator
from importlib.metadata import version
from pathlib import Path
from typing import Any

import psutil

from actors.runtime.child_process import child_environment
from sim_engine.resources import ENVIRONMENT_VARIABLE

ROOT = Path(__file__).resolve().parent.parent


def describe() -> dict[str, Any]:
    """Machine, software and moment: without them a figure means nothing."""
    return {
        "processor": _processor(),
        "cores": psutil.cpu_count(),
        "memory_gib": round(psutil.virtual_memory().total / 2**30, 1),
        "system": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
        "taichi": version("taichi"),
        "numpy": version("numpy"),
        "solver": _solver(),
        "fingerprint": _fingerprint(),
        "date": datetime.datetime.now(datetime.UTC).strftime("%Y-%m-%d %H:%M UTC"),
        "load_average": [round(load, 1) for load in psutil.getloadavg()],
    }


@functools.cache
def _fingerprint() -> str:
    from sim_engine.solver_fingerprint import solver_fingerprint

    return solver_fingerprint()


def pin(core: int | None) -> int | None:
    """Keep this process and its children on one core, so that all that is compared runs on the same.

    Args:
        core: its number; None takes the one with the least to do now.

    Returns:
        The core, or None where the system can't pin (macOS).

    Raises:
        SystemExit: there is no such core, with those that there are.
    """
    process = psutil.Process()
    if not hasattr(process, "cpu_affinity"):
        if core is not None:
            raise SystemExit(f"--core {core}: {platform.system()} can't keep a process on a core; leave it out")
        return None
    allowed = process.cpu_affinity()
    if core is None:
        busy = psutil.cpu_percent(interval=0.3, percpu=True)
        core = min(allowed, key=lambda k: busy[k] if k < len(busy) else 0.0)
    if core not in allowed:
        raise SystemExit(f"--core {core}: this process may use {', '.join(map(str, allowed))}")
    process.cpu_affinity([core])
    return core


def say(text: str) -> None:
    """Progress, on stderr: stdout is for the result alone."""
    print(text, file=sys.stderr, flush=True)


def show(result: dict[str, Any], as_json: bool) -> None:
    """The result on stdout: one line of JSON, or a line a value."""
    print(json.dumps(result) if as_json else "\n".join(_lines(result)))


def _lines(result: dict[str, Any], indent: str = "") -> Iterator[str]:
    for name, value in result.items():
        if isinstance(value, dict):
            yield f"{indent}{name}:"
            yield from _lines(value, indent + "    ")
        elif isinstance(value, list) and value and isinstance(value[0], dict):
            yield f"{indent}{name}:"
            for row in value:
                yield f"{indent}    " + ", ".join(f"{k} {v}" for k, v in row.items())
        else:
            yield f"{indent}{name:{max(32 - len(indent), 1)}s} {value}"


def run_self(script: str, *arguments: str, cache: Path | None = None) -> dict[str, Any]:
    """Run one of these scripts in a fresh process, single-threaded, and read the JSON it prints last.

    Args:
        script: its `__file__`.
        arguments: for it.
        cache: takes the place of the user's cache directory.

    Raises:
        SystemExit: it failed; what it had to say went to stderr.
    """
    environment = single_threaded()
    if cache is not None:
        environment[ENVIRONMENT_VARIABLE] = str(cache)
    command = [sys.executable, script, *arguments]
    done = subprocess.run(command, check=False, stdout=subprocess.PIPE, text=True, env=environment)
    if done.returncode != 0:
        raise SystemExit(f"{Path(script).name} {' '.join(arguments)} ended with {done.returncode}")
    result: dict[str, Any] = json.loads(done.stdout.strip().splitlines()[-1])
    return result


def single_threaded() -> dict[str, str]:
    """Environment for children: one thread for every library that would take more."""
    names = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
    return {**os.environ, **dict.fromkeys(names, "1")}


def as_a_second_time(kept: Path) -> dict[str, str]:
    """Environment for processes that find in a folder what the first of them left: bytecode, kernels, grids.

    Bytecode is kept also where the environment says otherwise: a user's second run finds it.
    """
    environment = {**os.environ, "PYTHONPYCACHEPREFIX": str(kept), ENVIRONMENT_VARIABLE: str(kept)}
    environment.pop("PYTHONDONTWRITEBYTECODE", None)
    return environment


def _processor() -> str:
    """Model name as the system tells it."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return platform.processor() or "unknown"
    told = dict(line.split(":", 1) for line in reversed(lines) if ":" in line)
    cleaned = {key.strip(): value.strip() for key, value in told.items()}
    family, model = cleaned.get("cpu family", "?"), cleaned.get("model", "?")
    return f"{cleaned.get('model name', 'unknown')} (family {family}, model {model})"


def _solver() -> str:
    """The last commit that changed the simulator, with a mark if the files differ from it."""

    def git(*arguments: str) -> str:
        command = ["git", "-C", str(ROOT), *arguments, "--", "sim_engine"]
        return subprocess.run(
            command, capture_output=True, text=True, check=True, env=child_environment()
        ).stdout.strip()

    try:
        return git("log", "-1", "--format=%h") + (" with changes" if git("status", "--porcelain") else "")
    except (OSError, subprocess.CalledProcessError):
        return "unknown"
