"""What is installed: the wheel's content, and an installation without the extras."""

from __future__ import annotations

import importlib.metadata
import json
import mmap
import os
import re
import struct
import subprocess
import sys
import tomllib
import venv
import zipfile
from pathlib import Path

import pytest

from actors.runtime.child_process import child_environment
from orchestrator.campaigns.shipped import STARTING_SET
from sim_engine.engine_package import LIBRARIES
from sim_engine.resources import EXTRAS
from tests.plugins import test_plugins as example

ROOT = Path(__file__).parents[1]

BLOCKED = f"""
import sys
class Missing:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in {sorted(EXTRAS)}:
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)
sys.meta_path.insert(0, Missing())
import importlib.util
real = importlib.util.find_spec
importlib.util.find_spec = lambda name, package=None: None if name in {sorted(EXTRAS)} else real(name, package)
"""
"""As if no extra were installed."""


HARNESS = """
from decant.plugins import DeploymentPlan, Loss
from decant.plugins.testing import ACTIONS, SCENE, THETA, StrategyHarness, check_strategy
from orchestrator.learning.deployment.d2 import D2Settings

def spill(action, theta, rng):
    return abs(action.x_offset - 0.12)

def make():
    plan = DeploymentPlan(D2Settings(pours=3), (SCENE,), ACTIONS, Loss())
    return plan.settings.build(plan, SCENE, THETA, 1)

check_strategy(make, spill)
print(len(StrategyHarness(spill).run(make()).pours), "pours")
"""
"""What the author of a strategy tests it with."""

CONTRACT = """
import pytest
from actors.arm.arm_settings import arm_kind
from actors.arm.simulated_arm import SimulatedArmSettings, SimulatedArm
from decant.plugins.testing import ACTIONS, SCENE, ArmBench, ArmContract

class TestMyArm(ArmContract):
    @pytest.fixture
    def bench(self):
        spec = SimulatedArmSettings(time_scale=20.0)
        arm = SimulatedArm(spec)
        path = arm_kind(spec).plan(SCENE, SCENE.action(ACTIONS.decode([0.8, 0.5]) | {"max_angle": 1.7}))
        yield ArmBench(arm, path, time_scale=20.0)
        arm.close()
"""
"""What the author of an arm tests it with."""

A_FEW = "who_it_is or whole_pour or lost_during"


def run(code: str, folder: Path) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    return subprocess.run(
        [sys.executable, "-c", code], cwd=folder, env=environment, capture_output=True, text=True, timeout=280
    )


def command(*arguments: str) -> str:
    return f"{BLOCKED}\nfrom orchestrator.cli.app import main\nsys.argv = {['decant', *arguments]!r}\nmain()"


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Built from a copy of what git knows, so that the checkout stays clean."""
    source, out = tmp_path_factory.mktemp("source"), tmp_path_factory.mktemp("wheel")
    listed = subprocess.run(
        ["git", "ls-files", "--cached", "--others", "--exclude-standard"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        env=child_environment(),
    )
    for name in listed.stdout.splitlines():
        if (ROOT / name).is_file() and not name.startswith(("tests/", "benchmarks/", "docs/")):
            target = source / name
            target.parent.mkdir(parents=True, exist_ok=True)
            target.write_bytes((ROOT / name).read_bytes())
    built = subprocess.run(
        [sys.executable, "-m", "pip", "wheel", "--no-deps", "--no-build-isolation", "-q", "-w", str(out), str(source)],
        capture_output=True,
        text=True,
        env=child_environment(),
    )
    assert built.returncode == 0, built.stderr[-2000:]
    (path,) = out.glob("*.whl")
    return path


def test_the_wheel_carries_every_shipped_file_and_no_tests(wheel: Path) -> None:
    names = set(zipfile.ZipFile(wheel).namelist())
    for name in STARTING_SET:
        files = [ROOT / "configs" / name]
        if files[0].is_dir():
            files = [path for path in files[0].rglob("*") if path.is_file()]
        assert {f"orchestrator/configs/{path.relative_to(ROOT / 'configs')}" for path in files} <= names
    assert {"decant/__init__.py", "decant/py.typed"} <= names
    assert not [name for name in names if name.split("/")[0] in ("tests", "benchmarks", "docs")]


@pytest.mark.slow
def test_authors_of_plug_ins_test_them_with_what_the_wheel_carries(wheel: Path, tmp_path: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(tmp_path / "site")
    (tmp_path / "test_my_arm.py").write_text(CONTRACT, encoding="utf-8")
    environment = {**os.environ, "PYTHONPATH": str(tmp_path / "site")}

    def python(*arguments: str) -> str:
        done = subprocess.run(
            [sys.executable, *arguments], cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=280
        )
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout

    where = "import decant.plugins.testing as t, orchestrator.runs.strategy_harness as h; print(t.__file__, h.__file__)"
    assert python("-c", where).split() == [
        str(tmp_path / "site" / name) for name in ("decant/plugins/testing.py", "orchestrator/runs/strategy_harness.py")
    ]
    assert "3 pours" in python("-c", HARNESS)
    reported = python("-m", "pytest", "-q", "-rs", "-p", "no:cacheprovider", "-k", A_FEW, "test_my_arm.py")
    assert "2 passed, 1 skipped" in reported
    assert "ArmBench.cut is missing" in reported


@pytest.mark.slow
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("python", ["python3.11", "python3.13"])
def test_the_wheel_with_all_extras_runs_the_quickstart_in_an_empty_environment(
    wheel: Path, tmp_path: Path, python: str
) -> None:
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    if not starts(python):
        pytest.skip(f"{python} is not installed")

    def done(*command: str | Path, timeout: float = 600.0) -> str:
        ended = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=timeout)
        assert ended.returncode == 0, ended.stdout[-2000:] + ended.stderr[-2000:]
        return ended.stdout

    done(python, "-m", "venv", "empty")
    programs = tmp_path / "empty" / "bin"
    done(programs / "python", "-m", "pip", "install", "-q", f"{wheel}[all]", timeout=1800.0)
    assert done(programs / "decant", "--version").split() == ["decant", wheel.name.split("-")[1]]
    done(programs / "decant", "init", "lab")
    campaign = "lab/campaigns/quickstart.yaml"
    assert "ok (campaign" in done(programs / "decant", "validate", campaign)
    done(programs / "decant", "run", campaign, "--quiet", timeout=1800.0)
    (run,) = (tmp_path / "runs").glob("quickstart-*")
    assert {"report.html", "theta.json"} <= {path.name for path in run.iterdir()}
    assert list(run.glob("*.rrd"))


def starts(python: str) -> bool:
    """Whether there is such an interpreter; a version manager's may only say that there is none."""
    try:
        command = [python, "--version"]
        return subprocess.run(command, env=child_environment(), capture_output=True, check=False).returncode == 0
    except FileNotFoundError:
        return False


def test_the_wheel_has_the_version_of_the_newest_release_without_a_repository(wheel: Path) -> None:
    """The wheel of this test is built from files; one of a repository counts the commits after the release."""
    released = re.search(r"^## \[(\d+\.\d+\.\d+)\]", (ROOT / "CHANGELOG.md").read_text("utf-8"), re.MULTILINE)
    assert released is not None
    assert wheel.name.split("-")[1] == released[1]


def test_every_package_of_an_extra_is_declared_in_it() -> None:
    declared = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    package = {"serial": "pyserial", "rerun": "rerun-sdk"}
    package |= {"prometheus_client": "prometheus-client", "pythonjsonlogger": "python-json-logger"}
    package |= {"skimage": "scikit-image", "pinocchio": "pin>", "franky_sim": "franky-sim"}
    for module, extra in EXTRAS.items():
        name = package.get(module, module)
        assert any(text.startswith(name) for text in declared["optional-dependencies"][extra]), name
        assert not any(text.startswith(name) for text in declared["dependencies"]), name


BARE = {
    *("libc.so.6", "libdl.so.2", "libm.so.6", "libpthread.so.0", "librt.so.1", "libutil.so.1"),
    *("libgcc_s.so.1", "libstdc++.so.6", "libz.so.1"),
}
"""Shared libraries of a Debian that has Python and apt and nothing else."""


def needed_libraries(path: Path) -> set[str]:
    """The shared libraries that one of 64 bits names. Source: elf(5), DT_NEEDED."""
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
        if data[:6] != b"\x7fELF\x02\x01":
            return set()
        begin, (size, count) = struct.unpack_from("<Q", data, 32)[0], struct.unpack_from("<HH", data, 54)
        headers = [struct.unpack_from("<IIQQQQ", data, begin + size * n) for n in range(count)]
        dynamic = next((data[offset : offset + length] for kind, _, offset, _, _, length in headers if kind == 2), b"")
        entries = list(struct.iter_unpack("<qQ", dynamic))
        names = next((value for tag, value in entries if tag == 5), 0)
        loaded = [(at, offset, length) for kind, _, offset, at, _, length in headers if kind == 1]
        strings = next((names - at + offset for at, offset, length in loaded if at <= names < at + length), 0)
        ends = {strings + value: data.find(b"\0", strings + value) for tag, value in entries if tag == 1}
        return {data[first:end].decode() for first, end in ends.items()}


@pytest.mark.skipif(sys.platform != "linux", reason="shared libraries of Linux")
def test_installed_packages_need_no_shared_library_that_a_bare_debian_lacks() -> None:
    """Else a machine without a desktop fails at the first import. What Taichi lacks there is known and replaced."""
    paths = [
        (distribution.name, path)
        for distribution in importlib.metadata.distributions()
        for path in map(Path, map(distribution.locate_file, distribution.files or []))
        if ".so" in path.suffixes and path.is_file()
    ]
    assert len(paths) > 100
    contained = {path.name for _, path in paths}
    missing: dict[str, set[str]] = {}
    for package, path in paths:
        libraries = {name for name in needed_libraries(path) if not name.startswith("ld-linux")}
        if libraries - BARE - contained:
            missing.setdefault(package, set()).update(libraries - BARE - contained)
    assert missing.pop("taichi", set()) <= set(LIBRARIES["taichi"])
    assert missing == {}


@pytest.mark.slow
def test_without_extras_one_simulates_and_plans(tmp_path: Path) -> None:
    done = run(command("init", "lab"), tmp_path)
    assert done.returncode == 0, done.stderr
    small = ["--set", "angular_velocity=100", "--set", "x_offset=110", "--seeds", "1"]
    theta = tmp_path / "theta.json"
    theta.write_text('{"particles": 250}', encoding="utf-8")
    campaign = "lab/campaigns/quickstart.yaml"
    done = run(command("simulate", campaign, *small, "--parameters", str(theta)), tmp_path)
    assert done.returncode == 0, done.stderr
    assert "received" in done.stdout
    planning = ["plan", campaign, "--parameters", str(theta), "--iterations", "2", "--seeds", "2"]
    done = run(command(*planning, "--in-process"), tmp_path)
    assert done.returncode == 0, done.stderr
    assert "pip install 'decant-pouring[live]'" in done.stderr, "a recording was wanted"
    assert run(command(*planning), tmp_path).returncode == 0, "plain processes need no Ray"
    done = run(command("calibrate", campaign), tmp_path)
    assert done.returncode == 2
    assert "pip install 'decant-pouring[lab]'" in done.stderr


@pytest.mark.slow
def test_without_extras_a_table_says_what_to_install(tmp_path: Path) -> None:
    code = f"{BLOCKED}\nfrom decant.run_results import table_of\ntable_of([])"
    done = run(code, tmp_path)
    assert "pip install 'decant-pouring[tables]'" in done.stderr


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_the_wheel_works_in_a_bare_environment(wheel: Path, tmp_path: Path) -> None:
    venv.create(tmp_path / "bare", with_pip=True)
    python = tmp_path / "bare" / "bin" / "python"
    subprocess.run(
        [python, "-m", "pip", "install", "-q", str(wheel)],
        check=True,
        cwd=tmp_path,
        timeout=1500,
        env=child_environment(),
    )
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}

    def decant(*arguments: str) -> subprocess.CompletedProcess[str]:
        command = [tmp_path / "bare" / "bin" / "decant", *arguments]
        return subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=300)

    assert decant("init", "lab").returncode == 0
    (tmp_path / "theta.json").write_text('{"particles": 250}', encoding="utf-8")
    campaign = ["lab/campaigns/quickstart.yaml", "--parameters", "theta.json"]
    done = decant("simulate", *campaign, "--set", "angular_velocity=100", "--set", "x_offset=110", "--seeds", "1")
    assert done.returncode == 0, done.stderr
    done = decant("plan", *campaign, "--iterations", "2", "--seeds", "2", "--in-process")
    assert done.returncode == 0, done.stderr
    assert "decant-pouring[lab]" in decant("run", "lab/campaigns/quickstart.yaml").stderr

    def run_python(*arguments: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [python, *arguments], cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=300
        )

    done = run_python("-c", HARNESS)
    assert "3 pours" in done.stdout, done.stderr
    assert "pip install pytest" in run_python("-c", "from decant.plugins.testing import ArmContract").stderr
    command = [python, "-m", "pip", "install", "-q", "pytest"]
    subprocess.run(command, check=True, cwd=tmp_path, timeout=600, env=child_environment())
    (tmp_path / "test_my_arm.py").write_text(CONTRACT, encoding="utf-8")
    done = run_python("-m", "pytest", "-q", "-p", "no:cacheprovider", "-k", A_FEW, "test_my_arm.py")
    assert "2 passed, 1 skipped" in done.stdout, done.stdout + done.stderr

    (packages,) = (tmp_path / "bare").glob("lib/python3*/site-packages")
    (tmp_path / "example").mkdir()
    example.install_example(packages, tmp_path / "example")
    listed = json.loads(decant("plugins", "--json").stdout)
    registered = {one["name"] for one in listed["plugins"] if one["package"] == "decant-example 1.0"}
    declared = tomllib.loads((ROOT / "tests" / "plugins" / "pyproject.toml").read_text(encoding="utf-8"))
    assert registered == {name for group in declared["project"]["entry-points"].values() for name in group}
    assert listed["broken"] == []
    example.write_files(tmp_path)
    wide = example.CAMPAIGN.replace("x_offset: [60 mm, 90 mm]", "x_offset: [100 mm, 130 mm]")
    (tmp_path / "campaign.yaml").write_text(wide, encoding="utf-8")
    done = decant("run", "campaign.yaml", "--json")
    assert done.returncode == 0, done.stderr
    (folder,) = (tmp_path / "runs").glob("outside-*")
    assert json.loads((folder / "summary.json").read_text(encoding="utf-8"))["pours"] == 2
    assert "decant-example" in json.loads((folder / "versions.json").read_text(encoding="utf-8"))["packages"]
    for name in ("test_examples.py", "test_stand.py"):
        text = (ROOT / "tests" / "plugins" / name).read_text(encoding="utf-8")
        (tmp_path / name).write_text(text.replace("tests.plugins.decant_example", "decant_example"), encoding="utf-8")
    tests = ("-k", "not is_found", "test_examples.py", "test_stand.py")
    done = run_python("-m", "pytest", "-q", "-p", "no:cacheprovider", *tests)
    assert done.returncode == 0, done.stdout + done.stderr
