"""Packages from outside: one adds a thing of each kind and is run through a campaign, and one is broken."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.end_to_end import small

ROOT = Path(__file__).parents[2]

Decant = Callable[..., subprocess.CompletedProcess[str]]


@pytest.fixture(scope="session")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The example, installed as any package is, in a folder of its own."""
    folder = tmp_path_factory.mktemp("site")
    install = [sys.executable, "-m", "pip", "install", "--no-deps", "--no-build-isolation", "--no-index", "--quiet"]
    source = tmp_path_factory.mktemp("source")
    shutil.copy(ROOT / "tests" / "plugins" / "pyproject.toml", source)
    shutil.copytree(ROOT / "tests" / "plugins" / "decant_example", source / "decant_example")
    subprocess.run([*install, "--target", str(folder), str(source)], check=True)
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
            [sys.executable, "-c", "from orchestrator.cli import main; main()", *words],
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
arm: {kind: stand}
balance: {kind: spring, swing: 0.5 s, step: 0.1 g}
"""
    + BENCH
)

CONE = "name: cone-1\ncone: {top: 45 mm, bottom: 30 mm, height: 100 mm}\n"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A campaign that names the example's things."""
    small.write_campaign(tmp_path)
    (tmp_path / "example.yaml").write_text(LABORATORY)
    (tmp_path / "cone.yaml").write_text(CONE)
    return tmp_path


def test_what_is_installed_is_listed_with_its_package(decant: Decant) -> None:
    listed = json.loads(decant("plugins", "--json").stdout)
    packages = {(p["group"], p["name"]): p["package"] for p in listed["plugins"]}
    assert packages["decant.balances", "spring"] == packages["decant.vessels", "cone"] == "decant-example 1.0"
    assert packages["decant.balances", "kcp"].startswith("decant ")
    assert listed["broken"] == []


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


def test_it_is_known_to_the_schema(decant: Decant) -> None:
    vessel = json.loads(decant("schema", "vessel").stdout)
    assert "cone" in json.dumps(vessel)
    laboratory = json.dumps(json.loads(decant("schema", "laboratory").stdout))
    assert "How long it swings after a change." in laboratory
    assert '"plain"' in laboratory  # the dialect


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


def test_a_laboratory_that_needs_a_broken_package_is_refused_with_its_name(
    site: Path, broken: Path, folder: Path
) -> None:
    path = folder / "example.yaml"
    path.write_text(LABORATORY.replace("kind: spring, swing: 0.5 s, step: 0.1 g", "kind: elastic"))
    said = command(site, broken)("validate", "example.yaml", cwd=folder)
    assert said.returncode == 2
    assert "example.yaml:6:17: balance.kind: plug-in 'elastic' (decant.balances) of decant-broken 0.3" in said.stderr


def test_what_nobody_has_is_refused_with_what_is_meant(decant: Decant, folder: Path) -> None:
    path = folder / "example.yaml"
    path.write_text(LABORATORY.replace("kind: spring", "kind: sprong"))
    said = decant("validate", "example.yaml", cwd=folder)
    assert said.returncode == 2
    assert "'sprong' is not known here; did you mean 'spring'?" in said.stderr
