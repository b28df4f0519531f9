"""Run folders: their names, the files next to the journal, and the search for an unfinished run.

`create_run` makes the folder, `write_provenance` stores plan and versions, `find_run` returns the run to resume. The
journal itself is in `orchestrator.records`.
"""

from __future__ import annotations

import contextlib
import functools
import importlib.metadata
import json
import platform
import re
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from orchestrator.campaigns.fingerprint import fingerprint
from orchestrator.campaigns.installed_plugins import packages as plugin_packages
from orchestrator.learning.campaign_plan import CampaignPlan
from orchestrator.records.codec import digest, from_json, to_json
from orchestrator.records.journal import JOURNAL_NAME, JournalReader
from orchestrator.records.journal_check import LEDGER_NAME, check_journal, has_begun, readable_lines
from orchestrator.records.journal_file import TO_BEGIN, JournalError, require_space
from orchestrator.records.run_registry import make_state_directory, register, state_directory
from orchestrator.records.states import State
from sim_engine.engine_package import engine_version
from sim_engine.outcome import ParticleState, PourOutcome, RecordedFrames, SimulatedPour
from sim_engine.scene import Scene
from sim_engine.settings.plugin_registry import DISTRIBUTION
from sim_engine.solver_fingerprint import ROOT, folder_digest, solver_fingerprint

RESOLVED, VERSIONS = "resolved.json", "versions.json"
"""Files with the resolved plan of a run and with the versions of the program that began it."""

FIGURES, RECORDING = "figures", "campaign.rrd"
"""Folder of a run's pictures, and the file of its Rerun recording."""

SIMULATOR, SIMULATOR_FILE = "simulator", "simulator.json"
"""Key of the solver's version in `versions.json`, and the file of the state directory that keeps it."""


def create_run(plan: CampaignPlan) -> Path:
    """Make the directory of a new run, NAME-DATE-N (NAME-hardware-DATE-N), where N counts the runs of the day.

    The directory is created in the plan's output directory and registered in the catalogue of runs.

    Raises:
        NoSpaceError: there is too little space for a run.
        OSError: the directory can't be created.
    """
    parent = plan.outputs.folder
    require_space(parent, TO_BEGIN, "to begin a run")
    parent.mkdir(parents=True, exist_ok=True)
    name = plan.name if plan.laboratory.mode == "virtual" else f"{plan.name}-{plan.laboratory.mode}"
    stem = f"{name}-{time.strftime('%Y%m%d')}"
    number = 1 + max(
        (int(m[1]) for p in parent.iterdir() if (m := re.fullmatch(rf"{re.escape(stem)}-(\d+)", p.name))), default=0
    )
    while True:
        directory = parent / f"{stem}-{number}"
        try:
            directory.mkdir()  # two runs that begin at the same moment get two directories
            break
        except FileExistsError:
            number += 1
    register(directory)
    return directory


def write_provenance(directory: Path, plan: CampaignPlan) -> None:
    """Write what is needed to reproduce the run: resolved.json (the plan) and versions.json."""
    _write_json(directory / RESOLVED, plan.resolved)
    about = {"campaign": str(plan.source), "seed": plan.seed, **versions()}
    if plan.calibration is not None and plan.calibration.settings.makes_posterior:
        about[SIMULATOR] = simulator_version()
    _write_json(directory / VERSIONS, about)


def versions() -> dict[str, Any]:
    """Versions of Python, the platform, the engine, Decant, its dependencies, and packages that add plug-ins."""
    packages: dict[str, str] = {}
    names = [DISTRIBUTION]
    try:
        names += [re.split(r"[^\w.-]", text, maxsplit=1)[0] for text in importlib.metadata.requires(DISTRIBUTION) or []]
    except importlib.metadata.PackageNotFoundError:
        names += ["numpy", "scipy", "scikit-learn", "taichi", "ray", "trimesh"]
    for name in names:
        try:
            packages[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            packages[name] = "not installed"
    plugins = plugin_packages()
    packages |= {name: version for name, (version, _) in plugins.items()}
    return {
        "python": sys.version.split()[0],
        "platform": platform.platform(),
        "processor": platform.machine(),
        "engine": engine_version(),
        "packages": packages,
        "plugins": {name: sorted(set(added)) for name, (_, added) in plugins.items()},
    }


@functools.cache
def simulator_version() -> str:
    """Version of the solver's code (`solver_fingerprint`), kept in the state directory: it takes about a second."""
    files, path = folder_digest(ROOT / "sim_engine"), None
    with contextlib.suppress(OSError, ValueError, KeyError):
        path = state_directory() / SIMULATOR_FILE
        versions = json.loads(path.read_text(encoding="utf-8"))
        if versions["files"] == files:
            return str(versions["version"])
    version = solver_fingerprint()
    with contextlib.suppress(OSError):
        if path is not None:
            make_state_directory(path.parent)
            _write_json(path, {"files": files, "version": version})
    return version


def film_file(figures: Path, receiver: str) -> Path:
    """File with the simulated particles of a recommended pour, in the folder of a run's pictures."""
    name = re.sub(r"[^\w.-]", "_", receiver)
    return figures / f"recommended-pour-{name}.npz"


def dose_film_file(figures: Path, number: int) -> Path:
    """File with some moments of a dose of particles, in the folder of a run's pictures."""
    return figures / f"particles-of-dose-{number}.npz"


KEPT_MOMENTS = 12
"""Moments of a dose that are kept: even in the liquid that has left the pourer."""


def dose_moments(scene: Scene, mass: float, frames: RecordedFrames) -> SimulatedPour:
    """Some moments of a dose of particles.

    Args:
        scene: of the dose.
        mass: in the pourer before it [kg].
        frames: of the whole dose.
    """
    left = np.array([float(np.mean(states != ParticleState.IN_POURER)) for states in frames.states])
    levels = np.linspace(0.0, left.max(), KEPT_MOMENTS - 1)
    chosen = sorted({*(int(np.argmax(left >= level)) for level in levels), len(left) - 1})
    end = frames.states[-1]
    shares = np.bincount(end, minlength=5) / len(end)
    outcome = PourOutcome(
        received=float(shares[ParticleState.RECEIVED]),
        spilled=float(shares[ParticleState.SPILLED]),
        retained=float(shares[ParticleState.IN_POURER]),
        in_flight=float(shares[ParticleState.IN_FLIGHT]),
        escaped=float(shares[ParticleState.ESCAPED]),
        particles=len(end),
        spacing=(mass / scene.liquid.density / len(end)) ** (1.0 / 3.0),
        density_error=0.0,
        simulated_time=float(frames.times[-1]),
        steps=0,
        cpu_s=0.0,
        seed=0,
    )
    kept = RecordedFrames(
        frames.times[chosen],
        [frames.positions[i] for i in chosen],
        [frames.states[i] for i in chosen],
        frames.pourer_poses[chosen],
        frames.receiver_at,
    )
    return SimulatedPour(outcome, kept)


def write_film(path: Path, pour: SimulatedPour) -> None:
    """Write a simulated pour with its frames.

    Raises:
        OSError: it can't be written.
    """
    frames = pour.frames
    assert frames is not None
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savez_compressed(
        path,
        outcome=np.array(json.dumps(to_json(pour.outcome, PourOutcome))),
        times=frames.times,
        positions=np.stack(frames.positions),
        states=np.stack(frames.states),
        poses=frames.pourer_poses,
        receiver_at=np.array(frames.receiver_at),
    )


def read_film(path: Path) -> SimulatedPour:
    """Read a pour that `write_film` has written.

    Raises:
        OSError, ValueError: it can't be read.
    """
    with np.load(path) as archive:
        x, y, z = (
            archive["receiver_at"].tolist() if "receiver_at" in archive else (0.0, 0.0, 0.0)
        )  # films of 0.2 lack it
        particles = list(archive["positions"]), list(archive["states"])
        frames = RecordedFrames(archive["times"], *particles, archive["poses"], (x, y, z))
        return SimulatedPour(from_json(json.loads(str(archive["outcome"])), PourOutcome), frames)


def missing_plugins(versions: Mapping[str, Any]) -> list[str]:
    """Plug-in packages of a run that are not installed here, for example 'decant-example 1.0 (decant.arms: stand)'.

    Args:
        versions: content of `versions.json`.
    """
    installed, packages = plugin_packages(), versions.get("packages") or {}
    return [
        f"{name} {packages.get(name, '')} ({', '.join(added)})"
        for name, added in (versions.get("plugins") or {}).items()
        if name not in installed
    ]


def read_versions(directory: Path) -> dict[str, Any]:
    """Content of `versions.json` of a run; empty if the file is missing or damaged."""
    try:
        versions = json.loads((directory / VERSIONS).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return versions if isinstance(versions, dict) else {}


def find_run(plan: CampaignPlan, run_id: str | None = None) -> Path:
    """The run to resume: the one with this id, or the campaign's newest unfinished run.

    Among several unfinished runs, one with the same settings is preferred. Otherwise the newest is returned, so that
    resuming it can report the changed settings.

    Raises:
        JournalError: no such run, or no unfinished run.
        JournalDamagedError: its journal has lost or changed entries, so that resuming it could repeat pours.
    """
    parent = plan.outputs.folder
    if run_id is not None:
        directory = parent / run_id
        if not has_begun(directory / JOURNAL_NAME):
            names = sorted(p.parent.name for p in parent.glob(f"*/{JOURNAL_NAME}"))
            raise JournalError(f"{directory}: no such run; known: {', '.join(names) or 'none'}")
    else:
        directory = _newest_unfinished(plan, parent)
    check_journal(directory / JOURNAL_NAME).require()
    return directory


def _newest_unfinished(plan: CampaignPlan, parent: Path) -> Path:
    mine = digest(fingerprint(plan))
    candidates: list[tuple[bool, float, Path]] = []
    for directory in sorted(parent.iterdir()) if parent.is_dir() else ():
        try:
            with JournalReader(directory / JOURNAL_NAME) as journal:
                if journal.header.name == plan.name and journal.state() is not State.FINISHED:
                    same = digest(journal.header.fingerprint) == mine
                    candidates.append((same, journal.header.created, directory))
        except JournalError:
            # Written by another program or version. A damaged run of this campaign is a candidate, and is refused
            # later.
            begun = readable_lines(directory / LEDGER_NAME)[:1]
            candidates += [(True, line.t, directory) for line in begun if line.body.get("name") == plan.name]
    if not candidates:
        raise JournalError(f"{parent}: no unfinished run of campaign '{plan.name}'; begin one without --resume")
    return max(candidates)[2]


def _write_json(path: Path, data: Any) -> None:
    path.write_text(json.dumps(data, indent=2, ensure_ascii=False) + "\n", encoding="utf-8")
