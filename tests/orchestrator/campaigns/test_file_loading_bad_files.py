"""`file_loading`: bad meshes and values of the command line, and campaigns that no vessel can serve."""

from __future__ import annotations

import textwrap
from pathlib import Path

import pytest

from orchestrator.campaigns.action_assignments import AssignmentError, set_action
from orchestrator.campaigns.campaign_checks import check_campaign
from orchestrator.campaigns.file_loading import load_campaign, load_laboratory
from orchestrator.campaigns.yaml.yaml_errors import ConfigError
from tests.support.campaign_files import CAMPAIGN, DEPLOYED, LABORATORY, VESSEL, write


def test_bad_mesh_is_refused_by_the_check_with_its_file(folder: Path) -> None:
    write(folder, "open.stl", TETRAHEDRON_WITH_A_HOLE)
    write(folder, "cup.yaml", "name: open\nmesh: open.stl\nunit: mm\n")
    (problem,) = map(str, check_campaign(load_campaign(write(folder, "campaign.yaml", CAMPAIGN))))
    assert problem.startswith("campaign.yaml:5:11: receiver: vessel 'open' (")
    assert "open.stl" in problem
    assert "watertight" in problem


def test_vessel_that_is_too_small_is_refused_by_the_check(folder: Path) -> None:
    write(folder, "cup.yaml", VESSEL.replace("beaker", "thimble").replace("40", "12").replace("100", "30"))
    deployed = DEPLOYED.replace("strategy: D3", "strategy: D3\n  receivers: [beaker.yaml, cup.yaml]")
    problems = map(str, check_campaign(load_campaign(write(folder, "campaign.yaml", deployed))))
    small = [text for text in problems if "thimble holds" in text]
    assert [text.partition(" ")[0] for text in small] == ["campaign.yaml:5:11:", "campaign.yaml:16:28:"]
    assert all("receiver can't hold the water (200 g)" in text for text in small)


def test_scene_in_which_all_actions_touch_is_refused_by_the_check(folder: Path) -> None:
    close = write(folder, "campaign.yaml", CAMPAIGN.replace("84 mm", "60 mm"))
    (problem,) = map(str, check_campaign(load_campaign(close)))
    assert problem.startswith(
        "campaign.yaml:11:12: calibration.actions: calibration: the vessels touch at every action"
    )
    assert "x_offset" in problem


@pytest.mark.parametrize(
    ("old", "new", "place"),
    [
        ("max_angle: 110 deg", "max_angle: 20 deg", "campaign.yaml:6:21: motion.max_angle"),
        ("deg/s]}", "deg/s], max_angle: [10 deg, 20 deg]}", "campaign.yaml:11:65: calibration.actions.max_angle"),
    ],
)
def test_campaign_that_can_never_pour_is_refused_by_the_check(folder: Path, old: str, new: str, place: str) -> None:
    text = CAMPAIGN if "motion" in place else CAMPAIGN.replace("max_angle: 110 deg, ", "")
    (problem,) = map(str, check_campaign(load_campaign(write(folder, "campaign.yaml", text.replace(old, new)))))
    assert problem.startswith(
        f"{place}: calibration: no action that was tried pours anything: max_angle is at most 20 deg"
    )
    # by quadrature a glass of 80 mm × 100 mm retains 208.4 mL at 56 deg and 199.3 mL at 57 deg; 200.4 mL are loaded
    assert "the water (200 g) reaches the lip at 57 deg; raise max_angle" in problem
    enough = write(folder, "campaign.yaml", CAMPAIGN.replace("max_angle: 110 deg", "max_angle: 60 deg"))
    assert check_campaign(load_campaign(enough)) == []


BAD_ASSIGNMENTS = {
    "no value": ("x_offset", "'x_offset': should be name=value"),
    "unknown dimension": ("x_ofset=90", "unknown dimension 'x_ofset'; did you mean 'x_offset'?"),
    "wrong unit": ("x_offset=90 deg", "'90 deg' is an angle; should be a length"),
    "out of bounds": ("max_angle=200", "200 deg is outside 5 … 175 deg"),
    "no number": ("angular_velocity=fast", "'fast' is not a quantity"),
    "not a switch": ("return_velocity=step", "'step' is not a quantity; should be an angular velocity"),
}


@pytest.mark.parametrize("case", BAD_ASSIGNMENTS, ids=lambda case: case.replace(" ", "-"))
def test_bad_value_on_the_command_line_is_refused_with(case: str) -> None:
    text, expected = BAD_ASSIGNMENTS[case]
    with pytest.raises(AssignmentError) as caught:
        set_action(["angular_velocity=40", "height=90", text] if case != "no number" else [text])
    assert expected in str(caught.value)


def test_dimension_missing_on_the_command_line_is_named() -> None:
    with pytest.raises(AssignmentError, match=r"x_offset has no value; add for example --set x_offset=90"):
        set_action(["angular_velocity=40", "height=90"])


def test_bad_laboratory_is_refused_with_its_place(folder: Path) -> None:
    text = LABORATORY + "  balance: {resolution: 0.1}\n"
    with pytest.raises(
        ConfigError, match=r"bad\.yaml:4:25: bench\.balance\.resolution: 0\.1 has no unit; write '0\.1 g'"
    ):
        load_laboratory(write(folder, "bad.yaml", text))


TETRAHEDRON_WITH_A_HOLE = textwrap.dedent("""\
    solid open
    facet normal 0 0 0
    outer loop
    vertex 0 0 0
    vertex 60 0 0
    vertex 0 60 0
    endloop
    endfacet
    facet normal 0 0 0
    outer loop
    vertex 0 0 0
    vertex 0 0 60
    vertex 60 0 0
    endloop
    endfacet
    facet normal 0 0 0
    outer loop
    vertex 0 0 0
    vertex 0 60 0
    vertex 0 0 60
    endloop
    endfacet
    endsolid open
    """)
