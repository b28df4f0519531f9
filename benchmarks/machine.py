"""Description of the machine and time of a measurement, and helpers to run it."""

from __future__ import annotations

import ctypes
import datetime
import functools
import json
import os
import platform
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
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
    """Print the result to stdout as JSON: on one line, or indented."""
    print(json.dumps(result, indent=None if as_json else 1, ensure_ascii=False))


def started(command: Sequence[str | Path], **options: Any) -> subprocess.Popen[bytes]:
    """Start a process that receives SIGTERM when this one ends, even if this one is killed (Linux)."""

    def follow() -> None:
        if sys.platform == "linux":
            ctypes.CDLL(None).prctl(1, signal.SIGTERM)  # PR_SET_PDEATHSIG

    return subprocess.Popen(list(command), preexec_fn=follow, **options)  # noqa: PLW1509  no thread runs yet


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
    child = started(command, stdout=subprocess.PIPE, env=environment)
    printed, _ = child.communicate()
    if child.returncode != 0:
        raise SystemExit(f"{Path(script).name} {' '.join(arguments)} ended with {child.returncode}")
    result: dict[str, Any] = json.loads(printed.strip().splitlines()[-1])
    return result


def run_decant(*words: str | Path, environment: dict[str, str]) -> tuple[str, float, float]:
    """Run the command line in a new process; return its stdout, and its wall and CPU seconds.

    Raises:
        SystemExit: it failed; the message has its words and its messages.
    """
    command = [sys.executable, "-c", "from orchestrator.cli.app import main; main()", *map(str, words)]
    before, begun = os.times(), time.monotonic()
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False)
    after, seconds = os.times(), time.monotonic() - begun
    if done.returncode != 0:
        raise SystemExit(f"decant {' '.join(map(str, words))}: {done.stderr}")
    spent = after.children_user + after.children_system - before.children_user - before.children_system
    return done.stdout, seconds, spent


class KeptRows:
    """Results of finished runs in a file of JSON lines, so that an interrupted comparison continues.

    Attributes:
        rows: all rows, oldest first.
    """

    def __init__(self, file: Path) -> None:
        self._file = file
        lines = file.read_text(encoding="utf-8").splitlines() if file.exists() else []
        self.rows: list[dict[str, Any]] = [json.loads(line) for line in lines]

    def add(self, *rows: dict[str, Any]) -> None:
        """Append rows, and write them at once."""
        self.rows += rows
        with self._file.open("a", encoding="utf-8") as file:
            file.writelines(json.dumps(row) + "\n" for row in rows)


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
