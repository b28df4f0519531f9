"""`simulator`: the simulator of pours: one after another in one process."""

from __future__ import annotations

import dataclasses
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from actors.runtime.child_process import child_environment
from sim_engine.action import DEG, Action
from sim_engine.errors import SimulationCancelled
from sim_engine.liquids import Liquid, SimulationParameters
from sim_engine.outcome import ParticleState
from sim_engine.scene import MIRRORED_FROM, PoseError, PourTask, SampledMotion, Scene
from sim_engine.simulator import PourSimulator, why_whole
from sim_engine.vessel.mesh_shape import MeshShape
from sim_engine.vessel.shapes import VesselSpec, cylinder
from tests.support.waiting import PATIENCE

ROOT = Path(__file__).parents[2]
SCENE = Scene(
    "batch",
    cylinder("cup", inner_radius=0.04, inner_height=0.1),
    cylinder("glass", inner_radius=0.045, inner_height=0.09),
    Liquid(mass=0.2),
)
OTHER = dataclasses.replace(SCENE, name="other", receiver=cylinder("jar", inner_radius=0.055, inner_height=0.07))


def task(seed: int, *, speed: float = 120.0, particles: int = 300, scene: Scene = SCENE, **theta: float) -> PourTask:
    action = Action(angular_velocity=speed * DEG, x_offset=0.08, height=0.11, max_angle=110 * DEG, hold_time=0.3)
    return PourTask(scene, action, SimulationParameters(particles=particles, **theta), seed)


@pytest.fixture(scope="module")
def simulator() -> PourSimulator:
    return PourSimulator()


def test_a_pour_is_bit_for_bit_the_same_whatever_was_poured_before(simulator: PourSimulator) -> None:
    tasks = [
        task(1),
        task(2, speed=60.0, xsph_rate=8.0),
        task(3, particles=450, cohesion=0.06),
        task(4, scene=OTHER, friction=0.2),
    ]
    first, again = (
        [dataclasses.replace(simulator.simulate(one).outcome, cpu_s=0.0) for one in order]
        for order in (tasks, tasks[::-1])
    )
    assert first == again[::-1]
    assert len({outcome.received for outcome in first}) > 1


def test_a_pour_can_be_given_up(simulator: PourSimulator) -> None:
    asked = 0

    def enough() -> bool:
        nonlocal asked
        asked += 1
        return asked > 3

    with pytest.raises(SimulationCancelled):
        simulator.simulate(task(1), cancelled=enough)
    assert simulator.simulate(task(1)).outcome.invalid is None


def test_a_scene_larger_than_the_pool_says_so(simulator: PourSimulator, monkeypatch: pytest.MonkeyPatch) -> None:
    from sim_engine.fluid.engine import engine

    simulator.simulate(task(1))
    monkeypatch.setattr(engine(), "pool", 200)
    with pytest.raises(ValueError, match="300 particles; at most 200"):
        simulator.simulate(task(1))


SYMMETRIC = dataclasses.replace(SCENE, mirrored=True)


def mirrors(simulator: PourSimulator, whole: PourTask) -> bool:
    return simulator.mirrors(whole, simulator.prepare(whole))


@given(
    speed=st.floats(10.0, 200.0),
    x=st.floats(-0.004, 0.004),
    tilt=st.floats(-0.1, 0.1),
    particles=st.integers(MIRRORED_FROM, 50_000),
)
@settings(max_examples=20, deadline=None)
def test_a_pour_that_is_its_own_mirror_image_is_simulated_by_half(
    simulator: PourSimulator, speed: float, x: float, tilt: float, particles: int
) -> None:
    error = PoseError(x=x, tilt=tilt)
    half = dataclasses.replace(task(1, speed=speed, particles=particles, scene=SYMMETRIC), pose_error=error)
    assert mirrors(simulator, half)
    assert not mirrors(simulator, dataclasses.replace(half, scene=SCENE))  # symmetry: off, or searched sideways


@given(st.floats(1e-6, 0.01) | st.floats(-0.01, -1e-6), st.sampled_from(["action", "theta", "error", "motion", "turn"]))
@settings(max_examples=30, deadline=None)
def test_a_pour_with_anything_sideways_is_simulated_whole(simulator: PourSimulator, aside: float, where: str) -> None:
    half = task(1, particles=MIRRORED_FROM, scene=SYMMETRIC, **({"receiver_y": aside} if where == "theta" else {}))
    if where == "action":
        half = dataclasses.replace(half, action=half.action.with_values(y_offset=aside))
    elif where == "error":
        half = dataclasses.replace(half, pose_error=PoseError(y=aside))
    elif where in ("motion", "turn"):
        times = np.linspace(0.0, 2.0, 50)
        poses = simulator.prepare(half).sample(times)
        poses[20:, 1 if where == "motion" else 4] += aside
        half = dataclasses.replace(half, motion=SampledMotion(times, poses))
    assert not mirrors(simulator, half)


def test_few_particles_are_simulated_whole(simulator: PourSimulator) -> None:
    assert not mirrors(simulator, task(1, particles=MIRRORED_FROM - 1, scene=SYMMETRIC))
    assert not simulator.simulate(task(1, scene=SYMMETRIC)).outcome.mirrored


def test_a_mug_is_symmetric_with_its_handle_in_the_plane_of_the_tilt_alone(
    simulator: PourSimulator, tmp_path: Path
) -> None:
    mesh = trimesh.load(ROOT / "configs" / "vessels" / "meshes" / "mug.stl")
    mesh.apply_transform(trimesh.transformations.rotation_matrix(0.5 * np.pi, (0, 0, 1)))
    mesh.export(tmp_path / "turned.stl")
    before, turned = (
        VesselSpec(name="mug", shape=MeshShape(path=path, unit="mm"))
        for path in (ROOT / "configs" / "vessels" / "meshes" / "mug.stl", tmp_path / "turned.stl")
    )
    scene = dataclasses.replace(SYMMETRIC, receiver=before)
    assert mirrors(simulator, task(1, particles=MIRRORED_FROM, scene=scene))
    aside = dataclasses.replace(scene, receiver=turned)
    assert not mirrors(simulator, task(1, particles=MIRRORED_FROM, scene=aside))
    assert re.search(
        r"differs from its mirror image in the plane of the tilt by \d+ mm, .* which takes twice as long",
        why_whole(simulator.vessel(turned), 2e-4, MIRRORED_FROM),
    )


def test_recorded_frames_of_a_mirrored_pour_show_the_whole_liquid(
    simulator: PourSimulator, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sim_engine.simulator.MIRRORED_FROM", 300)
    shown = simulator.simulate(dataclasses.replace(task(1, scene=SYMMETRIC), frame_rate=20.0))
    assert (shown.outcome.mirrored, shown.outcome.particles) == (True, 300)
    assert shown.frames is not None
    for positions, states in zip(shown.frames.positions, shown.frames.states, strict=True):
        assert positions.shape == (300, 3)
        assert positions[150:] == pytest.approx(positions[:150] * [1.0, -1.0, 1.0])
        assert list(states[150:]) == list(states[:150])
        assert np.abs(positions[:, 1]).max() > 0.02  # the cup's radius is 40 mm


def test_a_mirrored_pour_is_dense_at_the_plane_and_its_stream_as_thick(
    simulator: PourSimulator, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without the addition to distances from own images hardly any particle comes so near to the plane."""
    near: dict[bool, float] = {}
    thickness: dict[bool, float] = {}
    for mirrored in (False, True):
        monkeypatch.setattr("sim_engine.simulator.MIRRORED_FROM", 0 if mirrored else 10**9)
        pour = dataclasses.replace(task(2, speed=60.0, particles=1500, scene=SYMMETRIC), frame_rate=50.0)
        simulated = simulator.simulate(pour)
        assert simulated.frames is not None
        flowing = [k for k, s in enumerate(simulated.frames.states) if (s == ParticleState.IN_FLIGHT).any()]
        aside = (
            np.abs(np.concatenate([simulated.frames.positions[k][:, 1] for k in flowing])) / simulated.outcome.spacing
        )
        states = np.concatenate([simulated.frames.states[k] for k in flowing])
        cup = aside[states == ParticleState.IN_POURER]
        near[mirrored] = float((cup < 0.25).mean() / 0.25 / ((cup < 4.0).mean() / 4.0))
        thickness[mirrored] = float(aside[states == ParticleState.IN_FLIGHT].mean())
    assert near[True] == pytest.approx(near[False], abs=0.3)
    assert thickness[True] == pytest.approx(thickness[False], rel=0.04)


def test_recorded_frames_tell_where_the_receiver_stands(simulator: PourSimulator) -> None:
    aside = dataclasses.replace(task(1), pose_error=PoseError(x=0.004, y=-0.002, z=0.001), frame_rate=5.0)
    frames = simulator.simulate(aside).frames
    assert frames is not None
    assert frames.receiver_at == (0.004, -0.002, 0.001)


def test_recorded_frames_show_the_liquid_from_the_start_of_a_slow_pour(simulator: PourSimulator) -> None:
    slow = dataclasses.replace(task(1, speed=20.0), frame_rate=5.0)
    run = simulator.simulate(slow)
    frames = run.frames
    assert frames is not None
    assert frames.times[0] == 0.0
    assert np.all(np.diff(frames.times) > 0.0)
    assert np.max(np.diff(frames.times)) < 0.3
    # the mass centre neither jumps nor leaves the turning cup
    centres = np.array([p.mean(axis=0) for p in frames.positions])
    assert np.max(np.linalg.norm(np.diff(centres[:10], axis=0), axis=1)) < 0.02
    assert run.outcome == dataclasses.replace(simulator.simulate(task(1, speed=20.0)).outcome, cpu_s=run.outcome.cpu_s)


def test_engine_ends_cleanly_without_having_simulated() -> None:
    done = subprocess.run(
        [sys.executable, "-c", "from sim_engine.simulator import PourSimulator; PourSimulator().close()"],
        capture_output=True,
        text=True,
        timeout=PATIENCE,
        env=child_environment(),
    )
    replaced = "Taichi can't be loaded without " in done.stderr  # one line, where its libraries are missing
    assert (done.returncode, len(done.stderr.splitlines())) == (0, int(replaced)), done.stderr
