"""Description of the machine and time of a measurement, and helpers to run it."""

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
from sim_engine.engine_package import engine_version
from sim_engine.resources import ENVIRONMENT_VARIABLE

ROOT = Path(__file__).resolve().parent.parent
TABLES = ROOT / "docs" / "data" / "results.json"
"""Tables of the evidence pages; `docs/make_tables.py` puts them into the pages."""


def describe() -> dict[str, Any]:
    """Return machine, software and time of a measurement."""
    return {
        "processor": _processor(),
        "cores": psutil.cpu_count(),
        "memory_gib": round(psutil.virtual_memory().total / 2**30, 1),
        "system": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
        "engine": engine_version(),
        "numpy": version("numpy"),
        "solver": _solver(),
        "fingerprint": _fingerprint(),
        "date": datetime.datetime.now(datetime.UTC).strftime("%Y-%m-%d %H:%M UTC"),
        "load_average": [round(load, 1) for load in psutil.getloadavg()],
    }


def provenance(settings: str) -> dict[str, str]:
    """Return settings, date, version and machine of a measurement, as they stand below a table."""
    machine = describe()
    where = f"{machine['processor'].split(' (')[0]}, {machine['cores']} shared cores, {machine['system']}"
    return {
        "settings": settings,
        "date": machine["date"].split()[0],
        "version": version("decant-pouring"),
        "machine": f"{where}, Python {'.'.join(machine['python'].split('.')[:2])}",
    }


def write_table(name: str, head: list[str], rows: list[list[str]], command: str, settings: str) -> None:
    """Store a table of the evidence pages, with the command, settings, date, version and machine of its figures.

    Args:
        name: its key; the page names it in `<!-- table: result-NAME -->`.
        command: the command that repeats the measurement.
    """
    tables = json.loads(TABLES.read_text(encoding="utf-8"))
    tables[name] = {"head": head, "rows": rows, "command": command, **provenance(settings)}
    TABLES.write_text(json.dumps(tables, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")


@functools.cache
def _fingerprint() -> str:
    from sim_engine.solver_fingerprint import solver_fingerprint

    return solver_fingerprint()


def pin(core: int | None) -> int | None:
    """Pin this process and its children to one core, so that all compared programs use the same core.

    Args:
        core: its number; None takes the least busy one.

    Returns:
        The core, or None if the system cannot pin processes (macOS).

    Raises:
        SystemExit: the core does not exist; the message lists the available ones.
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
    """Print progress to stderr; stdout is for the result only."""
    print(text, file=sys.stderr, flush=True)


def show(result: dict[str, Any], as_json: bool) -> None:
    """Print the result to stdout: one line of JSON, or one line per value."""
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
    """Run one of these scripts in a new single-threaded process, and parse the JSON of its last line.

    Args:
        script: its `__file__`.
        arguments: its arguments.
        cache: replaces the user's cache directory.

    Raises:
        SystemExit: it failed; its messages are on stderr.
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
    """Return an environment for child processes with one thread for each multi-threaded library."""
    names = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
    return {**os.environ, **dict.fromkeys(names, "1")}


def as_a_second_time(kept: Path) -> dict[str, str]:
    """Return an environment for processes that share a cache folder for bytecode, kernels and grids.

    Bytecode is cached even if the current environment disables it, because a user's second run has it.
    """
    environment = {**os.environ, "PYTHONPYCACHEPREFIX": str(kept), ENVIRONMENT_VARIABLE: str(kept)}
    environment.pop("PYTHONDONTWRITEBYTECODE", None)
    return environment


def _processor() -> str:
    """Return the processor's model name as the system reports it."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return platform.processor() or "unknown"
    told = dict(line.split(":", 1) for line in reversed(lines) if ":" in line)
    cleaned = {key.strip(): value.strip() for key, value in told.items()}
    family, model = cleaned.get("cpu family", "?"), cleaned.get("model", "?")
    return f"{cleaned.get('model name', 'unknown')} (family {family}, model {model})"


def _solver() -> str:
    """Return the last commit that changed the simulator, with a mark if the files differ from it."""

    def git(*arguments: str) -> str:
        command = ["git", "-C", str(ROOT), *arguments, "--", "sim_engine"]
        return subprocess.run(
            command, capture_output=True, text=True, check=True, env=child_environment()
        ).stdout.strip()

    try:
        return git("log", "-1", "--format=%h") + (" with changes" if git("status", "--porcelain") else "")
    except (OSError, subprocess.CalledProcessError):
        return "unknown"
