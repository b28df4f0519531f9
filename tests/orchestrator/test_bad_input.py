"""Every bad input gets an error that says where it is, what is wrong and what would be right."""

from __future__ import annotations

import textwrap
from pathlib import Path

import pytest

from orchestrator.config.assignments import AssignmentError, set_action
from orchestrator.config.check import check_campaign
from orchestrator.config.errors import ConfigError
from orchestrator.config.load import load_campaign, load_laboratory, load_parameters, load_vessel

CAMPAIGN = """\
name: test
laboratory: lab.yaml
liquid: {name: water, mass: 200 g}
pourer: beaker.yaml
receiver: cup.yaml
motion: {max_angle: 110 deg, x_offset: 84 mm, height: 90 mm}
simulator:
  parameters:
    cohesion: [0 N/m, 0.1 N/m]
calibration:
  actions: {angular_velocity: [15 deg/s, 120 deg/s]}
  pours: {count: 8, holdout: 2}
  simulations: 20
"""

RECORDED = CAMPAIGN.replace("{count: 8, holdout: 2}", "{from: pours.csv}").replace(
    "[15 deg/s, 120 deg/s]}", "[15 deg/s, 120 deg/s], max_angle: [70 deg, 125 deg]}"
).replace("max_angle: 110 deg, ", "")  # fmt: skip

DEPLOYED = (
    CAMPAIGN
    + """\
deployment:
  strategy: D3
  actions: {angular_velocity: [15 deg/s, 120 deg/s]}
  pours: 15
"""
)

VESSEL = """\
name: beaker
profile:
  unit: mm
  inner: [[0, 0], [40, 0], [40, 100]]
  wall: 4 mm
  floor: 4 mm
"""

LABORATORY = """\
name: lab
bench:
  liquid: {particles: 4000}
"""

CSV = """\
angular_velocity_deg_s,max_angle_deg,poured_g,spilled_g,retained_g,split
20,95,180,4,20,train
60,110,190,30,10,train
80,120,200,50,0,test
"""


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return write_good(tmp_path)


def write(folder: Path, name: str, text: str) -> Path:
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return path


def write_good(folder: Path) -> Path:
    """What the campaigns here refer to."""
    write(folder, "lab.yaml", LABORATORY)
    write(folder, "beaker.yaml", VESSEL)
    write(folder, "cup.yaml", VESSEL.replace("beaker", "cup").replace("40", "32"))
    write(folder, "pours.csv", CSV)
    return folder


def report(path: Path) -> str:
    with pytest.raises(ConfigError) as caught:
        load_campaign(path)
    return str(caught.value)


def test_the_good_inputs_that_the_table_spoils_are_good(folder: Path) -> None:
    for text in (CAMPAIGN, RECORDED, DEPLOYED):
        load_campaign(write(folder, "good.yaml", text))


BAD_CAMPAIGNS = {
    "misspelt key": (
        DEPLOYED,
        "pours: 15",
        "pour: 15",
        "bad.yaml:17:3: deployment.pour: unknown key; did you mean 'pours'?",
    ),
    "unknown key": (CAMPAIGN, "name: test", "name: test\nzebra: 1", "2:1: zebra: unknown key; known here: "),
    "action dimension in the wrong place": (
        CAMPAIGN,
        "name: test",
        "name: test\nmax_angle: 110 deg",
        "2:1: max_angle: unknown key here; fix it under 'motion",
    ),
    "duplicate key": (
        CAMPAIGN,
        "name: test",
        "name: test\nname: again",
        "2:1: name: duplicate key; it stands in line 1",
    ),
    "bare number": (CAMPAIGN, "110 deg", "110", "6:21: motion.max_angle: 110 has no unit; write '110 deg'"),
    "another dimension": (CAMPAIGN, "84 mm", "84 deg", "'84 deg' is an angle; should be a length, for example '90 mm'"),
    "frequency for an angular velocity": (
        CAMPAIGN,
        "15 deg/s",
        "15 Hz",
        "11:32: calibration.actions.angular_velocity[0]: '15 Hz' is a rate; should be an angular",
    ),
    "misspelt unit": (CAMPAIGN, "120 deg/s", "120 dge/s", "unknown unit 'dge/s'; did you mean 'deg/s'?"),
    "no quantity at all": (CAMPAIGN, "200 g", "plenty", "liquid.mass: 'plenty' is not a quantity; should be a mass"),
    "not positive": (CAMPAIGN, "200 g", "0 g", "liquid.mass: 0 g should be above 0"),
    "out of bounds": (CAMPAIGN, "120 deg/s", "720 deg/s", "720 deg/s is outside 1 … 360 deg/s"),
    "reversed bounds": (CAMPAIGN, "[15 deg/s, 120 deg/s]", "[120 deg/s, 15 deg/s]", "bounds should increase"),
    "range with one end": (CAMPAIGN, "[15 deg/s, 120 deg/s]", "[15 deg/s]", "a range has two ends: [lowest, highest]"),
    "log scale from zero": (
        CAMPAIGN,
        "[0 N/m, 0.1 N/m]",
        "{range: [0 N/m, 0.1 N/m], scale: log}",
        "a log scale needs a lowest value above 0",
    ),
    "unknown parameter": (CAMPAIGN, "cohesion:", "cohesoin:", "cohesoin: unknown key; did you mean 'cohesion'?"),
    "dimension without a value": (
        CAMPAIGN,
        "max_angle: 110 deg, ",
        "",
        "10:1: calibration: max_angle has no value; fix it under motion",
    ),
    "fixed and searched": (
        CAMPAIGN,
        "calibration:",
        "calibration:\n  motion: {angular_velocity: 40 deg/s}",
        "11:12: calibration.motion.angular_velocity: is searched by calibration.actions.angular_velocity too",
    ),
    "step on a bench": (
        CAMPAIGN,
        "max_angle: 110 deg",
        "max_angle: 110 deg, angular_acceleration: step",
        "'step' only replays recorded pours",
    ),
    "unknown strategy": (
        DEPLOYED,
        "strategy: D3",
        "strategy: D4",
        "deployment.strategy: 'D4' is not known here; should be 'D1', ",
    ),
    "key of another strategy": (
        DEPLOYED,
        "strategy: D3",
        "strategy: D3\n  iterations: 9",
        "deployment.iterations: belongs to D1, not to D3",
    ),
    "prices that decide nothing": (
        DEPLOYED,
        "strategy: D3",
        "strategy: D3\n  per_pour: 2\n  prices: {pour: 60 s}",
        "deployment.prices: decides nothing with 'per_pour: 2'; write 'per_pour: free', or remove it",
    ),
    "learning without pours": (
        DEPLOYED,
        "  pours: 15\n",
        "",
        "14:1: deployment: key 'pours' is missing; D3 learns on real",
    ),
    "ranges that nothing searches": (
        DEPLOYED.replace(CAMPAIGN[CAMPAIGN.index("calibration:") :], ""),
        "",
        "",
        "simulator.parameters.cohesion: is a range, and nothing searches it; write one value, or add a 'calibration'",
    ),
    "nothing to calibrate": (CAMPAIGN, "[0 N/m, 0.1 N/m]", "0.1 N/m", "10:1: calibration: has nothing to search"),
    "all pours held out": (CAMPAIGN, "holdout: 2", "holdout: 8", "keeps 8 of 8 pours for testing"),
    "too few simulations": (CAMPAIGN, "simulations: 20", "simulations: 4", "8 random parameters don't fit into 4"),
    "count as text": (
        CAMPAIGN,
        "count: 8",
        "count: many",
        "pours.count: should be a whole number, got the text 'many'",
    ),
    "neither count nor word": (
        DEPLOYED,
        "pours: 15",
        "pours: 15\n  per_pour: four",
        "deployment.per_pour: should be a whole number, or 'free'",
    ),
    "negative count in place of a word": (
        DEPLOYED,
        "pours: 15",
        "pours: 15\n  per_pour: -1",
        "deployment.per_pour: -1 is too small; at least 0",
    ),
    "negative seed": (CAMPAIGN, "name: test", "name: test\nseed: -1", "seed: -1 is too small; at least 0"),
    "empty value": (CAMPAIGN, "name: test", "name:", "1:1: name: has no value; give one, or remove the key"),
    "missing key": (CAMPAIGN, "liquid: {name: water, mass: 200 g}\n", "", "key 'liquid' is missing; add for example"),
    "missing file": (CAMPAIGN, "beaker.yaml", "baeker.yaml", "4:9: pourer: no such file: "),
    "vessel in place of a laboratory": (
        CAMPAIGN,
        "lab.yaml",
        "cup.yaml",
        "bad.yaml:2:13: laboratory: cup.yaml describes a vessel, but a laboratory is needed here",
    ),
    "laboratory in place of a vessel": (
        CAMPAIGN,
        "cup.yaml",
        "lab.yaml",
        "bad.yaml:5:11: receiver: lab.yaml describes a laboratory, but a vessel is needed here",
    ),
    "mesh in place of a vessel": (
        CAMPAIGN,
        "cup.yaml",
        "cup.stl",
        "receiver: is a mesh; write {name: cup, mesh: cup.stl",
    ),
    "no receivers at all": (
        DEPLOYED,
        "strategy: D3",
        "strategy: D3\n  receivers: []",
        "bad.yaml:16:14: deployment.receivers: is empty; name at least one vessel",
    ),
    "no receivers at the top": (
        DEPLOYED.replace("calibration:\n", "calibration:\n  receiver: cup.yaml\n"),
        "receiver: cup.yaml",
        "receivers: []",
        "bad.yaml:5:12: receivers: is empty; name at least one vessel",
    ),
    "two receivers of one name": (
        CAMPAIGN + "deployment: {strategy: D2, pours: 3, receivers: [cup.yaml, cup.yaml], "
        "motion: {angular_velocity: 9 deg/s}, actions: {x_offset: [80 mm, 99 mm]}}",
        "",
        "",
        "deployment.receivers[1]: a receiver is called 'cup' already",
    ),
    "bad name of an inline receiver": (
        CAMPAIGN + "deployment: {strategy: D2, pours: 3, receivers: [{name: /cup, profile: "
        "{unit: mm, inner: [[0, 0], [32, 0], [32, 100]], wall: 4 mm, floor: 4 mm}}], "
        "motion: {angular_velocity: 9 deg/s}, actions: {x_offset: [80 mm, 99 mm]}}",
        "",
        "",
        "deployment.receivers[0].name: '/cup' should consist of letters, digits",
    ),
    "bad indentation": (CAMPAIGN, "  simulations: 20", "   simulations: 20", "13:4: not YAML: "),
    "tab": (CAMPAIGN, "  simulations: 20", "\tsimulations: 20", "a tab; YAML is indented with spaces"),
    "open bracket": (CAMPAIGN, "0.1 N/m]", "0.1 N/m", "not YAML: "),
    "empty file": (CAMPAIGN, CAMPAIGN, "# nothing yet\n", "bad.yaml:1:1: the file is empty"),
    "a list": (CAMPAIGN, CAMPAIGN, "- name: test\n", "should be a mapping with keys such as name"),
    "two documents": (CAMPAIGN, "calibration:", "---\ncalibration:", "a file holds one document"),
    "repeat without a bench": (
        RECORDED.replace("lab.yaml", "{name: desk}"),
        "name: test",
        "name: test\non_unknown: repeat",
        "on_unknown: 'repeat' needs a virtual bench, and laboratory 'desk' has none; use 'ask'",
    ),
    "pours without a bench": (
        CAMPAIGN,
        "lab.yaml",
        "{name: desk}",
        "laboratory 'desk' has no bench to pour on; name a CSV",
    ),
    "missing CSV": (RECORDED, "pours.csv", "puors.csv", "calibration.pours.from: no such file: "),
    "count beside a CSV": (
        RECORDED,
        "{from: pours.csv}",
        "{from: pours.csv, count: 3}",
        "pours.count: belongs to pours that",
    ),
    "wrong lip radius": (
        RECORDED,
        "pours.csv}",
        "pours.csv, lip_radius: 4 mm}",
        "lip_radius: is 4 mm, but the rim of pourer 'beaker' has",
    ),
}


@pytest.mark.parametrize("case", BAD_CAMPAIGNS, ids=lambda case: case.replace(" ", "-"))
def test_bad_campaign_is_refused_with(case: str, folder: Path) -> None:
    good, old, new, expected = BAD_CAMPAIGNS[case]
    assert old in good
    text = report(write(folder, "bad.yaml", good.replace(old, new, 1)))
    assert expected in text
    assert text.count("bad.yaml:") == 1, "one cause, one message"


BAD_RECORDS = {
    "misspelt column": (
        "max_angle_deg",
        "max_angel_deg",
        "pours.csv:1:24: max_angel_deg: unknown column; did you mean 'max_",
    ),
    "missing column": ("retained_g", "x_offset_mm", "pours.csv:1:1: column 'retained_g' is missing"),
    "not a number": ("60,110,190", "60,110,lots", "pours.csv:3:8: poured_g: 'lots' is not a number"),
    "empty cell": ("60,110,190", "60,,190", "pours.csv:3:4: max_angle_deg: is empty"),
    "short line": ("80,120,200,50,0,test", "80,120,200", "pours.csv:4:1: has 3 cells, the header 6"),
    "masses that don't add up": (
        "190,30,10",
        "150,30,10",
        "pours.csv:3:8: poured_g: poured 150 g + retained 10 g = 160 g, but",
    ),
    "more spilled than poured": (
        "180,4,20",
        "180,190,20",
        "pours.csv:2:11: spilled_g: spilled 190 g, more than the 180 g",
    ),
    "unknown split": ("0,test", "0,tset", "pours.csv:4:17: split: 'tset' is not known; should be one of train, test"),
    "impossible angle": (
        "80,120",
        "80,720",
        "pours.csv:4:4: max_angle_deg: 720 makes max_angle 720, outside 5 … 175 deg",
    ),
    "lip distance without radius": (
        "max_angle_deg",
        "lip_to_receiver_axis_mm",
        "needs 'lip_radius' beside 'from' in the campaign",
    ),
    "varies but is not searched": (
        CSV,
        "angular_velocity_deg_s,max_angle_deg,height_mm,poured_g,spilled_g,retained_g,split\n"
        "20,95,90,180,4,20,train\n30,99,60,180,4,20,train\n",
        "height varies in the file and is not searched; add it to calibration.actions",
    ),
    "no training pours": (CSV, CSV.replace("train", "test"), "has no pour with split 'train'"),
    "only a header": (CSV, CSV.splitlines()[0], "has no pours"),
}


@pytest.mark.parametrize("case", BAD_RECORDS, ids=lambda case: case.replace(" ", "-"))
def test_bad_record_is_refused_with(case: str, folder: Path) -> None:
    old, new, expected = BAD_RECORDS[case]
    assert old in CSV
    write(folder, "pours.csv", CSV.replace(old, new, 1))
    text = report(write(folder, "recorded.yaml", RECORDED))
    assert expected in text


BAD_VESSELS = {
    "no shape": ("name: cup\n", "vessel.yaml:1:1: has no shape; add 'profile:'"),
    "rim below": (VESSEL.replace("[40, 100]", "[40, 0.0]"), "inner[2]: "),
    "off the axis": (
        VESSEL.replace("[[0, 0]", "[[1, 0]"),
        "4:11: profile.inner[0]: the first point is the inner floor",
    ),
    "implausible size": (
        VESSEL.replace("unit: mm", "unit: m"),
        "profile.unit: in m the vessel would be 100000 mm large",
    ),
    "bare wall": (VESSEL.replace("wall: 4 mm", "wall: 4"), "5:9: profile.wall: 4 has no unit; write '4 mm'"),
    "point in space": (VESSEL.replace("[40, 100]", "[40, 0, 100]"), "profile.inner[2]: has 3 items; should have 2"),
    "mesh of another kind": ("name: mug\nmesh: mug.step\n", "2:7: mesh: .step is no mesh; use STL, OBJ, PLY or GLB"),
    "mesh that is not there": ("name: mug\nmesh: mug.stl\n", "2:7: mesh: no such file: "),
    "two shapes": (VESSEL + "mesh: mug.stl\n", "7:1: mesh: the vessel has a profile already"),
    "unknown unit": (VESSEL.replace("unit: mm", "unit: feet"), "profile.unit: 'feet' is not known here; should be"),
}


@pytest.mark.parametrize("case", BAD_VESSELS, ids=lambda case: case.replace(" ", "-"))
def test_bad_vessel_is_refused_with(case: str, folder: Path) -> None:
    text, expected = BAD_VESSELS[case]
    with pytest.raises(ConfigError) as caught:
        load_vessel(write(folder, "vessel.yaml", text))
    assert expected in str(caught.value)


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


BAD_PARAMETERS = {
    "unknown parameter": ('{"theta": {"cohesin": 0.1}}', "theta.cohesin: unknown key; did you mean 'cohesion'?"),
    "out of bounds": ("particles: 3", "1:12: particles: 3 is outside 200 … 50000"),
    "broken number": ("particles: 1500.5", "particles: 1500.5 should be a whole number"),
    "nothing known": ("{}", "names no parameter; known are particles, cohesion"),
    "another unit": ("viscosity: 3 mm", "viscosity: '3 mm' is a length; should be a rate"),
}


@pytest.mark.parametrize("case", BAD_PARAMETERS, ids=lambda case: case.replace(" ", "-"))
def test_bad_parameter_file_is_refused_with(case: str, folder: Path) -> None:
    text, expected = BAD_PARAMETERS[case]
    with pytest.raises(ConfigError) as caught:
        load_parameters(write(folder, "theta.json", text))
    assert expected in str(caught.value)


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
