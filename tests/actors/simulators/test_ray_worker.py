"""`ray_worker`: tasks that travel to machines without this one's files."""

from __future__ import annotations

import dataclasses
import pickle
import shutil
from pathlib import Path

import numpy as np
import pytest

from actors.interfaces import SimulationError
from actors.simulators.ray_worker import Packer, unpack
from sim_engine.vessel.mesh_shape import MeshShape
from sim_engine.vessel.shapes import VesselSpec
from sim_engine.vessel.vessel import build_vessel

MUG = Path(__file__).parents[3] / "configs" / "vessels" / "meshes" / "mug.stl"


@pytest.fixture
def mug(tmp_path):
    """A mesh of its own for each test, which may change it."""
    path = tmp_path / "here" / "mug.stl"
    path.parent.mkdir()
    shutil.copy(MUG, path)
    return VesselSpec(name="mug", shape=MeshShape(path=path, unit="mm"))


@pytest.fixture
def mug_task(task, mug):
    plain = task()
    return dataclasses.replace(plain, scene=dataclasses.replace(plain.scene, receiver=mug))


def test_nothing_that_travels_names_a_path_of_this_machine(mug_task, tmp_path):
    folder = tmp_path.name.encode()  # a path is pickled in parts
    assert folder not in pickle.dumps(Packer().pack(mug_task))
    assert folder in pickle.dumps(mug_task)


@pytest.mark.slow
def test_a_mesh_arrives_where_there_is_no_such_file(mug_task, mug, tmp_path, monkeypatch):
    expected, content = mug.content_hash(), mug.shape.path.read_bytes()
    packed, parcels = pickle.loads(pickle.dumps(Packer().pack(mug_task)))
    mug.shape.path.unlink()
    monkeypatch.setenv("DECANT_CACHE_DIR", str(tmp_path / "there"))
    arrived = unpack(packed, parcels).scene.receiver
    assert arrived.shape.path.read_bytes() == content
    assert arrived.shape.path.name == "mug.stl"
    assert arrived.content_hash() == expected
    assert build_vessel(arrived).capacity > 1e-4


def test_a_damaged_copy_is_written_anew(mug_task, tmp_path, monkeypatch):
    packed, parcels = Packer().pack(mug_task)
    monkeypatch.setenv("DECANT_CACHE_DIR", str(tmp_path / "there"))
    path = unpack(packed, parcels).scene.receiver.shape.path
    path.write_bytes(b"half")
    assert unpack(packed, parcels).scene.receiver.shape.path.read_bytes() == MUG.read_bytes()


def test_a_campaign_keeps_the_mesh_that_it_began_with(mug_task, mug):
    packer = Packer()
    _, (first,) = packer.pack(mug_task)
    mug.shape.path.write_bytes(b"edited in mid-campaign")
    _, (second,) = packer.pack(mug_task)
    np.testing.assert_array_equal(first.content, second.content)


def test_tasks_without_meshes_travel_as_they_are(task):
    packed, parcels = Packer().pack(task())
    assert packed == task()
    assert parcels == []
    assert unpack(packed, parcels) is packed


def test_a_mesh_that_is_not_there_is_named(mug_task, mug):
    mug.shape.path.unlink()
    with pytest.raises(SimulationError, match=r"mug\.stl: the mesh can't be read: No such file"):
        Packer().pack(mug_task)
