"""Installs what one need of the project asks for into `.venv`: `make install`, `make test` and `make docs` call it.

    python3 install.py program    # what `decant` needs: requirements.lock
    python3 install.py test       # also lint, types and tests: requirements-test.lock
    python3 install.py docs       # also the site: requirements-docs.lock

It uses the standard library alone, and parses on every Python 3, so that an old one is refused with a sentence.
Packages are installed in batches, and one counts once pip has finished it, so that the next call continues where an
interrupted one was. What stops it is reported in one sentence, with exit code 2; pip's output is in `.venv/pip.log`.
"""

import fcntl
import importlib.util
import os
import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import NamedTuple, NoReturn

ROOT = Path(__file__).resolve().parent
VENV = Path(".venv")
LOG = VENV / "pip.log"
PYTHONS = ((3, 11), (3, 14))


class Need(NamedTuple):
    """What is installed for one purpose."""

    lock: str
    content: str
    gigabytes: float
    """What it takes in the environment, rounded up."""
    finished: str
    """The file that says that all of it is installed, the target of make."""


PROGRAM = Need("requirements.lock", "the program: simulator, optimiser, devices, daemon, recordings", 1.5, ".ready")
NEEDS = {
    "program": PROGRAM,
    "test": Need("requirements-test.lock", "the tests: lint, types, browser, notebook, Quadrants", 0.6, ".ready-test"),
    "docs": Need("requirements-docs.lock", "the site: Sphinx and its theme", 0.1, ".ready-docs"),
}

QUADRANTS = ("cffi", "pycparser", "quadrants")
"""The other engine with what only it needs. The tests' lock has them; the program's has them on Python 3.14 alone."""

BATCH = 12
"""Packages that one call of pip installs: what an interruption costs at most, in exchange for a second a call."""

CAUSES = (
    (r"No space left on device|Disk quota exceeded|Errno (?:28|122)\b", "the disk is full: {space}"),
    (r"DO NOT MATCH THE HASHES", "a downloaded file is not the one of {lock}: a proxy or a mirror changed it"),
    (
        r"connection broken by|Max retries exceeded|Failed to establish a new connection|Read timed out"
        r"|Temporary failure in name resolution|IncompleteRead|ProxyError|SSLError",
        "the package index can't be reached; check the network, and pip's settings if there is a proxy or a mirror",
    ),
    (
        r"No matching distribution found for (?P<package>\S+)",
        "the package index offers no {package} for this Python; is there a login page or a mirror in between?",
    ),
)
"""What pip reports, and the sentence for it: the first that matches."""


CONTINUE = f"run the same command again to continue; details: {LOG}"


def stop(problem: str) -> NoReturn:
    """End with one sentence."""
    print(f"set-up stopped: {problem}", file=sys.stderr)
    sys.exit(2)


def check_python() -> None:
    """Refuse a Python that can't run Decant or that makes no environments."""
    version = sys.version_info[:2]
    if not PYTHONS[0] <= version <= PYTHONS[1]:
        stop(
            f"Decant needs Python 3.{PYTHONS[0][1]} to 3.{PYTHONS[1][1]}; this is {version[0]}.{version[1]}. "
            "Name another: make PYTHON=python3.12"
        )
    if not all(importlib.util.find_spec(module) for module in ("venv", "ensurepip")):
        stop(f"{sys.executable} makes no environments; on Debian and Ubuntu: apt install python3-venv")


def make_environment() -> None:
    """The environment with a pip of its own: made again if an earlier attempt did not come to its end."""
    python = VENV / "bin" / "python"
    sound = "import importlib.metadata as m; raise SystemExit(not m.distribution('pip').read_text('INSTALLER'))"
    if python.exists() and _run([str(python), "-c", sound]).returncode == 0:
        return
    free = shutil.disk_usage(ROOT).free / 1e9
    if free < PROGRAM.gigabytes:
        stop(f"{ROOT} has {free:.1f} GB of free space, the environment needs {PROGRAM.gigabytes} GB")
    version = ".".join(map(str, sys.version_info[:2]))
    print(f"set-up: the environment {VENV}, with Python {version}", flush=True)
    done = _run([sys.executable, "-m", "venv", "--clear", str(VENV)])
    if done.returncode != 0:
        _explain(done.stdout, "the environment was not made", PROGRAM)


def forget_unfinished() -> None:
    """Remove what an interrupted pip left of a package: its next call would take it for installed.

    The file INSTALLER of a package is written after all others.
    """
    for packages in VENV.glob("lib/python3*/site-packages"):
        for entry in packages.iterdir():
            unfinished = entry.name.endswith(".dist-info") and not (entry / "INSTALLER").is_file()
            if unfinished or entry.name.startswith("~"):
                shutil.rmtree(entry, ignore_errors=True)


def requirements_of(lock: str) -> "list[str]":
    """The packages of a lock, each with its hashes."""
    return re.findall(r"^[a-z0-9].*(?:\n +--hash=.*)*", Path(lock).read_text(encoding="utf-8"), re.MULTILINE)


def install(need: Need) -> None:
    """Install the packages of a lock that are missing, and say which."""
    requirements = requirements_of(need.lock)
    print(f"set-up: {len(requirements)} packages for {need.content} (about {need.gigabytes} GB)", flush=True)
    for start in range(0, len(requirements), BATCH):
        batch = requirements[start : start + BATCH]
        names = [line.partition("==")[0] for line in batch]
        print(f"  {start + len(batch)}/{len(requirements)}: {names[0]} to {names[-1]}", flush=True)
        pip_install(need, batch)


def install_decant() -> None:
    """Install Decant itself, and the other engine if Taichi can't be loaded here."""
    print("set-up: Decant itself, from this folder", flush=True)
    pip(PROGRAM, "install", "--no-deps", "--no-build-isolation", "-e", ".")
    usable = "from sim_engine.engine_package import engine_name; engine_name()"
    if _run([str(VENV / "bin" / "python"), "-c", usable]).returncode != 0:
        print("set-up: Quadrants, because Taichi can't be loaded here (0.1 GB)", flush=True)
        locked = requirements_of(NEEDS["test"].lock)
        pip_install(NEEDS["test"], [line for line in locked if line.partition("==")[0] in QUADRANTS])


def pip_install(need: Need, requirements: "list[str]") -> None:
    """Install packages of a lock in one call of pip."""
    with tempfile.NamedTemporaryFile("w", suffix=".txt", dir=VENV, encoding="utf-8") as file:
        file.write("\n".join(requirements) + "\n")
        file.flush()
        # The lock names every package, so pip resolves nothing. Modules are compiled when they are first imported:
        # most never are.
        pip(need, "install", "--no-compile", "--require-hashes", "--no-deps", "-r", file.name)


def pip(need: Need, *arguments: str) -> None:
    """One call of the environment's pip; its output goes to the log."""
    done = _run([str(VENV / "bin" / "python"), "-m", "pip", "--disable-pip-version-check", *arguments])
    with LOG.open("a", encoding="utf-8") as log:
        log.write(done.stdout)
    if done.returncode < 0:
        stop(f"pip was ended by signal {-done.returncode} ({CONTINUE})")
    if done.returncode != 0:
        _explain(done.stdout, f"pip {arguments[0]} failed", need)


def _explain(output: str, otherwise: str, need: Need) -> NoReturn:
    free = {str(folder): shutil.disk_usage(folder).free / 1e9 for folder in (ROOT, Path(tempfile.gettempdir()))}
    space = ", ".join(f"{folder} has {gigabytes:.1f} GB of free space" for folder, gigabytes in free.items())
    for pattern, problem in CAUSES:
        found = re.search(pattern, output)
        if found is not None:
            values = {"space": f"{space}; TMPDIR names another folder for pip", "lock": need.lock, **found.groupdict()}
            stop(f"{problem.format(**values)} ({CONTINUE})")
    lines = [line.strip() for line in output.splitlines() if line.strip() and not line.startswith("WARNING")]
    stop(f"{otherwise}: {lines[-1] if lines else 'no output'} ({CONTINUE})")


def _run(command: "list[str]") -> "subprocess.CompletedProcess[str]":
    return subprocess.run(
        command,
        check=False,
        close_fds=False,  # a pip whose parent was killed keeps the lock until it ends
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        errors="replace",
    )


def main(name: str) -> None:
    """Install what is asked for, or end with one sentence."""
    os.chdir(ROOT)
    need = NEEDS[name]
    check_python()
    with Path("pyproject.toml").open("rb") as only_one:
        try:
            fcntl.flock(only_one, fcntl.LOCK_EX | fcntl.LOCK_NB)
            os.set_inheritable(only_one.fileno(), True)
        except BlockingIOError:
            stop(f"another command sets up {ROOT / VENV} at this moment; run this one again when it has finished")
        make_environment()
        forget_unfinished()
        LOG.write_text("", encoding="utf-8")
        install(need)
        if need is PROGRAM:
            install_decant()
        pip(need, "check")
        (VENV / need.finished).touch()


if __name__ == "__main__":
    if len(sys.argv) != 2 or sys.argv[1] not in NEEDS:
        sys.exit(f"usage: python3 install.py {'|'.join(NEEDS)}")
    try:
        main(sys.argv[1])
    except KeyboardInterrupt:
        stop("interrupted; the same command continues where it was")
    except OSError as error:
        stop(f"{error.filename or VENV}: {error.strerror}")
