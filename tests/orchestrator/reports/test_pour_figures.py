"""`pour_figures`: one simulated pour as a picture: vessels cut open, particles, shares of the liquid."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from orchestrator.reports import figure_style as style
from orchestrator.reports.pour_figures import _moments, place, section, simulation_figure
from sim_engine.motion import plan_motion
from sim_engine.outcome import SimulatedPour
from sim_engine.vessel.vessel import build_vessel
from tests.support import example_run
from tests.support.example_results import is_picture


def test_simulated_pour_is_drawn_with_its_vessels_and_particles(tmp_path: Path) -> None:
    task, result = example_run.simulation()
    assert is_picture(style.save(simulation_figure(task, result), tmp_path / "pour.png"))


def test_pour_that_keeps_everything_in_the_pourer_is_drawn(tmp_path: Path) -> None:
    task, result = example_run.simulation()
    frames = result.frames
    assert frames is not None
    for states in frames.states:
        states[:] = 0
    assert is_picture(style.save(simulation_figure(task, result), tmp_path / "nothing.png"))


def test_snapshots_show_the_flow_from_its_beginning_to_its_end() -> None:
    times = np.linspace(0.0, 10.0, 101)
    left = np.clip((times - 6.0) / 2.0, 0.0, 0.9)  # flows from 6 s to 7.8 s
    shares = np.column_stack([1.0 - left, 0 * left, left, 0 * left, 0 * left])
    assert times[_moments(times, shares, 4)] == pytest.approx([6.3, 6.9, 7.5, 10.0])
    shares[:, 0] = 1.0  # nothing leaves: evenly spread
    assert times[_moments(times, shares, 4)] == pytest.approx([0.0, 3.3, 6.7, 10.0])
    assert len(_moments(times[:1], shares[:1], 4)) == 4


def test_simulation_without_frames_is_refused_with_advice(tmp_path: Path) -> None:
    task, result = example_run.simulation()
    with pytest.raises(ValueError, match="record rate above 0"):
        simulation_figure(task, SimulatedPour(result.outcome))


def test_section_of_a_cup_is_its_wall_cut_open() -> None:
    vessel = build_vessel(example_run.BEAKER)
    loops = section(vessel.solid_vertices, vessel.solid_faces)
    assert len(loops) == 1
    x, z = loops[0].T
    area = 0.5 * abs(float(np.dot(x, np.roll(z, -1)) - np.dot(z, np.roll(x, -1))))
    # two walls of 4 mm × 90 mm and a floor of 4 mm × (70 + 2·4) mm
    assert area == pytest.approx(2 * 0.004 * 0.09 + 0.004 * 0.078, rel=0.01)


def test_section_of_an_open_mesh_is_refused() -> None:
    vessel = build_vessel(example_run.BEAKER)
    with pytest.raises(ValueError, match="loose end"):
        section(vessel.solid_vertices, vessel.solid_faces[: len(vessel.solid_faces) // 2])


def test_drawn_vessel_turns_the_way_the_motion_turns_it() -> None:
    pourer, receiver = build_vessel(example_run.BEAKER), build_vessel(example_run.NARROW.receiver)
    motion = plan_motion(example_run.NARROW, example_run.ACTION, pourer, receiver)
    poses = motion.sample(np.linspace(0.0, motion.duration, 9))
    lip = pourer.lip_point(0.0)
    for pose in poses:
        x, z = place(np.array([[lip[0], lip[2]]]), pose)[0]
        assert (x, z) == pytest.approx((motion.pivot_world[0], motion.pivot_world[2]), abs=1e-9)
    rim = place(np.array([[0.0, 0.1]]), np.array([0, 0, 0, math.cos(0.25), 0, math.sin(0.25), 0]))[0]
    assert rim[0] > 0.0  # a positive tilt tips the opening towards the receiver
