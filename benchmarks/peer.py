"""Run the peer solver for comparison: SPlisHSPlasH 2.19 in its own environment, on the standard pour.

It is not a dependency of Decant. `environment()` creates a virtual environment in the user's cache directory on first
use (about 250 MB); `pour()` starts the solver there as a child of this process, on the same core, and measures it.
"""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import tempfile
import venv
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from machine import say, single_threaded
from standard_pour import (
    END,
    REST,
    SCENE,
    TIMES,
    Floats,
    delivered,
    density_inside,
    left_in_pourer,
    motion,
    particle_spacing,
    vessels,
)

from actors.runtime.child_process import child_environment
from sim_engine.collision import rotations
from sim_engine.resources import cache_directory
from sim_engine.simulator import fill, spacing

NAME, VERSION = "SPlisHSPlasH", "2.19.0"
REQUIREMENTS = (f"pysplishsplash=={VERSION}", "numpy")
MODULE = "pysplishsplash"
CHILD = Path(__file__).with_name("peer_splishsplash.py")

BUNDLED = {
    "libGLU": "libGLU.so.1",
    "libGLX": "libGLX.so.0",
    "libGLdispatch": "libGLdispatch.so.0",
    "libOpenGL": "libOpenGL.so.0",
}
"""Libraries that the wheel bundles, with the names of the system's libraries."""

WALL_DISTANCE = 1.0
"""Distance of the peer's lattice from the walls, within which the solver repels liquid [spacings]."""

FRAME_EVERY = 0.02
FREEZE_BELOW = -0.06
"""Particles below this height do not return [m]."""

RUN_TIMEOUT = 3600.0
"""Time limit of a run [s]."""


@dataclass(frozen=True)
class PeerRun:
    """One standard pour by the peer; attributes as in `standard_pour.Measured`."""

    cpu_s: float
    steps: int
    iterations: int
    left: tuple[float, ...]
    density: float
    delivered: float


def check_particles(particles: int) -> None:
    """Check that N is a multiple of four: the peer's liquid starts as a block of two by two columns.

    Raises:
        SystemExit: N is not a multiple of four.
    """
    if particles % 4:
        raise SystemExit(f"--particles {particles}: beside the peer it must be a multiple of 4")


def environment() -> Path:
    """Return the Python of the peer's environment, creating it if needed.

    Raises:
        SystemExit: the environment or the import of the peer failed; the message has instructions.
    """
    folder = cache_directory() / f"peer-{NAME.lower()}-{VERSION}-py{sys.version_info[0]}.{sys.version_info[1]}"
    python = folder / ("Scripts/python.exe" if sys.platform == "win32" else "bin/python")
    ready = folder / "ready"
    if ready.exists():
        return python
    say(f"making an environment for {NAME} {VERSION} in {folder} (once)")
    shutil.rmtree(folder, ignore_errors=True)
    try:
        venv.create(folder, with_pip=True)
        _install(python)
        trouble = _import_trouble(python)
        if trouble is not None:
            _use_libraries_of_the_system(folder)
            trouble = _import_trouble(python)
    except (OSError, subprocess.CalledProcessError) as problem:
        raise SystemExit(f"no environment for {NAME} in {folder}: {problem}") from None
    if trouble is not None:
        raise SystemExit(
            f"{NAME} {VERSION} is installed in {folder} but can't be imported ({trouble}).\n"
            "Its wheel brings OpenGL libraries that often clash with a system's own. Install those "
            "(Debian, Ubuntu: apt install libopengl0 libglx0 libglu1-mesa) and run this again: they will be used "
            "in place of the wheel's."
        )
    ready.touch()
    return python


def _install(python: Path) -> None:
    command = [str(python), "-m", "pip", "install", "--quiet", "--disable-pip-version-check", *REQUIREMENTS]
    done = subprocess.run(command, check=False, capture_output=True, text=True, env=child_environment())
    if done.returncode != 0:
        raise SystemExit(
            f"{' '.join(REQUIREMENTS)} can't be installed for Python {sys.version_info[0]}.{sys.version_info[1]}: is "
            f"there a connection to a package index, and a wheel for this system? pip says:\n{done.stderr.strip()}"
        )


def _import_trouble(python: Path) -> str | None:
    """Return why the peer cannot be imported, or None; a segmentation fault is the usual failure."""
    done = subprocess.run(
        [str(python), "-c", f"import {MODULE}"], check=False, capture_output=True, text=True, env=child_environment()
    )
    if done.returncode == 0:
        return None
    return f"signal {-done.returncode}" if done.returncode < 0 else done.stderr.strip().splitlines()[-1]


def _use_libraries_of_the_system(folder: Path) -> None:
    """Replace the wheel's OpenGL libraries by links to the system's."""
    if not sys.platform.startswith("linux"):
        return
    told = subprocess.run(
        ["/sbin/ldconfig", "-p"], check=False, capture_output=True, text=True, env=child_environment()
    ).stdout
    here = dict(line.strip().split(" => ", 1) for line in told.splitlines() if " => " in line)
    paths = {name.split(" ", 1)[0]: path for name, path in reversed(list(here.items()))}
    for bundled in folder.glob(f"lib/python*/site-packages/{MODULE}.libs/*.so*"):
        own = paths.get(BUNDLED.get(bundled.name.split("-", 1)[0], ""))
        if own is not None:
            bundled.unlink()
            bundled.symlink_to(own)


def pour(python: Path, particles: int, seed: int) -> PeerRun:
    """Run and measure the standard pour in a child process.

    Args:
        python: Python of the peer's environment.
        particles: N, a multiple of four.
        seed: seed of the initial positions.

    Raises:
        SystemExit: the run failed; the message has the end of its output.
    """
    arrays = _simulate(python, particles, seed)
    times, frames = arrays["times"], arrays["frames"].astype(float)
    slack = 0.5 * particle_spacing(particles)
    judged = (times > min(TIMES) - 0.1) & (times < max(TIMES) + 0.1)
    curve = [left_in_pourer(x, t, slack) for t, x in zip(times[judged], frames[judged], strict=True)]
    at_rest = int(np.argmin(np.abs(times - REST)))
    return PeerRun(
        cpu_s=float(arrays["cpu_s"]),
        steps=int(arrays["steps"]),
        iterations=int(arrays["iterations"]),
        left=tuple(float(left) for left in np.interp(TIMES, times[judged], curve)),
        density=density_inside(frames[at_rest], float(times[at_rest]), particles),
        delivered=delivered(frames[-1], slack),
    )


def _simulate(python: Path, particles: int, seed: int) -> dict[str, Floats]:
    """Return times (F,) [s], frames (F, N, 3) [m], and the numbers of steps, iterations and CPU seconds."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        job, result = folder / "job.json", folder / "result.npz"
        job.write_text(json.dumps(_job(folder, particles, seed)), encoding="utf-8")
        command = [str(python), str(CHILD), str(job), str(result)]
        try:
            done = subprocess.run(
                command,
                check=False,
                capture_output=True,
                text=True,
                env=single_threaded(),
                cwd=folder,
                timeout=RUN_TIMEOUT,
            )
        except subprocess.TimeoutExpired:
            raise SystemExit(f"{NAME} with {particles} particles took more than {RUN_TIMEOUT:g} s") from None
        if done.returncode != 0 or not result.exists():
            said = (done.stdout + done.stderr).strip().splitlines()[-12:]
            raise SystemExit(f"{NAME} with {particles} particles ended with {done.returncode}:\n" + "\n".join(said))
        with np.load(result) as kept:
            return {key: kept[key] for key in kept.files}


def _job(folder: Path, particles: int, seed: int) -> dict[str, object]:
    """Return the job for the child: files in `folder`, and numbers [m, s, rad/s] in the simulator's world frame."""
    (pourer, receiver), moved, volume = vessels(), motion(), SCENE.liquid.volume
    pose = moved.sample(np.array([0.0]))
    (rotation,) = rotations(pose)
    lattice = fill(pourer, volume, particles, seed, WALL_DISTANCE)
    np.save(folder / "positions.npy", (lattice @ rotation.T + pose[0, :3]).astype(np.float32))
    # A body rotates about its mesh's origin, so the pourer's origin is placed at the pivot.
    _write_obj(folder / "pourer.obj", pourer.solid_vertices - np.array(moved.pivot_vessel), pourer.solid_faces)
    _write_obj(folder / "receiver.obj", receiver.solid_vertices, receiver.solid_faces)
    return {
        "particles": particles,
        "radius": 0.5 * spacing(volume, particles),
        "positions": str(folder / "positions.npy"),
        "pourer_mesh": str(folder / "pourer.obj"),
        "receiver_mesh": str(folder / "receiver.obj"),
        "pivot": list(moved.pivot_world),
        "receiver_at": [0.0, 0.0, 0.0],
        "turns": [[s.start, s.start + s.duration, s.velocity] for s in moved.segments],
        "end_time": END,
        "frame_every": FRAME_EVERY,
        "freeze_below": FREEZE_BELOW,
    }


def _write_obj(path: Path, vertices: Floats, faces: np.ndarray[tuple[int, int], np.dtype[np.int64]]) -> None:
    lines = [f"v {x:.7f} {y:.7f} {z:.7f}" for x, y, z in vertices.tolist()]
    lines += [f"f {a + 1} {b + 1} {c + 1}" for a, b, c in faces.tolist()]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
