"""A strategy and an objective from outside: one file each, and everything that knows ours knows them."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from decant.plugins import DeploymentPlan, Fractions, Loss
from decant.plugins.testing import ACTIONS, SCENE, THETA, StrategyHarness, check_strategy
from tests.plugins.decant_example.objective import Gentle
from tests.plugins.decant_example.strategy import Hypercube, HypercubeSettings
from tests.support.toy_spillage import narrow_cup

ROOT = Path(__file__).parents[2]


def plan(pours: int = 9, **changes: Any) -> DeploymentPlan:
    return DeploymentPlan(HypercubeSettings(pours=pours, **changes), (SCENE,), ACTIONS, Loss())


# -- the example itself ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("centred", [False, True])
def test_every_slice_is_poured_from_once(centred: bool) -> None:
    strategy = Hypercube(plan(centred=centred), SCENE, THETA, 3)
    played = StrategyHarness(narrow_cup).run(strategy)
    points = np.array([ACTIONS.encode(pour.action.values()) for pour in played.pours])
    for column in points.T:
        assert sorted(np.floor(9 * column - 1e-9 * column)) == list(range(9))
        assert bool(np.allclose(np.sort(column), (np.arange(9) + 0.5) / 9)) is centred
    assert strategy.finished
    assert strategy.best_values is not None
    assert not played.simulations


def test_it_does_what_every_strategy_has_to_do() -> None:
    check_strategy(lambda: Hypercube(plan(), SCENE, THETA, 3), narrow_cup)


def test_an_objective_of_ones_own_is_rated_with_its_floor() -> None:
    objective = Gentle(floor=0.5)
    slow, fast = (SCENE.action(ACTIONS.decode([u, 0.5])) for u in (0.0, 1.0))
    worst = objective.worst(SCENE, ACTIONS)
    assert worst == pytest.approx(120 / 90)
    costs = [objective.bounded_cost(Fractions(1.0, 0.0, 0.0), action, SCENE, worst) for action in (slow, fast)]
    assert costs == pytest.approx([15 / 90, 120 / 90])
    assert objective.bounded_cost(Fractions(0.0, 0.0, 1.0), slow, SCENE, worst) == pytest.approx(2 * worst)


# -- what knows it -----------------------------------------------------------------------------------------------------

INSPECT = """
import json, sys
from pathlib import Path
sys.path.insert(0, "docs")
import make_tables
from orchestrator.campaigns.file_loading import load_campaign
from orchestrator.cli.json_schema import campaign_schema
from orchestrator.campaigns.yaml.yaml_errors import ConfigError
from orchestrator.campaigns.fingerprint import fingerprint
from orchestrator.runs.stages import stages_of

folder = Path(sys.argv[1])
plan = load_campaign(folder / "good.yaml")
(folder / "record.json").write_text(json.dumps(plan.resolved))
errors = {}
for path in sorted(folder.glob("bad-*.yaml")):
    try:
        load_campaign(path)
    except ConfigError as error:
        errors[path.stem] = str(error)
print(json.dumps({
    "settings": type(plan.deployment.settings).__name__,
    "strategy": type(stages_of(plan)[-1].build({}, 1)).__name__,
    "again": load_campaign(folder / "record.json").deployment == plan.deployment,
    "record": plan.resolved["deployment"],
    "fingerprint": fingerprint(plan)["deployment"]["settings"],
    "schema": json.dumps(campaign_schema()),
    "tables": make_tables.TABLES["deployment-strategies"]() + make_tables.TABLES["objectives"](),
    "errors": errors,
}))
"""

CAMPAIGN = f"""\
name: outside
laboratory: {ROOT}/configs/laboratories/twin.yaml
liquid: {{mass: 200 g}}
pourer: {ROOT}/configs/vessels/beaker.yaml
receiver: {ROOT}/configs/vessels/narrow.yaml
motion: {{max_angle: 120 deg, height: 110 mm}}
deployment:
  strategy: hypercube
  actions: {{angular_velocity: [20 deg/s, 120 deg/s], x_offset: [70 mm, 130 mm]}}
  pours: 5
  centred: true
  objective: {{name: gentle, rough: 60 deg/s}}
"""

BAD = {
    "misspelt": ("centred: true", "centerd: true"),
    "not-its-own": ("centred: true", "prior_simulations: 9"),
    "nobodys": ("strategy: hypercube", "strategy: hyprcube"),
    "not-of-the-objective": ("rough: 60 deg/s", "volume: 150 mL"),
    "without-a-unit": ("rough: 60 deg/s", "rough: 60"),
    "no-pours": ("  pours: 5\n", ""),
}


def register(site: Path) -> None:
    """Have the example's strategy and objective registered for whoever has this folder on its path."""
    metadata = site / "decant_example-1.0.dist-info"
    metadata.mkdir(parents=True)
    (metadata / "METADATA").write_text("Metadata-Version: 2.1\nName: decant-example\nVersion: 1.0\n")
    (metadata / "entry_points.txt").write_text(
        "[decant.strategies]\nhypercube = tests.plugins.decant_example.strategy:HypercubeSettings\n"
        "[decant.objectives]\ngentle = tests.plugins.decant_example.objective:Gentle\n"
    )


@pytest.fixture(scope="module")
def known(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """What a program says of it in an environment where the example is registered."""
    folder, site = tmp_path_factory.mktemp("campaign"), tmp_path_factory.mktemp("site")
    register(site)
    (folder / "good.yaml").write_text(CAMPAIGN)
    for name, (old, new) in BAD.items():
        assert old in CAMPAIGN
        (folder / f"bad-{name}.yaml").write_text(CAMPAIGN.replace(old, new))
    path = os.pathsep.join([str(site), str(ROOT), os.environ.get("PYTHONPATH", "")])
    done = subprocess.run(
        [sys.executable, "-c", INSPECT, str(folder)],
        env={**os.environ, "PYTHONPATH": path},
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=200,
    )
    assert done.returncode == 0, done.stderr
    return dict(json.loads(done.stdout))


@pytest.mark.slow
def test_a_campaign_may_ask_for_it_and_its_record_loads_to_the_same(known: dict[str, Any]) -> None:
    assert (known["settings"], known["strategy"]) == ("HypercubeSettings", "Hypercube")
    assert known["again"] is True
    assert (known["record"]["strategy"], known["record"]["centred"]) == ("hypercube", True)
    assert known["fingerprint"]["centred"] is True


def test_schema_and_tables_have_its_keys_and_their_meanings(known: dict[str, Any]) -> None:
    for meaning in ("Pour at the middles of the slices", "An angular velocity that is as bad as spilling everything"):
        assert meaning in known["schema"]
        assert meaning in known["tables"]
    assert "| hypercube | `centred` | `true` or `false` | `false` |" in known["tables"]
    assert "| gentle | `rough` | 0.572958 … 572.958 deg/s | 90 deg/s |" in known["tables"]


@pytest.mark.parametrize(
    ("case", "message"),
    [
        ("misspelt", ":11:3: deployment.centerd: unknown key; did you mean 'centred'?"),
        ("not-its-own", ":11:3: deployment.prior_simulations: belongs to D3, not to hypercube; remove it"),
        ("nobodys", ":8:13: deployment.strategy: 'hyprcube' is not known here; did you mean 'hypercube'?"),
        ("not-of-the-objective", "objective.volume: belongs to target_volume, not to gentle; remove it"),
        ("without-a-unit", "objective.rough: 60 has no unit; write '60 deg/s' if that is what is meant"),
        ("no-pours", ":7:1: deployment: key 'pours' is missing; hypercube learns on real pours"),
    ],
)
def test_what_is_wrong_is_said_as_of_ours(known: dict[str, Any], case: str, message: str) -> None:
    said = known["errors"][f"bad-{case}"]
    assert message in said
    assert said.count(".yaml:") == 1, "one cause, one message"


# -- a study with it ---------------------------------------------------------------------------------------------------

STUDY = """
import json, sys
from pathlib import Path
from orchestrator.study.study_page import write_report
from tests.support.study_files import read, written
from tests.support.toy_study import run_toy_study
from orchestrator.study.study_file import load_study
from orchestrator.campaigns.yaml.yaml_errors import ConfigError

folder = Path(sys.argv[1])
data = read("quick")
data["calibration"] = {"C4": data["calibration"]["C4"]}
data["mismatch"] = data["mismatch"][:1]
twice = {"repetitions": 2, "pours": 2}
data["deployment"] = {"D2": twice, "hypercube": {**twice, "centred": True}}
study = load_study(written(folder, data))
status = run_toy_study(study)
page = write_report(study, study.folder)
try:
    data["deployment"]["hypercube"]["simulations_per_pour"] = 3
    load_study(written(folder, data))
except ConfigError as error:
    said = str(error)
finished = sorted(status.finished)
print(json.dumps({"failed": status.failed, "finished": finished, "page": page.read_text(), "error": said}))
"""


@pytest.mark.slow
def test_a_study_compares_it_with_ours(tmp_path: Path) -> None:
    site = tmp_path / "site"
    register(site)
    path = os.pathsep.join([str(site), str(ROOT), os.environ.get("PYTHONPATH", "")])
    done = subprocess.run(
        [sys.executable, "-c", STUDY, str(tmp_path / "study")],
        env={**os.environ, "PYTHONPATH": path},
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=200,
    )
    assert done.returncode == 0, done.stderr
    told = json.loads(done.stdout.splitlines()[-1])
    assert told["failed"] == {}
    assert "final.small.hypercube.deployment-narrow.02.01" in told["finished"]
    assert "hypercube − D2" in told["page"]
    assert "simulations_per_pour: belongs to D3, not to hypercube" in told["error"]
