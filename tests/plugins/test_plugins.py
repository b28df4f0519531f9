"""Packages from outside: one adds a thing of each kind and is run through a campaign, and one is broken."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from actors.runtime.child_process import child_environment
from tests.support import small_campaign
from tests.support.other_arm import SEVEN_JOINTS

ROOT = Path(__file__).parents[2]

Decant = Callable[..., subprocess.CompletedProcess[str]]


def install_example(site: Path, source: Path) -> None:
    """Install the example package into a folder of packages, from a copy in `source`, an empty folder."""
    install = [sys.executable, "-m", "pip", "install", "--no-deps", "--no-build-isolation", "--no-index", "--quiet"]
    shutil.copy(ROOT / "tests" / "plugins" / "pyproject.toml", source)
    shutil.copytree(ROOT / "tests" / "plugins" / "decant_example", source / "decant_example")
    subprocess.run([*install, "--target", str(site), str(source)], check=True, env=child_environment())


@pytest.fixture(scope="session")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The example, installed as any package is, in a folder of its own."""
    folder = tmp_path_factory.mktemp("site")
    install_example(folder, tmp_path_factory.mktemp("source"))
    return folder


@pytest.fixture(scope="session")
def broken(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A package whose module can't be loaded, and one entry that is nothing of the kind."""
    folder = tmp_path_factory.mktemp("broken")
    (folder / "decant_broken.py").write_text("NUMBER = 5\nimport something_that_is_not_installed\n")
    (folder / "decant_odd.py").write_text("NUMBER = 5\n")
    metadata = folder / "decant_broken-0.3.dist-info"
    metadata.mkdir()
    (metadata / "METADATA").write_text("Metadata-Version: 2.1\nName: decant-broken\nVersion: 0.3\n")
    (metadata / "entry_points.txt").write_text(
        "[decant.balances]\nelastic = decant_broken:Elastic\nkcp = decant_odd:NUMBER\n"
        "[decant.vessels]\nbottle = decant_odd:NUMBER\n[decant.strategies]\nguess = decant_broken:Guess\n"
    )
    return folder


def command(*folders: Path) -> Decant:
    def run(*words: str, cwd: Path = ROOT) -> subprocess.CompletedProcess[str]:
        path = os.pathsep.join([*map(str, folders), str(ROOT), os.environ.get("PYTHONPATH", "")])
        return subprocess.run(
            [sys.executable, "-c", "from orchestrator.cli.app import main; main()", *words],
            env={**os.environ, "PYTHONPATH": path},
            cwd=cwd,
            capture_output=True,
            text=True,
            timeout=280,
        )

    return run


@pytest.fixture(scope="session")
def decant(site: Path) -> Decant:
    """The command, with the example installed."""
    return command(site)


BENCH = """
bench: {liquid: {particles: 300, cohesion: 0.05 N/m}, time_scale: 60}
operator: {answers: virtual, time: 2 s}
"""

LABORATORY = (
    """
name: example
in_process: true
simulators: 1
arm: {kind: stand, fastest: 130 deg/s}
balance: {kind: spring, swing: 0.5 s, step: 0.1 g}
"""
    + BENCH
)

CONE = "name: cone-1\ncone: {top: 45 mm, bottom: 30 mm, height: 100 mm}\n"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A campaign that names the example's things."""
    write_files(tmp_path)
    return tmp_path


def write_files(folder: Path) -> None:
    """Write a laboratory and a vessel of the example, and the files that a campaign needs besides."""
    small_campaign.write_campaign(folder)
    (folder / "example.yaml").write_text(LABORATORY)
    (folder / "cone.yaml").write_text(CONE)


@pytest.mark.slow
def test_what_is_installed_is_listed_with_its_package(decant: Decant) -> None:
    listed = json.loads(decant("plugins", "--json").stdout)
    packages = {(p["group"], p["name"]): p["package"] for p in listed["plugins"]}
    assert packages["decant.balances", "spring"] == packages["decant.vessels", "cone"] == "decant-example 1.0"
    assert packages["decant.balances", "kcp"].startswith("decant-pouring ")
    assert listed["broken"] == []


@pytest.mark.slow
def test_it_is_known_to_files_and_misspelt_keys_are_guessed(decant: Decant, folder: Path) -> None:
    assert decant("validate", "cone.yaml", cwd=folder).returncode == 0
    (folder / "cone.yaml").write_text(CONE.replace("bottom", "botom"))
    said = decant("validate", "cone.yaml", cwd=folder)
    assert said.returncode == 2
    assert "cone.yaml:2:20: cone.botom: unknown key; did you mean 'bottom'?" in said.stderr
    (folder / "cone.yaml").write_text(CONE.replace("45 mm", "25 mm"))
    said = decant("validate", "cone.yaml", cwd=folder)
    assert said.returncode == 2
    assert "a cone opens upwards" in said.stderr


@pytest.mark.slow
def test_it_is_known_to_the_schema(decant: Decant) -> None:
    vessel = json.loads(decant("schema", "vessel").stdout)
    assert "cone" in json.dumps(vessel)
    laboratory = json.dumps(json.loads(decant("schema", "laboratory").stdout))
    assert "How long it swings after a change." in laboratory
    assert '"plain"' in laboratory  # the dialect


@pytest.mark.slow
def test_a_broken_package_is_named_and_disturbs_nobody(site: Path, broken: Path, folder: Path) -> None:
    decant = command(site, broken)
    listed = decant("plugins")
    assert listed.returncode == 1
    reason = "(decant.balances) of decant-broken 0.3 can't be used: ModuleNotFoundError"
    assert f"plug-in 'elastic' {reason}" in listed.stderr
    assert "plug-in 'bottle' (decant.vessels) of decant-broken 0.3 can't be used: TypeError" in listed.stderr
    assert "has registered 'kcp' already" in listed.stderr
    assert "spring" in listed.stdout
    assert decant("validate", "cone.yaml", cwd=folder).returncode == 0


@pytest.mark.slow
def test_a_laboratory_that_needs_a_broken_package_is_refused_with_its_name(
    site: Path, broken: Path, folder: Path
) -> None:
    path = folder / "example.yaml"
    path.write_text(LABORATORY.replace("kind: spring, swing: 0.5 s, step: 0.1 g", "kind: elastic"))
    said = command(site, broken)("validate", "example.yaml", cwd=folder)
    assert said.returncode == 2
    assert "example.yaml:6:17: balance.kind: plug-in 'elastic' (decant.balances) of decant-broken 0.3" in said.stderr


@pytest.mark.slow
def test_what_nobody_has_is_refused_with_what_is_meant(decant: Decant, folder: Path) -> None:
    path = folder / "example.yaml"
    path.write_text(LABORATORY.replace("kind: spring", "kind: sprong"))
    said = decant("validate", "example.yaml", cwd=folder)
    assert said.returncode == 2
    assert "'sprong' is not known here; did you mean 'spring'?" in said.stderr


CAMPAIGN = """\
name: outside
seed: 3
laboratory: example.yaml
liquid: {mass: 100 g}
pourer: beaker.yaml
motion: {hold_time: 0.3 s, return_velocity: 120 deg/s}
simulator: {parameters: {particles: 300}}
deployment:
  strategy: hypercube
  centred: true
  receiver: cone.yaml
  motion: {max_angle: 115 deg, height: 60 mm}
  actions: {angular_velocity: [60 deg/s, 100 deg/s], x_offset: [60 mm, 90 mm]}
  objective: {name: gentle, rough: 100 deg/s}
  pours: 2
outputs: {directory: runs}
"""


@pytest.mark.slow
def test_a_campaign_runs_with_an_arm_of_seven_joints(decant: Decant, folder: Path) -> None:
    pytest.importorskip("pinocchio")
    cell = "cell: {receiver: {x: 700 mm, y: 0 mm, z: 150 mm}, direction: 90 deg}"
    arm = f"arm: {json.dumps({**SEVEN_JOINTS, 'kind': 'seven-joint'})}\n{cell}"
    laboratory = LABORATORY.replace("arm: {kind: stand, fastest: 130 deg/s}", arm).replace("scale: 60", "scale: 4")
    (folder / "example.yaml").write_text(laboratory)
    (folder / "campaign.yaml").write_text(CAMPAIGN.replace("height: 60 mm", "height: 120 mm"))  # the cups do not touch
    ran = decant("run", "campaign.yaml", "--json", cwd=folder)
    assert ran.returncode == 0, ran.stderr
    (run,) = (folder / "runs").iterdir()
    assert json.loads((run / "summary.json").read_text())["verdict"]["pours"]["made"] == 2


@pytest.mark.slow
def test_a_campaign_of_things_from_outside_is_run_from_beginning_to_end(decant: Decant, folder: Path) -> None:
    (folder / "campaign.yaml").write_text(CAMPAIGN)
    ran = decant("run", "campaign.yaml", "--json", cwd=folder)
    assert ran.returncode == 4, ran.stderr  # both pours are refused: it reached nothing
    (run,) = (folder / "runs").iterdir()
    summary = json.loads((run / "summary.json").read_text())
    assert summary["pours"] == 2
    resolved = json.loads((run / "resolved.json").read_text())
    assert resolved["deployment"]["strategy"] == "hypercube"
    assert resolved["laboratory"]["balance"]["kind"] == "spring"
    assert resolved["laboratory"]["arm"]["kind"] == "stand"
    assert resolved["deployment"]["receiver"]["cone"]["top"] == "0.045 m"
    assert resolved["deployment"]["objective"]["name"] == "gentle"
    again = decant("validate", str(run / "resolved.json"), cwd=folder)
    assert again.returncode == 0, again.stderr

    versions = json.loads((run / "versions.json").read_text())
    assert versions["packages"]["decant-example"] == "1.0"
    assert {"decant.strategies: hypercube", "decant.arms: stand"} <= set(versions["plugins"]["decant-example"])

    reported = command()("report", str(run), "-o", "elsewhere.html", cwd=folder)  # where the example is not installed
    assert reported.returncode == 0, reported.stderr
    assert "Not installed here: decant-example 1.0 (" in reported.stderr
    page = (folder / "elsewhere.html").read_text()
    assert "Not installed here: decant-example 1.0 (" in page
    assert "deployment:cone-1: 2 pours" in page
    assert page.count('<tr class="bad"><th scope="row"') >= 2, "a line for each pour"
    assert "failed: cups touch" in page
    whole = decant("report", str(run), cwd=folder)
    assert "Not installed" not in whole.stderr


@pytest.mark.slow
def test_the_doctor_asks_a_balance_and_an_arm_from_outside(site: Path, broken: Path, folder: Path) -> None:
    said = command(site)("robot", "check", "example.yaml", cwd=folder).stdout
    assert "balance: a spring, step 0.1 g" in said
    assert re.search(r"ok +balance reading", said)
    assert "decant-broken 0.3" in command(site, broken)("robot", "check", "example.yaml", cwd=folder).stdout


DIALECT = """
from decant.plugins import SerialBalance, SerialBalanceSettings
from decant.plugins.testing import VirtualSerialBalance

far = VirtualSerialBalance.start("plain", baud=0, time_scale=20.0)
balance = SerialBalance(SerialBalanceSettings(port=far.port, time_scale=20.0))
print(balance.connect())
balance.tare()
far.put(0.2)
print(balance.weigh().mass)
balance.close()
far.close()
"""


def python(folder: Path, program: str) -> list[str]:
    """Lines that a program prints with a folder of packages installed."""
    path = os.pathsep.join([str(folder), str(ROOT)])
    ran = subprocess.run(
        [sys.executable, "-c", program],
        env={**os.environ, "PYTHONPATH": path},
        capture_output=True,
        text=True,
        cwd=ROOT,
    )
    assert ran.returncode == 0, ran.stderr
    return ran.stdout.splitlines()


@pytest.mark.slow
def test_a_dialect_from_outside_is_found_out_and_has_a_virtual_balance(site: Path) -> None:
    said, mass = python(site, DIALECT)
    assert said.startswith("Example's plain balance on ")
    assert float(mass) == pytest.approx(0.2, abs=1e-3)


@pytest.mark.slow
def test_the_tables_of_the_pages_know_what_is_installed(site: Path) -> None:
    program = "import runpy; print(runpy.run_path('docs/make_tables.py')['TABLES']['vessel']())"
    assert any("`cone`" in line and "A cone that opens upwards" in line for line in python(site, program))


UNFINISHED = """
from typing import Literal
from decant.plugins import ArmSettings, BalanceSettings, DesignSettings, Objective, Shape

class Arm(ArmSettings):
    kind: Literal["arm"] = "arm"

class Balance(BalanceSettings):
    kind: Literal["balance"] = "balance"

class Design(DesignSettings):
    strategy: Literal["design"] = "design"

class Wish(Objective):
    name: Literal["wish"] = "wish"

class Bowl(Shape):
    kind = "bowl"
"""


@pytest.mark.slow
def test_a_class_that_leaves_out_what_its_kind_has_to_say_is_refused_with_its_package(tmp_path: Path) -> None:
    (tmp_path / "unfinished.py").write_text(UNFINISHED)
    metadata = tmp_path / "unfinished-0.1.dist-info"
    metadata.mkdir()
    (metadata / "METADATA").write_text("Metadata-Version: 2.1\nName: unfinished\nVersion: 0.1\n")
    (metadata / "entry_points.txt").write_text(
        "[decant.arms]\narm = unfinished:Arm\n[decant.balances]\nbalance = unfinished:Balance\n"
        "[decant.strategies]\ndesign = unfinished:Design\n[decant.objectives]\nwish = unfinished:Wish\n"
        "[decant.vessels]\nbowl = unfinished:Bowl\n"
    )
    broken = {one["name"]: one for one in json.loads(command(tmp_path)("plugins", "--json").stdout)["broken"]}
    assert {one["package"] for one in broken.values()} == {"unfinished 0.1"}
    assert "ArmKind" in broken.pop("arm")["reason"]
    assert "BalanceKind" in broken.pop("balance")["reason"]
    assert {name: one["reason"].partition(" lacks ")[2] for name, one in broken.items()} == {
        "design": "'build', 'thetas', 'with_thetas'",
        "wish": "'cost'",
        "bowl": "'outline' or 'build'",
    }
