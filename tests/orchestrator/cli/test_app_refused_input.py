"""`app`: what the command refuses, with which words, and how soon."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from tests.support.cli_inputs import SIMULATE, process, refused

# command line: what stderr has to say; where it begins, for files with lines
BAD: dict[str, str] = {
    # files
    "run nowhere.yaml": "nowhere.yaml: no such file",
    "run folder": "folder: is a directory; name a file in it",
    "run binary.yaml": "binary.yaml: is not text in UTF-8 (byte 128)",
    "run null.yaml": "null.yaml:2:7: not YAML: an unprintable character (code 0)",
    "run empty.yaml": "empty.yaml:1:1: the file is empty",
    "run beaker.yaml": "beaker.yaml: describes a vessel, but a campaign is needed here",
    # YAML
    "run misspelt.yaml": "misspelt.yaml:29:3: deployment.pour: unknown key; did you mean 'pours'?",
    "run unitless.yaml": "unitless.yaml:11:29: liquid.mass: 100 has no unit; write '100 g'",
    "run wrong-unit.yaml": "wrong-unit.yaml:18:22: calibration.motion.x_offset: '66 deg' is an angle; should be",
    "run duplicate.yaml": "duplicate.yaml:3:1: seed: duplicate key; it stands in line 2 already",
    "run tab.yaml": "tab.yaml:24:1: not YAML: a tab; YAML is indented with spaces",
    "run no-cup.yaml": "no-cup.yaml:17:13: calibration.receiver: no such file: ",
    "calibrate plan-only.yaml": "plan-only.yaml: has no 'calibration' section; there is nothing to calibrate",
    "plan calibrate-only.yaml": "calibrate-only.yaml: has no 'deployment' section",
    # vessels and scenes
    "run heavy.yaml": "narrow holds 113.1 mL to the brim, 120.2 mL asked for",
    "calibrate unwritable.yaml": "beaker.yaml/runs can't be written: ",
    "plan unwritable.yaml": "unwritable.yaml:32:22: outputs.directory: ",
    "calibrate passwd.yaml": "passwd.yaml:32:22: outputs.directory: /etc/passwd can't be written: /etc/passwd is",
    "run close.yaml": "deployment.actions: deployment into 'narrow': the vessels touch at every action that was",
    "run open-mesh.yaml": "open.stl: not watertight: 3 edge(s)",
    "run solid-mesh.yaml": "solid.stl: no cavity: the mesh is one closed skin",
    "run junk-mesh.yaml": "junk.stl: no triangles in it",
    "run metres-mesh.yaml": "largest extent of 80 m is not a vessel's size (5 … 1000 mm); is its unit 'mm' (80 mm)?",
    "run unitless-mesh.yaml": "its largest extent would be 80 m; a vessel measures 20 … 500 mm. State its unit: 'mm'",
    # CSV
    "calibrate number-csv.yaml": "number.csv:3:9: poured_g: '9x5' is not a number",
    "calibrate column-csv.yaml": "column.csv:1:1: column 'spilled_g' is missing",
    "calibrate mass-csv.yaml": "poured 90 g + retained 90 g = 180 g, but 100 g were loaded",
    "calibrate nothing-csv.yaml": "nothing.csv: is empty; it needs a header and a line for each row",
    f"{SIMULATE} --parameters odd-theta.json": "odd-theta.json:1:56: remaining_discrepancy: needs a 'shift' from 0 on",
    # values on the command line
    "run small.yaml --laboratory gone.yaml": "gone.yaml: no such file",
    "plan small.yaml --laboratory small.yaml": "small.yaml: describes a campaign, but a laboratory is needed here",
    f"{SIMULATE} --rrd {'x' * 300}.rrd": "can't be written: File name too long",
    f"{SIMULATE} --png /proc/pour.png": "--png /proc/pour.png: can't be written: ",
    "run small.yaml --resume": "no unfinished run of campaign 'small'; begin one without --resume",
    "run small.yaml --resume --run nope": "runs/nope: no such run; known: none",
    "run small.yaml --run nope": "--run nope: goes with --resume",
    "run small.yaml --answer lost": "--answer 'lost': goes with --resume",
    "plan small.yaml --parameters misspelt-theta.yaml": "misspelt-theta.yaml:1:9: theta.cohesoin: unknown key; did you",
    "plan small.yaml --parameters wild-theta.json": "theta.cohesion: 50 N/m is outside 0 … 0.2 N/m",
    "plan small.yaml --parameters list-theta.json": "should be a mapping with keys such as particles",
    "plan small.yaml --parameters gone.json": "gone.json: no such file",
    "plan small.yaml --receiver small.yaml": "small.yaml: describes a campaign, but a vessel is needed here",
    "plan small.yaml --receiver solid.stl": "is a mesh; describe the vessel in a YAML file: {name: solid, mesh:",
    "plan small.yaml --receiver solid-cup.yaml": "small.yaml: vessel 'solid' (",
    "simulate small.yaml --set angular_velocity=100": "x_offset has no value; add for example --set x_offset=80",
    f"{SIMULATE} --set x_ofset=80": "'x_ofset=80': unknown dimension 'x_ofset'; did you mean 'x_offset'?",
    f"{SIMULATE} --set x_offset=80": "'x_offset' is given twice; keep one",
    f"{SIMULATE} --set height": "'height': should be name=value, for example x_offset=90",
    f"{SIMULATE} --set height=high": "'height=high': 'high' is not a quantity; should be a length",
    f"{SIMULATE} --set 'height=3 kg'": "'3 kg' is a mass; should be a length",
    f"{SIMULATE} --set max_angle=500": "'max_angle=500': 500 deg is outside ",
    "simulate small.yaml --set angular_velocity=100 --set x_offset=10": "cups touch: at tilt 0° the pourer",
    "simulate heavy.yaml --set angular_velocity=100 --set x_offset=70": "narrow holds 113.1 mL to the brim",
    f"{SIMULATE} --receiver open-cup.yaml": "open.stl: not watertight",
    f"{SIMULATE} --png nowhere/pour.png": "--png nowhere/pour.png: its folder does not exist",
    f"{SIMULATE} --png folder": "--png folder: is a folder; name a file in it",
    f"{SIMULATE} --png pour.doc": "--png pour.doc: should end in .png",
    f"{SIMULATE} --rrd folder": "--rrd folder: is a folder; name a file in it",
    "schema zebra": "no schema 'zebra'; there are campaign, vessel, laboratory, study",
}

# click's own, in a frame after the usage
BAD_USAGE = {
    "run": "Missing argument 'CAMPAIGN'",
    "run small.yaml --resumee": "No such option: --resumee",
    "bake small.yaml": "No such command 'bake'",
    "plan small.yaml --iterations 1": "Invalid value for '--iterations'",
    "plan small.yaml --seed -1": "Invalid value for '--seed'",
    "plan small.yaml --seeds 1": "Invalid value for '--seeds'",
    f"{SIMULATE} --seeds 0": "Invalid value for '--seeds'",
    f"{SIMULATE} --seed many": "Invalid value for '--seed'",
    "validate": "Missing argument 'files'",
}


@pytest.mark.parametrize("command", BAD)
def test_bad_input_gets_one_error_that_says_what_and_where(command: str, folder: Path) -> None:
    text = refused(command, folder)
    assert BAD[command] in text
    errors = [line for line in text.splitlines() if not re.match(r"\s*\d* \| ", line)]
    assert len(errors) == 1, text


@pytest.mark.parametrize("command", BAD_USAGE)
def test_bad_usage_is_explained(command: str, folder: Path) -> None:
    text = refused(command, folder)
    assert "Usage: decant" in text
    assert BAD_USAGE[command] in text


@pytest.mark.slow
@pytest.mark.parametrize(
    "command",
    [
        pytest.param("run misspelt.yaml", marks=pytest.mark.slow),
        "run open-mesh.yaml",
        pytest.param("plan small.yaml --receiver small.yaml", marks=pytest.mark.slow),
        "simulate small.yaml --set angular_velocity=100 --set x_offset=10",
    ],
)
def test_refusing_wakes_nothing_heavy(command: str, inputs: Path) -> None:
    done = process(command, inputs)
    assert done.returncode == 2
    assert done.stderr.splitlines()[-1] == "loaded:"
    assert not (inputs / "runs").exists()
