"""`campaign_file`: every bad campaign or record gets an error that says where it is, what is wrong and what would
be right.
"""

from __future__ import annotations

from pathlib import Path

import pytest

from orchestrator.campaigns.file_loading import load_campaign
from tests.support.campaign_files import CAMPAIGN, CSV, DEPLOYED, RECORDED, report, write


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
    "decimal comma": (CAMPAIGN, "mass: 200 g", 'mass: "1,5 kg"', "'1,5 kg' has a decimal comma; write '1.5 kg'"),
    "another dimension": (CAMPAIGN, "84 mm", "84 deg", "'84 deg' is an angle; should be a length, for example '90 mm'"),
    "frequency for an angular velocity": (
        CAMPAIGN,
        "15 deg/s",
        "15 Hz",
        "11:32: calibration.actions.angular_velocity[0]: '15 Hz' is a rate; should be an angular",
    ),
    "misspelt unit": (CAMPAIGN, "120 deg/s", "120 dge/s", "unknown unit 'dge/s'; did you mean 'deg/s'?"),
    "no quantity at all": (CAMPAIGN, "200 g", "plenty", "liquid.mass: 'plenty' is not a quantity; should be a mass"),
    "not positive": (CAMPAIGN, "200 g", "0 g", "liquid.mass: 0 g is outside 0.1 … 20000 g"),
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
    "costs that decide nothing": (
        DEPLOYED,
        "strategy: D3",
        "strategy: D3\n  simulations_per_pour: 2\n  costs: {pour: 60 s}",
        "deployment.costs: unknown key; simulations run while the arm pours, 'simulations_per_pour' of them; remove it",
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
    "all pours but one held out": (
        CAMPAIGN,
        "holdout: 2",
        "holdout: 7",
        "pours.holdout: keeps 7 of 8 pours for testing, so that 1 is left to fit; a calibration needs 2",
    ),
    "a single pour": (
        CAMPAIGN,
        "count: 8, holdout: 2",
        "count: 1",
        "pours.count: keeps 0 of 1 pours for testing, so that 1 is left to fit; a calibration needs 2",
    ),
    "too few simulations": (CAMPAIGN, "simulations: 20", "simulations: 4", "8 random parameters don't fit into 4"),
    "too many pours": (
        CAMPAIGN,
        "count: 8",
        "count: 1000000000",
        "pours.count: 1000000000 is too large; at most 2,000: the surrogates are made for some hundreds of pours",
    ),
    "too many pours for a deployment": (
        DEPLOYED,
        "pours: 15",
        "pours: 1000000000",
        "deployment.pours: 1000000000 is too large; at most 2,000: the surrogates",
    ),
    "too many simulations between pours": (
        DEPLOYED,
        "pours: 15",
        "pours: 15\n  simulations_per_pour: 1000000000",
        "deployment.simulations_per_pour: 1000000000 is too large; at most 200,000: at ten simulations a second",
    ),
    "too many simulations before pours": (
        DEPLOYED,
        "pours: 15",
        "pours: 15\n  prior_simulations: 1000000000",
        "deployment.prior_simulations: 1000000000 is too large; at most 200,000",
    ),
    "too large a baseline": (
        CAMPAIGN,
        "simulations: 20",
        "simulations: 20\n  random_baseline: 1000000000",
        "calibration.random_baseline: 1000000000 is too large; at most 200,000",
    ),
    "home of nobody": (
        CAMPAIGN,
        "name: test",
        "name: test\noutputs: {directory: ~nobody-of-this-name/runs}",
        "outputs.directory: '~nobody-of-this-name' is not the home directory of any user",
    ),
    "count as text": (
        CAMPAIGN,
        "count: 8",
        "count: many",
        "pours.count: should be a whole number, got the text 'many'",
    ),
    "neither count nor word": (
        DEPLOYED,
        "pours: 15",
        "pours: 15\n  simulations_per_pour: four",
        "deployment.simulations_per_pour: should be a whole number, got the text 'four'",
    ),
    "negative count in place of a word": (
        DEPLOYED,
        "pours: 15",
        "pours: 15\n  simulations_per_pour: -1",
        "deployment.simulations_per_pour: -1 is too small; at least 0",
    ),
    "negative seed": (CAMPAIGN, "name: test", "name: test\nseed: -1", "seed: -1 is too small; at least 0"),
    "seed beyond 63 bits": (CAMPAIGN, "name: test", f"name: test\nseed: {2**63}", f"seed: {2**63} is too large; at"),
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
    "a single training pour": (
        CSV,
        CSV.replace("train", "test", 1),
        "calibration.pours.from: has 1 training pour with at least 5% poured; a calibration needs 2",
    ),
    "only a header": (CSV, CSV.splitlines()[0], "has no pours"),
}


@pytest.mark.parametrize("case", BAD_RECORDS, ids=lambda case: case.replace(" ", "-"))
def test_bad_record_is_refused_with(case: str, folder: Path) -> None:
    old, new, expected = BAD_RECORDS[case]
    assert old in CSV
    write(folder, "pours.csv", CSV.replace(old, new, 1))
    text = report(write(folder, "recorded.yaml", RECORDED))
    assert expected in text
