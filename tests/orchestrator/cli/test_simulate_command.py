"""`simulate_command`: `decant simulate`: what it prints, writes, and says about what it does not know."""

from __future__ import annotations

import contextlib
import json
import re
import subprocess
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest

from orchestrator.cli import simulate_command
from orchestrator.cli.console import RefusalError
from orchestrator.cli.simulate_command import told
from sim_engine.prediction_band import spreads
from tests.support import example_run
from tests.support.cli_inputs import SIMULATE, invoke, process

CONFIGS = Path(__file__).parents[3] / "configs"


@pytest.fixture(scope="module")
def simulated(inputs: Path) -> subprocess.CompletedProcess[str]:
    """One pour through the command, shown in every way."""
    return process(f"{SIMULATE} --seed 5 --json --rrd pour.rrd --png pour.png", inputs)


def typed(command: str, folder: Path) -> Any:
    """In this process, which starts the simulator once."""
    with contextlib.chdir(folder):
        done = invoke(command)
    assert done.exit_code == 0, done.stderr
    return done


@pytest.mark.slow
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


@pytest.mark.slow
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


def test_an_action_that_the_laboratorys_arm_can_not_make_is_a_warning(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(simulate_command, "_simulated_pour", Mock(side_effect=RefusalError("not simulated here")))
    shipped = (CONFIGS / "campaigns" / "quickstart.yaml").read_text(encoding="utf-8")
    fast = shipped.replace("150 deg/s]", "200 deg/s]").replace(": ../", f": {CONFIGS}/")
    (tmp_path / "fast.yaml").write_text(fast, encoding="utf-8")
    for speed, warned in ((150, False), (155, True)):
        with contextlib.chdir(tmp_path):
            done = invoke(f"simulate fast.yaml --set angular_velocity={speed} --set x_offset=100")
        said = "can't make this pour: joint 6 (wrist 3) would turn at 155.1 deg/s" in done.stderr
        assert said == warned, done.stderr


@pytest.mark.slow
def test_simulate_tells_people_the_spread_and_what_is_not_simulated(inputs: Path) -> None:
    done = typed("simulate small.yaml --set angular_velocity=20 --set max_angle=75 --set x_offset=70 --seeds 2", inputs)
    assert re.search(r"received \d+\.\d ± \d+\.\d %", done.stdout)
    assert "mean ± standard deviation, 2 seeds" in done.stdout
    assert re.search(
        r"spilled / poured \d+\.\d ± \d+\.\d %, a pour: \d+\.\d … \d+\.\d %   \(uncalibrated: intervals from seeds",
        done.stdout,
    )
    assert re.search(r"delivered \d+\.\d g, \d+\.\d mL", done.stdout)
    assert done.stderr.count("not simulated, dribbling: ") == 1  # for both seeds


def test_one_seed_has_no_spread_and_says_so() -> None:
    several = [example_run.outcome(spilled=s) for s in (0.05, 0.07)]
    assert "received 92.0 ± 1.4 %  spilled 6.0 ± 1.4 %" in told(several, spreads(several))
    alone = told(several[:1], spreads(several[:1]))
    assert "±" not in alone
    assert "1 seed, so no spread; --seeds 5 would tell it" in alone


@pytest.mark.slow
def test_simulate_shows_the_pour_as_picture_and_recording(
    simulated: subprocess.CompletedProcess[str], inputs: Path
) -> None:
    assert (inputs / "pour.png").read_bytes().startswith(b"\x89PNG")
    assert (inputs / "pour.rrd").read_bytes().startswith(b"RRF")
    assert "pour.png" in simulated.stderr
    assert "pour.rrd" in simulated.stderr


@pytest.mark.slow
def test_simulate_takes_units_parameters_and_another_receiver(
    simulated: subprocess.CompletedProcess[str], inputs: Path
) -> None:
    (inputs / "theta.json").write_text('{"theta": {"particles": 350}}', encoding="utf-8")
    command = (
        "simulate small.yaml --set 'angular_velocity=1.5 rad/s' --set 'x_offset=8 cm' "
        "--parameters theta.json --receiver tumbler.yaml --json"
    )
    done = typed(command, inputs)
    (inputs / "theta.json").unlink()
    outcome = json.loads(done.stdout)
    assert outcome["particles"] == 350
    assert (outcome["action"]["angular_velocity"], outcome["action"]["x_offset"]) == pytest.approx((1.5, 0.08))
    assert outcome["scene"] == "beaker into tumbler"


@pytest.mark.slow
def test_a_cup_whose_shape_may_be_off_has_a_wider_band(inputs: Path) -> None:
    cup = "name: tumbler\nprofile: {unit: mm, inner: [[0, 0], [32, 0], [32, 100]], wall: 4 mm, floor: 4 mm"
    (inputs / "known.yaml").write_text(cup + "}\n", encoding="utf-8")
    (inputs / "off.yaml").write_text(cup + ", radius_deviations: [[0, 3, 3]]}\n", encoding="utf-8")
    printed = {}
    for name in ("known", "off"):
        done = typed(f"{SIMULATE.replace('70', '120')} --seed 6 --seeds 4 --receiver {name}.yaml", inputs)
        printed[name] = done.stdout
    low, high = ([float(end) for end in _BAND.findall(text)[0]] for text in printed.values())
    assert high[1] - high[0] > low[1] - low[0] + 5.0  # both end at 100 %, uncalibrated as they are
    assert "shapes that the vessels may have" in printed["off"]
    assert "shapes" not in printed["known"]


_BAND = re.compile(r"a pour: (\d+\.\d) … (\d+\.\d) %")
