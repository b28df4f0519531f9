"""`install.py`: what stops it is one sentence and exit code 2, and what it left behind is not believed in."""

from __future__ import annotations

import collections
import fcntl
import os
import re
import shutil
import signal
import subprocess
import sys
import tomllib
import venv
from pathlib import Path

import pytest

from actors.runtime.child_process import child_environment
from tests.support.waiting import PATIENCE

ROOT = Path(__file__).parents[1]

LOCK = r"""numpy==2.4.6 \
    --hash=sha256:00 \
    --hash=sha256:01
ray==2.60.0 ; python_full_version < '3.15' \
    --hash=sha256:02
"""

FAKE_PIP = """
import os, pathlib, shutil, signal, sys

packages = pathlib.Path(__file__).parents[1]
print("pip", *sys.argv[1:])
if "-r" in sys.argv:
    lock = pathlib.Path(sys.argv[-1]).read_text()
    for line in lock.splitlines():
        name = line.partition("==")[0]
        done = packages / f"{name}-1.dist-info"
        if line.startswith(" ") or done.exists():
            continue
        done.mkdir()
        if name == os.environ.get("KILLED_AT"):
            os.kill(os.getpid(), signal.SIGKILL)
        (done / "INSTALLER").write_text("pip")
        print("installed", name)
print(os.environ.get("PIP_SAYS", ""))
sys.exit(1 if "PIP_SAYS" in os.environ else 0)
"""
"""A pip that installs nothing but records, says what a test wants it to say, or is killed at a package."""

NO_NETWORK = """WARNING: Retrying (Retry(total=0, connect=None, read=None, redirect=None, status=None)) after connection broken by 'NewConnectionError('<pip._vendor.urllib3.connection.HTTPSConnection object at 0x7f0e>: Failed to establish a new connection: [Errno -3] Temporary failure in name resolution')': /simple/numpy/
ERROR: Could not find a version that satisfies the requirement numpy==2.4.6 (from versions: none)
ERROR: No matching distribution found for numpy==2.4.6"""  # noqa: E501

INTERRUPTED_DOWNLOAD = """ERROR: Could not install packages due to an OSError: HTTPSConnectionPool(host='files.pythonhosted.org', port=443): Max retries exceeded with url: /packages/2c/numpy.whl (Caused by NewConnectionError)"""  # noqa: E501

LOGIN_PAGE = """ERROR: Could not find a version that satisfies the requirement numpy==2.4.6 (from versions: none)
ERROR: No matching distribution found for numpy==2.4.6"""

FULL_DISK = "ERROR: Could not install packages due to an OSError: [Errno 28] No space left on device"

CHANGED_FILE = """ERROR: THESE PACKAGES DO NOT MATCH THE HASHES FROM THE REQUIREMENTS FILE. If you have updated the package
    numpy==2.4.6 from https://files.pythonhosted.org/packages/numpy.whl:
        Expected sha256 00
             Got        5f"""  # noqa: E501

LOST_RECORD = """error: uninstall-no-record-file
× Cannot uninstall numpy 2.4.5
╰─> The package's contents are unknown: no RECORD file was found for numpy."""


@pytest.fixture
def project(tmp_path: Path) -> Path:
    """A folder with `install.py`, two packages in the lock, and an environment whose pip is the fake one."""
    shutil.copy(ROOT / "install.py", tmp_path)
    (tmp_path / "pyproject.toml").touch()
    for lock in ("requirements.lock", "requirements-test.lock"):
        (tmp_path / lock).write_text(LOCK, encoding="utf-8")
    venv.create(tmp_path / ".venv", symlinks=True)
    pip = packages(tmp_path) / "pip"
    pip.mkdir()
    (pip / "__init__.py").touch()
    (pip / "__main__.py").write_text(FAKE_PIP, encoding="utf-8")
    record = packages(tmp_path) / "pip-1.dist-info"
    record.mkdir()
    (record / "METADATA").write_text("Name: pip\nVersion: 1\n", encoding="utf-8")
    (record / "INSTALLER").write_text("pip\n", encoding="utf-8")
    return tmp_path


def packages(project: Path) -> Path:
    return next((project / ".venv" / "lib").glob("python3*")) / "site-packages"


def install(project: Path, need: str = "program", python: str = sys.executable, **environment: str) -> tuple[int, str]:
    """Exit code, and what the user sees."""
    command = [python, str(project / "install.py"), need]
    done = subprocess.run(
        command, env=os.environ | environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
        timeout=PATIENCE,
    )  # fmt: skip
    return done.returncode, done.stdout


def stopped(output: str) -> str:
    """The one sentence."""
    (sentence,) = re.findall(r"^set-up stopped: (.*)$", output, re.MULTILINE)
    return str(sentence)


def test_each_stage_says_what_it_installs(project: Path) -> None:
    code, output = install(project)
    assert code == 0, output
    assert "2 packages for the program" in output
    assert "2/2: numpy to ray" in output
    assert (project / ".venv" / ".ready").is_file()
    assert "Sphinx" not in output
    code, output = install(project, "test")
    assert code == 0, output
    assert "2 packages for the tests" in output
    assert (project / ".venv" / ".ready-test").is_file()


@pytest.mark.parametrize(
    ("said", "sentence"),
    [
        (NO_NETWORK, "the package index can't be reached; check the network"),
        (INTERRUPTED_DOWNLOAD, "the package index can't be reached; check the network"),
        (LOGIN_PAGE, "the package index offers no numpy==2.4.6 for this Python; is there a login page"),
        (FULL_DISK, "the disk is full: "),
        (CHANGED_FILE, "a downloaded file is not the one of requirements.lock"),
        (LOST_RECORD, "no RECORD file was found for numpy."),
    ],
    ids=["no network", "download interrupted", "login page", "full disk", "changed file", "anything else"],
)
def test_what_pip_reports_becomes_one_sentence(project: Path, said: str, sentence: str) -> None:
    code, output = install(project, PIP_SAYS=said)
    assert code == 2, output
    assert sentence in stopped(output)
    assert "run the same command again to continue; details: .venv/pip.log" in output
    assert said in (project / ".venv" / "pip.log").read_text(encoding="utf-8")
    assert not (project / ".venv" / ".ready").exists()


def test_a_killed_pip_leaves_nothing_that_the_next_one_believes_in(project: Path) -> None:
    code, output = install(project, KILLED_AT="ray")
    assert code == 2, output
    assert f"pip was ended by signal {int(signal.SIGKILL)}" in stopped(output)
    assert (packages(project) / "ray-1.dist-info").is_dir()
    code, output = install(project)
    assert code == 0, output
    log = (project / ".venv" / "pip.log").read_text(encoding="utf-8")
    assert "installed ray" in log
    assert "installed numpy" not in log, "what was finished is kept"


def test_what_an_interrupted_upgrade_moved_away_is_removed(project: Path) -> None:
    (packages(project) / "~umpy").mkdir()
    assert install(project)[0] == 0
    assert not (packages(project) / "~umpy").exists()


def test_an_environment_whose_pip_is_unfinished_is_made_again(project: Path) -> None:
    (packages(project) / "pip-1.dist-info" / "INSTALLER").unlink()
    (project / "venv.py").write_text("raise SystemExit('Error: no space left on device')", encoding="utf-8")
    code, output = install(project)
    assert code == 2, output
    assert "set-up: the environment .venv" in output
    assert "the environment was not made: Error: no space left" in stopped(output)


def test_quadrants_is_installed_where_taichi_cannot_be_loaded(project: Path) -> None:
    with (project / "requirements-test.lock").open("a", encoding="utf-8") as lock:
        lock.write("quadrants==1.3.3 \\\n    --hash=sha256:03\n")
    code, output = install(project)
    assert code == 0, output
    assert "Quadrants, because Taichi can't be loaded here" in output  # the folder has no engine at all
    assert (packages(project) / "quadrants-1.dist-info").is_dir()
    engine = project / "sim_engine" / "engine_package.py"
    engine.parent.mkdir()
    engine.write_text("def engine_name(): return 'taichi'", encoding="utf-8")
    assert "Quadrants" not in install(project)[1]


def test_two_commands_at_once(project: Path) -> None:
    with (project / "pyproject.toml").open("rb") as held:
        fcntl.flock(held, fcntl.LOCK_EX)
        code, output = install(project)
    assert code == 2, output
    assert f"another command sets up {project / '.venv'} at this moment" in stopped(output)
    assert not (project / ".venv" / ".ready").exists()


def test_a_disk_without_room_is_refused_before_anything_is_made(project: Path) -> None:
    shutil.rmtree(project / ".venv")
    limited = "import shutil, runpy, sys; shutil.disk_usage = lambda f: type('U', (), {'free': 4e8}); " + (
        "sys.argv = ['install.py', 'program']; runpy.run_path('install.py', run_name='__main__')"
    )
    done = subprocess.run(
        [sys.executable, "-c", limited],
        cwd=project,
        capture_output=True,
        text=True,
        timeout=PATIENCE,
        env=child_environment(),
    )
    assert done.returncode == 2
    assert stopped(done.stderr) == f"{project} has 0.4 GB of free space, the environment needs 1.5 GB"
    assert not (project / ".venv").exists()


def test_a_python_without_ensurepip_is_named(project: Path) -> None:
    shutil.rmtree(project / ".venv")
    without = "import importlib.util as u, runpy, sys; real = u.find_spec; " + (
        "u.find_spec = lambda name, *more: None if name == 'ensurepip' else real(name, *more); "
        "sys.argv = ['install.py', 'program']; runpy.run_path('install.py', run_name='__main__')"
    )
    done = subprocess.run(
        [sys.executable, "-c", without],
        cwd=project,
        capture_output=True,
        text=True,
        timeout=PATIENCE,
        env=child_environment(),
    )
    assert done.returncode == 2
    assert "makes no environments; on Debian and Ubuntu: apt install python3-venv" in stopped(done.stderr)
    assert not (project / ".venv").exists()


def test_the_locks_agree_and_the_program_needs_no_tools_of_its_tests() -> None:
    pins: dict[str, dict[str, set[str]]] = {}
    for lock in ("requirements.lock", "requirements-test.lock", "requirements-docs.lock"):
        versions = pins.setdefault(lock, collections.defaultdict(set))
        for name, version in re.findall(
            r"^([a-z0-9._-]+)==(\S+)", (ROOT / lock).read_text(encoding="utf-8"), re.MULTILINE
        ):
            versions[name].add(version)
    program, test, docs = pins.values()
    assert set(program) <= set(test) & set(docs), "each lock holds the program: make lock"
    for other in (test, docs):
        assert [name for name in program if not program[name] <= other[name]] == [], "make lock"
    groups = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["dependency-groups"]
    tools = {re.split(r"[>=<]", line)[0] for group in ("test", "docs") for line in groups[group]}
    assert tools & set(program) == {"jsonschema"}, "which Ray needs"
