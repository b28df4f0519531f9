"""Fixtures of the actors' tests: simulators without Taichi, a scene, and one Ray for all tests of this package."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import pytest

from actors.laboratory_settings import BenchSettings
from sim_engine.action import DEG, Action
from sim_engine.liquids import SimulationParameters
from sim_engine.scene import PoseErrorSettings, PoseNoise, PourTask, Scene
from tests.support import fake_simulator
from tests.support.fake_simulator import FakeSimulator, make_fake, make_scene


@pytest.fixture
def fake() -> Callable[..., Callable[[], FakeSimulator]]:
    return make_fake


@pytest.fixture
def scene() -> Scene:
    return make_scene()


@pytest.fixture
def action() -> Action:
    return Action(angular_velocity=60 * DEG, x_offset=0.09, height=0.05, max_angle=100 * DEG, hold_time=0.5)


@pytest.fixture
def task(action: Action) -> Callable[..., PourTask]:
    def of(seed: int = 1, name: str = "tumbler", frame_rate: float = 0.0) -> PourTask:
        return PourTask(make_scene(name), action, SimulationParameters(), seed, frame_rate=frame_rate)

    return of


@pytest.fixture
def bench_spec() -> BenchSettings:
    return BenchSettings(
        liquid=SimulationParameters(particles=3_000, cohesion=0.03),
        pose_error=PoseErrorSettings(x=0.002, tilt=0.01, speed_factor=1.02),
        pose_noise=PoseNoise(x=5e-4, tilt=2e-3, speed_factor=0.01),
        time_scale=0.0,
    )


@pytest.fixture(scope="session")
def ray_running() -> Iterator[None]:
    """Ray, started once; laboratories of tests join it."""
    from actors.runtime.ray_runtime import RayStart, start_ray, stop_ray

    start_ray(RayStart(cpus=4))
    import ray

    # Workers can't import test modules by name.
    ray.cloudpickle.register_pickle_by_value(fake_simulator)
    yield
    stop_ray()
