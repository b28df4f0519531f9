"""`benchmarks/limits.py` extrapolates to particles without size, and counts what was spilled."""

from __future__ import annotations

from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from sim_engine.collision import rotations
from sim_engine.simulator import fill


@pytest.fixture
def limits(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(Path(__file__).parents[1] / "benchmarks"))
    import limits

    return limits


def test_a_limit_is_the_value_at_no_spacing_with_its_scatter(limits: ModuleType) -> None:
    d = np.array([6e-3, 4e-3, 3e-3, 2e-3])
    exact = [(d, 0.1 + 20.0 * d), (d, 0.3 - 5.0 * d)]
    assert [limit for limit, _ in limits.fitted(exact)] == pytest.approx([0.1, 0.3])
    assert [half for _, half in limits.fitted(exact)] == pytest.approx([0.0, 0.0], abs=1e-9)
    # 95 % intervals contain the truth about as often as they say
    rng = np.random.default_rng(0)
    held = []
    for _ in range(300):
        runs = [(d, 0.1 + 20.0 * d + 3.0 * d * rng.standard_normal(4)) for _ in range(3)]
        held += [abs(limit - 0.1) <= half for limit, half in limits.fitted(runs)]
    assert 0.92 <= np.mean(held) <= 0.98


def test_every_particle_of_the_peer_is_retained_received_or_spilled(limits: ModuleType) -> None:
    pour = limits.POURS[0]
    scene = limits.peer_scene(pour)
    d = limits.spacing(limits.VOLUME, 400)
    pose = scene.motion.sample(np.array([scene.end]))
    (end,), (rotation,) = pose[:, :3], rotations(pose)
    upright = fill(scene.pourer, limits.VOLUME, 400, 1).astype(float)
    retained = upright[:100] @ rotation.T + end
    received = fill(scene.receiver, 1e-4, 200, 1).astype(float)
    below = received[:100] + np.array([0.3, 0.0, -0.2])
    points = np.concatenate([retained, received, below])
    assert limits.peer_spillage(scene, points, scene.end, 0.5 * d) == pytest.approx(1 / 3)
