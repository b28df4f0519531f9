"""The command itself: what it refuses and with which words, what it prints, what its help teaches."""

from __future__ import annotations

import errno
import json
import os
import re
import resource
import shlex
import subprocess
import sys
from pathlib import Path
from typing import Any, NoReturn, get_args

import pytest
import trimesh
from typer.testing import CliRunner

from orchestrator.cli import app
from orchestrator.commands import single
from orchestrator.commands.options import Answer
from orchestrator.strategies.deployment.trust import OPTIONS
from orchestrator.unknown import LOST, REPEAT
from sim_engine.spread import spreads
from tests.end_to_end import small
from tests.orchestrator import watched
from tests.patience import PATIENCE

CSV = """\
angular_velocity_deg_s,max_angle_deg,poured_g,spilled_g,retained_g,split
80,95,90,4,10,train
100,100,95,8,5,train
120,110,100,9,0,test
"""

RECORDED = small.CAMPAIGN.replace("{count: 3, holdout: 1}", "{from: pours.csv}")

SIMULATE = "simulate small.yaml --set angular_velocity=100 --set x_offset=70"

ROOT = Path(__file__).parents[3]


def write_inputs(folder: Path) -> None:
    """The good campaign, and everything that is wrong in one way."""
    small.write_campaign(folder)

    def write(name: str, text: str | bytes) -> None:
        (folder / name).write_bytes(text.encode() if isinstance(text, str) else text)

    def spoil(name: str, old: str, new: str, text: str = small.CAMPAIGN) -> None:
        assert old in text
        write(name, text.replace(old, new, 1))

    (folder / "folder").mkdir()
    write("binary.yaml", bytes(range(256)))
    write("null.yaml", b"name: x\nseed: \x00\n")
    write("empty.yaml", "")
    spoil("misspelt.yaml", "pours: 2", "pour: 2")
    spoil("unitless.yaml", "100 g", "100")
    spoil("wrong-unit.yaml", "x_offset: 66 mm", "x_offset: 66 deg")
    spoil("duplicate.yaml", "seed: 3", "seed: 3\nseed: 4")
    spoil("tab.yaml", "  strategy: D3", "\tstrategy: D3")
    spoil("no-cup.yaml", "tumbler.yaml", "tumbrel.yaml")
    spoil("heavy.yaml", "mass: 100 g", "mass: 120 g")
    spoil("close.yaml", "[60 mm, 100 mm]", "[10 mm, 12 mm]")
    spoil("unwritable.yaml", "directory: runs", "directory: beaker.yaml/runs")
    spoil("passwd.yaml", "directory: runs", "directory: /etc/passwd")
    start, end = small.CAMPAIGN.index("calibration:"), small.CAMPAIGN.index("deployment:")
    uncalibrated = small.CAMPAIGN[:start] + small.CAMPAIGN[end:]
    spoil("plan-only.yaml", "[0 N/m, 0.1 N/m]", "0.05 N/m", uncalibrated)
    write("calibrate-only.yaml", small.CAMPAIGN[:end])

    solid = trimesh.creation.box((60, 60, 80))
    solid.export(folder / "solid.stl")
    open_ = solid.copy()
    open_.update_faces([face != 3 for face in range(len(open_.faces))])
    open_.export(folder / "open.stl")
    write("junk.stl", bytes(200))
    meshes = {"solid": "unit: mm", "open": "unit: mm", "junk": "unit: mm", "metres": "unit: m", "unitless": ""}
    for name, unit in meshes.items():
        mesh = name if name in ("open", "junk") else "solid"
        write(f"{name}-cup.yaml", f"name: {name}\nmesh: {mesh}.stl\n{unit}\n")
        spoil(f"{name}-mesh.yaml", "narrow.yaml", f"{name}-cup.yaml")

    write("pours.csv", CSV)
    tables = {
        "number": CSV.replace("95,8", "9x5,8"),
        "column": re.sub(r"spilled_g,|(?<=\d,)[489](?=,\d)", "", CSV).replace(",,", ","),
        "mass": CSV.replace("90,4,10", "90,4,90"),
        "nothing": "",
    }
    for name, table in tables.items():
        write(f"{name}.csv", table)
        spoil(f"{name}-csv.yaml", "pours.csv", f"{name}.csv", RECORDED)

    header, *lines = CSV.splitlines()
    offsets = ("x_offset_mm", 66, 20, 66)
    close = [f"{line},{offset}" for line, offset in zip([header, *lines], offsets, strict=True)]
    write("close.csv", "\n".join(close) + "\n")
    write("odd-theta.json", '{"theta": {"cohesion": 0.05}, "remaining_discrepancy": {"shift": -1}}')
    write("misspelt-theta.yaml", "theta: {cohesoin: 0.05}\n")
    write("wild-theta.json", '{"theta": {"cohesion": 50}}')
    write("list-theta.json", "[1, 2]")


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
    "calibrate nothing-csv.yaml": "nothing.csv: is empty; it needs a header and a line for each pour",
    "simulate small.yaml --from number.csv": "number.csv:3:9: poured_g: '9x5' is not a number",
    "simulate small.yaml --from gone.csv": "gone.csv: no such file",
    "simulate small.yaml --from pours.csv --scene narrow": "pours.csv:2:1: makes no action of scene 'deployment-n",
    "simulate small.yaml --from close.csv": "close.csv:3:1: cups touch: at tilt ",
    "simulate small.yaml --from pours.csv --set x_offset=70": "--set: the table given with --from says what is poured",
    "simulate small.yaml --from pours.csv --rrd pour.rrd": "--rrd pour.rrd: records one pour; it does not go with",
    "simulate small.yaml --from pours.csv --thetas 3": "--thetas 3: goes with --parameters, the theta.json of a",
    f"{SIMULATE} --csv out.csv": "--csv out.csv: goes with --from, a table of weighed pours",
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


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("inputs")
    write_inputs(folder)
    return folder


@pytest.fixture
def folder(inputs: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The working directory, in which nothing can be started."""
    from actors import laboratory
    from sim_engine.pour import PourSimulator

    def started(*args: object, **kwargs: object) -> NoReturn:
        raise AssertionError("something was started")

    monkeypatch.setattr(laboratory, "open_laboratory", started)
    monkeypatch.setattr(PourSimulator, "simulate", started)
    monkeypatch.chdir(inputs)
    return inputs


def invoke(command: str) -> Any:
    return CliRunner().invoke(app, shlex.split(command), env={"COLUMNS": "120"})


def refused(command: str, folder: Path) -> str:
    """What a command says that refuses its input and leaves everything as it was."""
    before = sorted(folder.rglob("*"))
    result = invoke(command)
    assert isinstance(result.exception, SystemExit), result.exception
    assert result.exit_code == 2, result.stderr
    assert result.stdout == ""
    assert "Traceback" not in result.stderr
    assert sorted(folder.rglob("*")) == before
    return str(result.stderr)


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


def test_all_that_is_wrong_with_several_files_is_told_at_once(folder: Path) -> None:
    result = invoke("validate misspelt.yaml small.yaml open-cup.yaml beaker.yaml")
    assert result.exit_code == 2
    assert result.stdout.splitlines() == [
        "small.yaml: ok (campaign, seed 3)",
        "beaker.yaml: ok (vessel, holds 197.9 mL to the brim)",
    ]
    assert "misspelt.yaml:29:3" in result.stderr
    assert "open-cup.yaml: open.stl: not watertight" in result.stderr
    assert result.stderr.splitlines()[-1] == "2 of 4 file(s) can't be used"


def test_files_that_are_right_pass(folder: Path) -> None:
    write_recorded = folder / "recorded.yaml"
    write_recorded.write_text(RECORDED, encoding="utf-8")
    result = invoke("validate small.yaml recorded.yaml plan-only.yaml")
    write_recorded.unlink()
    assert (result.exit_code, result.stderr) == (0, "")


# -- in a process of its own -------------------------------------------------------------------------------------------

PROGRAM = """
import sys
from orchestrator.cli import main
try:
    main()
finally:
    heavy = {"ray", "taichi", "rerun", "matplotlib", "sklearn"} & set(sys.modules)
    print("loaded:", *sorted(heavy), file=sys.stderr)
"""


def process(command: str, folder: Path, program: str = PROGRAM) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-c", program, *shlex.split(command)],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        timeout=PATIENCE,
    )


@pytest.mark.parametrize(
    "command",
    [
        "run misspelt.yaml",
        "run open-mesh.yaml",
        "plan small.yaml --receiver small.yaml",
        "simulate small.yaml --set angular_velocity=100 --set x_offset=10",
    ],
)
def test_refusing_is_quick_and_wakes_nothing_heavy(command: str, inputs: Path) -> None:
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    done = process(command, inputs)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    assert done.returncode == 2
    assert done.stderr.splitlines()[-1] == "loaded:"
    assert after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime < 4.0
    assert not (inputs / "runs").exists()


@pytest.fixture(scope="module")
def simulated(inputs: Path) -> subprocess.CompletedProcess[str]:
    """One pour through the command, shown in every way."""
    return process(f"{SIMULATE} --seed 5 --json --rrd pour.rrd --png pour.png", inputs)


def test_simulate_prints_one_line_of_json_and_nothing_else(simulated: subprocess.CompletedProcess[str]) -> None:
    assert simulated.returncode == 0, simulated.stderr
    (line,) = simulated.stdout.splitlines()
    outcome = json.loads(line)
    fractions = ("received", "spilled", "retained", "in_flight", "escaped")
    assert sum(outcome[name] for name in fractions) == pytest.approx(1.0, abs=1e-9)
    assert all(0.0 <= outcome[name] <= 1.0 for name in fractions)
    assert outcome["received"] > 0.5
    assert (outcome["particles"], outcome["seed"]) == (300, 5)
    # 100 mL shared by 300 particles
    assert outcome["spacing_mm"] == pytest.approx((1e-4 / 998 * 997 / 300) ** (1 / 3) * 1e3, rel=2e-3)
    assert outcome["steps"] > 100
    assert outcome["cpu_s"] > 0.0


def test_simulate_predicts_with_the_spread_of_its_seeds_and_says_what_it_lacks(
    simulated: subprocess.CompletedProcess[str],
) -> None:
    outcome = json.loads(simulated.stdout)
    prediction = outcome["prediction"]
    assert prediction["seeds"] == [5, 6, 7]
    assert prediction["received"]["count"] == 3
    assert prediction["band"]["low"] < prediction["spillage"]["mean"] < prediction["band"]["high"]
    assert prediction["band"]["level"] == 0.9
    assert prediction["received"]["deviation"] > 0.0
    assert abs(prediction["received"]["mean"] - outcome["received"]) < 5 * prediction["received"]["deviation"] + 1e-9
    assert outcome["regimes"]["lip"]["weber"][0] < outcome["regimes"]["lip"]["weber"][1]
    assert outcome["delivered_g"] == pytest.approx(100.0 * outcome["prediction"]["received"]["mean"])
    assert outcome["delivered_ml"] == pytest.approx(outcome["delivered_g"] / 0.998)
    assert outcome["not_covered"] == []
    assert "not simulated" not in simulated.stderr


def test_simulate_tells_people_the_spread_and_what_is_not_simulated(inputs: Path) -> None:
    done = process(
        "simulate small.yaml --set angular_velocity=20 --set max_angle=75 --set x_offset=70 --seeds 2", inputs
    )
    assert done.returncode == 0, done.stderr
    assert re.search(r"received \d+\.\d ± \d+\.\d %", done.stdout)
    assert "mean ± standard deviation, 2 seeds" in done.stdout
    assert re.search(
        r"spilled / poured \d+\.\d ± \d+\.\d %, a pour: \d+\.\d … \d+\.\d %   \(bands of seeds", done.stdout
    )
    assert re.search(r"delivered \d+\.\d g, \d+\.\d mL", done.stdout)
    assert done.stderr.count("not simulated, dribbling: ") == 1  # for both seeds


def test_a_table_of_weighed_pours_is_predicted_and_scored(inputs: Path) -> None:
    theta = {"cohesion": 0.05}
    draws = [{"theta": {"cohesion": 0.02 * i}, "weight": 1.0} for i in range(4)]
    (inputs / "theta.json").write_text(
        json.dumps({"theta": theta, "remaining_discrepancy": {"shift": 0.2}, "posterior": draws}), encoding="utf-8"
    )
    done = process(
        "simulate small.yaml --from pours.csv --parameters theta.json --seeds 2 --csv scored.csv --png scored.png "
        "--json",
        inputs,
    )
    (inputs / "theta.json").unlink()
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert found["scene"] == "calibration"
    assert [pour["measured"] for pour in found["pours"]] == pytest.approx([4 / 90, 8 / 95, 0.09])
    assert [pour["line"] for pour in found["pours"]] == [2, 3, 4]
    assert {split: one["pours"] for split, one in found["scores"].items()} == {"train": 2, "test": 1, "all": 3}
    errors = [abs(pour["measured"] - pour["predicted"]["mean"]) for pour in found["pours"]]
    assert found["scores"]["all"]["mean_error"] == pytest.approx(sum(errors) / 3)
    assert found["scores"]["all"]["held"] == sum(pour["inside"] for pour in found["pours"])
    assert (found["simulations"], found["thetas"]) == (6, 2)
    assert found["bands"]["discrepancy_shift"] == 0.2
    for pour in found["pours"]:
        assert pour["band"]["low"] <= pour["predicted"]["mean"] <= pour["band"]["high"]
    assert len((inputs / "scored.csv").read_text(encoding="utf-8").splitlines()) == 4
    assert (inputs / "scored.png").read_bytes().startswith(b"\x89PNG")
    assert "3 pours, 2 simulations each, bands of seeds, 2 θ of the posterior" in done.stderr


def test_one_seed_has_no_spread_and_says_so() -> None:
    several = [watched.outcome(spilled=s) for s in (0.05, 0.07)]
    assert "received 92.0 ± 1.4 %  spilled 6.0 ± 1.4 %" in single.told(several, spreads(several))
    alone = single.told(several[:1], spreads(several[:1]))
    assert "±" not in alone
    assert "1 seed, so no spread; --seeds 5 would tell it" in alone


def test_simulate_shows_the_pour_as_picture_and_recording(
    simulated: subprocess.CompletedProcess[str], inputs: Path
) -> None:
    assert (inputs / "pour.png").read_bytes().startswith(b"\x89PNG")
    assert (inputs / "pour.rrd").read_bytes().startswith(b"RRF")
    assert "pour.png" in simulated.stderr
    assert "pour.rrd" in simulated.stderr


def test_simulate_takes_units_parameters_and_another_receiver(
    simulated: subprocess.CompletedProcess[str], inputs: Path
) -> None:
    (inputs / "theta.json").write_text('{"theta": {"particles": 350}}', encoding="utf-8")
    command = (
        "simulate small.yaml --set 'angular_velocity=1.5 rad/s' --set 'x_offset=8 cm' "
        "--parameters theta.json --receiver tumbler.yaml --json"
    )
    done = process(command, inputs)
    (inputs / "theta.json").unlink()
    assert done.returncode == 0, done.stderr
    outcome = json.loads(done.stdout)
    assert outcome["particles"] == 350
    assert (outcome["action"]["angular_velocity"], outcome["action"]["x_offset"]) == pytest.approx((1.5, 0.08))
    assert outcome["scene"] == "beaker into tumbler"


def test_a_full_disk_ends_a_run_with_its_name_and_advises_no_resuming_of_what_had_not_begun(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from actors import laboratory

    def full(*args: object, **kwargs: object) -> NoReturn:
        raise OSError(errno.ENOSPC, "No space left on device", "campaign.rrd")

    write_inputs(tmp_path)
    monkeypatch.setattr(laboratory, "open_laboratory", full)
    monkeypatch.chdir(tmp_path)
    result = invoke("run small.yaml")
    assert isinstance(result.exception, SystemExit), result.exception
    assert result.exit_code == 1
    assert "MB are free there. A run needs" in result.stderr
    assert "nothing had begun" in result.stderr
    assert "--resume" not in result.stderr


# -- help --------------------------------------------------------------------------------------------------------------

HELP = {
    "": ["decant run configs/campaigns/quickstart.yaml", "2 bad input", "130 interrupted"],
    "run": ["decant run my.yaml --resume", "Ctrl-C pauses", "runs/ID"],
    "calibrate": ["decant calibrate configs/campaigns/recorded.yaml --json", "theta.json", "N/m"],
    "plan": ["--receiver vase.yaml", "deg/s, mm and s", "Nothing is poured"],
    "simulate": [
        "--set x_offset=90   # deg/s and mm",
        "'angular_velocity=0.7 rad/s'",
        "in_flight",
        "--seeds",
        "--from pours.csv",
    ],
    "validate": ["decant validate configs/campaigns/*.yaml", "units, bounds"],
    "schema": ["decant schema result > result.json"],
}


@pytest.mark.parametrize("verb", HELP, ids=lambda verb: verb or "decant")
def test_help_teaches_units_and_shows_examples(verb: str) -> None:
    result = invoke(f"{verb} --help")
    assert result.exit_code == 0
    for words in HELP[verb]:
        assert words in result.stdout


def test_a_campaign_runs_on_another_laboratory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from orchestrator.config.load import load_campaign

    twin = ROOT / "configs" / "laboratories" / "twin.yaml"
    plan = load_campaign(ROOT / "configs" / "campaigns" / "quickstart.yaml", twin)
    assert plan.laboratory.arm is None
    assert plan.laboratory.bench is not None
    campaign = str(ROOT / "configs" / "campaigns" / "quickstart.yaml")
    refused = CliRunner().invoke(app, ["run", campaign, "--laboratory", str(tmp_path / "none.yaml")])
    assert refused.exit_code == 2
    assert "none.yaml" in refused.stderr
    # What the bench is reached with is missed before anything starts.
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    monkeypatch.chdir(tmp_path)
    refused = CliRunner().invoke(app, ["run", campaign])
    assert refused.exit_code == 2
    assert "ur-rtde" in refused.stderr
    assert "twin.yaml" in refused.stderr


def test_help_of_answer_names_all_that_may_be_answered() -> None:
    (option,) = get_args(Answer)[1:]
    for answer in (LOST, REPEAT, "weighed", *OPTIONS):
        assert f"'{answer}" in option.help
