"""`appearance`: an arm is drawn where its kinematics say that it is."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from actors.arm.arm_settings import arm_kind
from actors.arm.ur_settings import UrArmSettings
from actors.arm_geometry import Point
from orchestrator.campaigns.file_loading import load_laboratory

FILE = Path(__file__).parents[3] / "configs" / "laboratories" / "virtual.yaml"


def _arm() -> UrArmSettings:
    spec = load_laboratory(FILE).arm
    assert isinstance(spec, UrArmSettings)
    return spec


def test_links_are_joined_and_as_long_as_they_are_whatever_the_joints() -> None:
    figure = arm_kind(_arm()).figure()
    joints = np.array(figure.home) + np.random.default_rng(1).uniform(-1.0, 1.0, (20, 6))
    ends = figure.ends(joints)
    assert ends.shape == (20, len(figure.bars), 2, 3)
    lengths = np.linalg.norm(ends[:, :, 1] - ends[:, :, 0], axis=-1)
    assert np.allclose(lengths, lengths[0], atol=1e-12)
    assert np.allclose(ends[:, :-1, 1], ends[:, 1:, 0])
    # a UR10: 612 and 572.3 mm
    assert np.isclose(lengths[0, 2], 0.612)
    assert np.isclose(lengths[0, 4], 0.5723)


def test_the_last_link_ends_at_the_tool_and_the_pourer_is_held_by_it() -> None:
    figure = arm_kind(_arm()).figure()
    joints = np.array([figure.home])
    tool, pourer = figure.tool(joints), figure.pourer(joints)
    assert np.allclose(figure.ends(joints)[:, -1, 1], tool[:, :3])
    assert np.allclose(figure.tool_of(pourer), tool[:, :3])


def test_arm_that_is_leant_or_stands_elsewhere_is_drawn_there() -> None:
    spec = _arm()
    there = spec.with_values(cell=spec.cell.with_values(receiver=Point.of(0.75, 0.1, 0.06)))
    home = np.array(spec.home.angles)
    moved = arm_kind(there).figure().ends(home) - arm_kind(spec).figure().ends(home)
    # the liquid goes along the base's y, which is the world's x
    assert np.allclose(moved, [-0.1, 0.0, 0.0])
