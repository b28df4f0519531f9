"""`file_loading`: campaign files mean what they say, and say where they are wrong."""

from __future__ import annotations

import dataclasses
import json
import re
import shutil
import textwrap
from pathlib import Path

import pytest

from actors.interfaces import RaySettings
from orchestrator.campaigns.file_loading import campaign_from, load_campaign, load_laboratory, load_vessel
from orchestrator.campaigns.fingerprint import fingerprint
from orchestrator.campaigns.yaml.yaml_errors import ConfigError
from orchestrator.campaigns.yaml.yaml_source import Document
from orchestrator.cli.command_options import call
from orchestrator.daemon.state.daemon_settings import load_settings
from orchestrator.learning.calibration.continuous_calibration import C4Settings
from orchestrator.learning.campaign_plan import DeploymentSettings
from orchestrator.learning.deployment.d1 import D1Settings
from orchestrator.learning.deployment.d2 import D2Settings
from orchestrator.learning.deployment.d3 import D3Settings
from orchestrator.records.run_registry import state_directory
from orchestrator.runs.run_folder import create_run
from orchestrator.runs.run_tasks import plan_task, run_task
from orchestrator.study.study_file import load_study
from sim_engine.action import DEG
from tests.support import small_campaign
from tests.support.campaign_files import CAMPAIGN, report, write, write_good

CONFIGS = Path(__file__).parents[3] / "configs"


def test_all_errors_of_a_file_and_of_what_it_names_come_at_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "vessels").mkdir()
    (tmp_path / "vessels/cup.yaml").write_text(
        "name: cup\nprofile:\n  unit: mm\n  inner: [[0, 0], [40, 0], [40, 100]]\n  wall: 4\n  flor: 4 mm\n"
    )
    (tmp_path / "campaign.yaml").write_text(
        textwrap.dedent("""\
        name: test
        name: twice
        laboratory: {name: desk}
        liquid: {mass: 200 g}
        pourer: vessels/cup.yaml
        receiver: vessels/cup.yaml
        seed: -1
        motion: {height: 90 mm, x_offset: 80}
        calibration:
          actions: {angular_velocity: [120 deg/s, 15 deg/s]}
          pours: {count: 8}
          simulatons: 20
        deployment:
          strategy: D3
          actions: {angular_velocity: [15 deg/s, 120 deg/s]}
          pours: 15
        """)
    )
    with pytest.raises(ConfigError) as caught:
        load_campaign(Path("campaign.yaml"))
    where = [(p.path.name, p.line, p.column, p.where) for p in caught.value.problems]
    assert where == [
        ("campaign.yaml", 2, 1, "name"),
        ("campaign.yaml", 7, 7, "seed"),
        ("campaign.yaml", 8, 35, "motion.x_offset"),
        ("campaign.yaml", 9, 1, "calibration"),  # max_angle has no value
        ("campaign.yaml", 9, 1, "calibration"),  # nothing to search
        ("campaign.yaml", 10, 31, "calibration.actions.angular_velocity"),
        ("campaign.yaml", 11, 18, "calibration.pours.count"),
        ("campaign.yaml", 12, 3, "calibration.simulatons"),
        ("campaign.yaml", 13, 1, "deployment"),  # max_angle has no value
        ("campaign.yaml", 16, 10, "deployment.pours"),
        ("cup.yaml", 5, 9, "profile.wall"),
        ("cup.yaml", 6, 3, "profile.flor"),
    ]


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("glycerin 80 %", "'glycerin 80 %' is not in the table of liquids. Did you mean 'glycerol 80 %'?"),
        (
            "isopropanol 70 %",
            "'isopropanol 70 %' is not in the table of liquids. Did you mean 'isopropanol'? The table has",
        ),
        ("ethanoll", "'ethanoll' is not in the table of liquids. Did you mean 'ethanol'?"),
        ("honey 80 %", "'honey 80 %' is not in the table of liquids. The table has 'water', "),
        ("honey", "'honey' is not in the table of liquids. The table has 'water', "),
        ("olive oil", "'olive oil' is not in the table of liquids. The table has 'water', "),
    ],
)
def test_a_liquid_that_is_not_in_the_table_is_not_poured_as_water(name: str, message: str, tmp_path: Path) -> None:
    text = (CONFIGS / "campaigns" / "quickstart.yaml").read_text(encoding="utf-8").replace("../", f"{CONFIGS}/")
    path = tmp_path / "campaign.yaml"
    path.write_text(text.replace("name: water", f"name: {name}"), encoding="utf-8")
    with pytest.raises(ConfigError) as caught:
        load_campaign(path)
    (problem,) = caught.value.problems
    assert message in problem.message
    assert "give its 'density' and 'viscosity'" in problem.message
    line = text.splitlines()[problem.line - 1]
    assert (problem.path, line[problem.column - 1 :].startswith("water")) == (path, True)

    path.write_text(text.replace("name: water", f"name: {name}, viscosity: 50 mPa*s"), encoding="utf-8")
    with pytest.raises(ConfigError, match="give its 'density' as well"):
        load_campaign(path)
    given = f"name: {name}, viscosity: 50 mPa*s, density: 1.4 g/cm^3"
    path.write_text(text.replace("name: water", given), encoding="utf-8")
    calibration = load_campaign(path).calibration
    assert calibration is not None
    liquid = calibration.scene.liquid
    assert (liquid.name, liquid.density, liquid.dynamic_viscosity) == (name, pytest.approx(1400.0), 0.05)


def test_a_temperature_next_to_a_liquid_that_is_not_in_the_table_is_refused(tmp_path: Path) -> None:
    text = (CONFIGS / "campaigns" / "quickstart.yaml").read_text(encoding="utf-8").replace("../", f"{CONFIGS}/")
    path = tmp_path / "campaign.yaml"
    given = "name: honey, viscosity: 9 Pa*s, density: 1.4 g/cm^3, temperature: 30 degC"
    path.write_text(text.replace("name: water", given), encoding="utf-8")
    with pytest.raises(ConfigError, match=r"liquid\.temperature: has no effect: 'honey' is not in the table"):
        load_campaign(path)


def test_a_run_may_be_resumed_after_the_liquid_s_tension_was_corrected_but_not_after_its_density_was(
    tmp_path: Path,
) -> None:
    """Of a liquid as thin as water tension and viscosity decide which warnings are given, and no request."""
    text = (CONFIGS / "campaigns" / "quickstart.yaml").read_text(encoding="utf-8").replace("../", f"{CONFIGS}/")

    def printed(addition: str) -> object:
        path = tmp_path / "campaign.yaml"
        path.write_text(text.replace("mass: 200 g", f"mass: 200 g{addition}"), encoding="utf-8")
        return fingerprint(load_campaign(path))

    assert printed("") == printed(", surface_tension: 40 mN/m, viscosity: 2 mPa*s")
    assert printed("") != printed(", density: 900 kg/m^3")
    thick = ", viscosity: 50 mPa*s"
    assert printed(thick) != printed(thick + ", surface_tension: 40 mN/m")
    assert printed(thick) != printed(", viscosity: 60 mPa*s")


def test_a_tilde_in_a_path_is_the_home_directory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    home = tmp_path / "home"
    shutil.copytree(CONFIGS, home / "configs")
    monkeypatch.setenv("HOME", str(home))
    monkeypatch.chdir(tmp_path)
    text = (CONFIGS / "campaigns" / "quickstart.yaml").read_text(encoding="utf-8").replace("../../runs", "~/runs")
    (tmp_path / "campaign.yaml").write_text(text.replace("../", "~/configs/"), encoding="utf-8")
    plan = load_campaign(Path("campaign.yaml"))
    assert plan.outputs.folder == home / "runs"
    assert plan.laboratory_source == home / "configs" / "laboratories" / "virtual.yaml"
    create_run(plan)
    assert [path.name for path in tmp_path.iterdir() if path.name.startswith("~")] == []
    assert len(list((home / "runs").iterdir())) == 1

    data = json.dumps(
        {"name": "s", "campaign": "~/configs/campaigns/quickstart.yaml", "directory": "~/studies"} | STUDY
    )
    (tmp_path / "study.yaml").write_text(data, encoding="utf-8")
    assert load_study(Path("study.yaml")).folder == home / "studies" / "study-s"

    (tmp_path / "decant.yaml").write_text("state: ~/state\nroots: [~/configs]\n", encoding="utf-8")
    settings = load_settings(Path("decant.yaml"))
    assert (settings.state, settings.roots) == (home / "state", (home / "configs",))
    monkeypatch.setenv("DECANT_STATE", "~/named")
    assert state_directory() == home / "named"


def test_a_tilde_in_an_option_is_the_home_directory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A shell leaves the one of `--laboratory=~/lab.yaml` as it is."""
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    taken: list[object] = []
    call(lambda *args, **kwargs: taken.extend([args, kwargs]), Path("~/a"), [Path("~/b"), 3], state=Path("c/~"))
    assert taken == [(tmp_path / "home/a", [tmp_path / "home/b", 3]), {"state": Path("c/~")}]


STUDY = {
    "laboratory": str(CONFIGS / "laboratories" / "twin.yaml"),
    "pours": 6,
    "holdout": 2,
    "calibration": {"C4": {"repetitions": 1, "simulations": 12}},
}


def test_error_shows_the_line_and_a_caret_under_the_culprit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "v.yaml").write_text("name: cup\nmesh: cup.stl\nunit: furlong\n")
    with pytest.raises(ConfigError) as caught:
        load_vessel(Path("v.yaml"))
    assert "v.yaml:3:7: unit: 'furlong' is not known here" in str(caught.value)
    assert "\n    3 | unit: furlong\n      |       ^" in str(caught.value)


@pytest.mark.parametrize("address", ["auto", "ray://head:10001", "head", "head:0", "head:70000", ":6379", "a b:6379"])
def test_an_address_of_a_cluster_that_ray_would_puzzle_over_is_refused(address: str, tmp_path: Path) -> None:
    path = tmp_path / "lab.yaml"
    path.write_text(f"name: far\nmode: virtual\nray: {{address: '{address}'}}\n")
    with pytest.raises(ConfigError, match=r"lab\.yaml:3:16: ray\.address: .* should be host:port of the cluster's"):
        load_laboratory(path)


def test_a_cluster_needs_an_address_and_its_bench_has_a_usual_name(tmp_path: Path) -> None:
    path = tmp_path / "lab.yaml"
    path.write_text("name: far\nmode: virtual\nray: {address: '[fd00::1]:6379'}\n")
    assert load_laboratory(path).ray == RaySettings(address="[fd00::1]:6379", bench_resource="decant_bench")
    path.write_text("name: far\nmode: virtual\nray: {bench_resource: left}\n")
    with pytest.raises(ConfigError, match="key 'address' is missing"):
        load_laboratory(path)


def test_every_setting_reaches_the_plan_and_survives_its_resolved_form(tmp_path: Path) -> None:
    vessels = CONFIGS / "vessels"
    text = textwrap.dedent(f"""\
        name: everything
        seed: 41
        laboratory:
          name: odd
          simulators: 3
          in_process: true
          ray: {{address: "head.local:6379", bench_resource: left_bench}}
          bench:
            liquid: {{particles: 3100, cohesion: 31 mN/m, xsph_rate: 7 Hz, friction: 0.31}}
            pose_error: {{x: 1.1 mm, y: -2 mm, z: 0.7 mm, tilt: 0.7 deg, speed_factor: 1.03}}
            pose_noise: {{x: 0.3 mm, y: 0.4 mm, tilt: 0.2 deg, speed_factor: 0.02}}
            balance: {{resolution: 0.01 g, noise: 0.2 g, drift: 0.5 g/min, settling_time: 2.5 s}}
            time_scale: 12
            operator_time: 1 min
        liquid: {{name: oil, mass: 0.15 kg, density: 0.92 g/cm^3, surface_tension: 32 mN/m, viscosity: 84 cP}}
        pourer: {vessels}/beaker.yaml
        motion:
          pivot: {{x: 30 mm, z: 70 mm}}
          angular_acceleration: 300 deg/s^2
          hold_time: 0.7 s
          max_hold_time: 2 s
          return_velocity: 45 deg/s
          y_offset: 3 mm
          height: 55 mm
        simulator:
          parameters: {{particles: {{range: [700, 900], scale: log}}, cohesion: 0.04 N/m, xsph_rate: [1 1/s, 9 1/s]}}
        calibration:
          receiver: {vessels}/tumbler.yaml
          motion: {{x_offset: 97 mm}}
          actions: {{angular_velocity: {{range: [20 deg/s, 90 deg/s], scale: log}}, max_angle: [80 deg, 110 deg]}}
          pours: {{count: 9, holdout: 3}}
          simulations: 33
          initial_samples: 5
          kappa: 1.5
          averaging: noise
          random_baseline: 4
        deployment:
          strategy: D3
          receivers: [{vessels}/narrow.yaml, {vessels}/mug.yaml]
          motion: {{max_angle: 115 deg, return_velocity: 30 deg/s}}
          actions: {{angular_velocity: [20 deg/s, 90 deg/s], x_offset: [90 mm, 130 mm]}}
          loss: {{name: spilled_and_retained, retained_weight: 0.5}}
          pours: 6
          prior_simulations: 11
          simulations_per_pour: 3
          kappa: 3
          initial_samples: 4
        on_unknown: repeat
        parallel_simulations: 5
        outputs: {{directory: here, recording: false, figures: false, pour_recordings: true}}
        """)
    (tmp_path / "all.yaml").write_text(text)
    plan = load_campaign(tmp_path / "all.yaml")
    calibration, deployment, bench = plan.calibration, plan.deployment, plan.laboratory.bench
    assert calibration is not None
    assert deployment is not None
    assert bench is not None
    assert (plan.name, plan.seed, plan.parallel_simulations, plan.on_unknown) == ("everything", 41, 5, "repeat")
    assert tuple(plan.outputs.model_dump().values()) == (str(tmp_path / "here"), False, False, True)
    lab = plan.laboratory
    assert (lab.name, lab.simulators, lab.in_process) == ("odd", 3, True)
    assert lab.ray == RaySettings(address="head.local:6379", bench_resource="left_bench")
    assert (bench.theta.particles, bench.liquid.xsph_rate, bench.liquid.friction) == (3100, 7.0, 0.31)
    assert dataclasses.astuple(bench.pose_error.error) == pytest.approx((0.0011, -0.002, 0.7 * DEG, 1.03, 0.0007))
    assert dataclasses.astuple(bench.pose_noise.deviations) == pytest.approx((0.0003, 0.0004, 0.2 * DEG, 0.02, 0.0))
    assert (bench.time_scale, bench.operator_time, bench.balance.settling_time) == pytest.approx((12.0, 60.0, 2.5))
    assert (bench.balance.resolution, bench.balance.noise) == pytest.approx((1e-5, 2e-4))
    assert bench.balance.drift == pytest.approx(0.5e-3 / 60.0)
    scene = calibration.scene
    assert (scene.liquid.name, scene.liquid.mass, scene.liquid.density) == ("oil", 0.15, pytest.approx(920.0))
    assert (scene.liquid.surface_tension, scene.liquid.dynamic_viscosity) == pytest.approx((0.032, 0.084))
    assert (scene.pivot.kind, scene.pivot.x, scene.pivot.z, scene.max_hold_time) == ("point", 0.03, 0.07, 2.0)
    assert scene.fixed == pytest.approx(
        {
            "angular_acceleration": 300 * DEG,
            "hold_time": 0.7,
            "return_velocity": 45 * DEG,
            "y_offset": 0.003,
            "height": 0.055,
            "x_offset": 0.097,
        }
    )
    assert [(a.name, a.lower, a.upper, a.scale, a.integer) for a in calibration.parameters.axes] == [
        ("particles", 700.0, 900.0, "log", True),
        ("xsph_rate", 1.0, 9.0, "linear", False),
    ]
    assert calibration.fixed_parameters["cohesion"] == pytest.approx(0.04)
    assert plan.parameters.particles == 900, "the default, as far as the range allows"
    assert [(a.name, a.scale) for a in calibration.actions.axes] == [
        ("angular_velocity", "log"),
        ("max_angle", "linear"),
    ]
    assert (calibration.pour_count, calibration.holdout, calibration.random_baseline) == (9, 3, 4)
    assert calibration.settings == C4Settings(simulations=33, initial_samples=5, kappa=1.5, averaging="noise")
    assert [s.receiver.name for s in deployment.scenes] == ["narrow", "mug"]
    assert deployment.scenes[0].fixed["return_velocity"] == pytest.approx(30 * DEG)
    assert (deployment.loss.name, deployment.loss.retained_weight) == ("spilled_and_retained", 0.5)
    assert deployment.settings == D3Settings(
        pours=6,
        prior_simulations=11,
        simulations_per_pour=3,
        kappa=3.0,
        initial_samples=4,
    )
    (tmp_path / "again.json").write_text(json.dumps(plan.resolved))
    again = load_campaign(tmp_path / "again.json")
    assert dataclasses.replace(again, source=plan.source) == plan


@pytest.mark.parametrize(
    ("keys", "expected"),
    [
        ("strategy: D1", D1Settings()),
        (
            "strategy: D1\n  pours: 0\n  iterations: 7\n  simulations_per_iteration: 3",
            D1Settings(pours=0, iterations=7, simulations_per_iteration=3),
        ),
        ("strategy: D2\n  pours: 9\n  mean: zero", D2Settings(pours=9, mean="zero")),
        ("strategy: D3\n  pours: 9\n  simulations_per_pour: 0", D3Settings(pours=9, simulations_per_pour=0)),
        (
            "strategy: D3\n  pours: 9",
            D3Settings(pours=9, simulations_per_pour=2, prior_simulations=37, model="adaptive"),
        ),
        ("strategy: D3\n  pours: 9\n  model: residual", D3Settings(pours=9, model="residual")),
    ],
)
def test_strategies_have_their_own_budgets(keys: str, expected: DeploymentSettings, tmp_path: Path) -> None:
    text = (CONFIGS / "campaigns" / "quickstart.yaml").read_text(encoding="utf-8").replace("../", f"{CONFIGS}/")
    head, tail = re.split(r"  prior_simulations: \d+\n", text)
    tail = tail[tail.index("on_unknown") :]
    (tmp_path / "campaign.yaml").write_text(head.replace("strategy: D3", keys) + tail)
    plan = load_campaign(tmp_path / "campaign.yaml").deployment
    assert plan is not None
    assert plan.settings == expected


def test_section_overrides_the_motion_of_the_campaign(tmp_path: Path) -> None:
    text = (CONFIGS / "campaigns" / "quickstart.yaml").read_text(encoding="utf-8").replace("../", f"{CONFIGS}/")
    path = tmp_path / "campaign.yaml"
    path.write_text(text.replace("120 deg, height: 110 mm}", "120 deg, height: 110 mm, hold_time: 2 s}"))
    plan = load_campaign(path)
    assert plan.calibration is not None
    assert plan.deployment is not None
    assert plan.calibration.scene.fixed["hold_time"] is None
    assert plan.deployment.scenes[0].fixed["hold_time"] == pytest.approx(2.0)


def test_unusual_files_are_errors_and_no_tracebacks(tmp_path: Path) -> None:
    bomb = "a: &a [1, 1, 1, 1, 1, 1, 1, 1, 1, 1]\n" + "".join(
        f"{c}: &{c} [{', '.join([f'*{p}'] * 10)}]\n" for p, c in zip("abcdef", "bcdefg", strict=True)
    )
    for content in (
        b"\xff\xfe\x00",
        bomb.encode(),
        b"a: &x {b: *x}",
        b"? [a, b]\n: c",
        b"name: !!python/none x",
        b"<<: {a: 1}",
    ):
        (tmp_path / "odd.yaml").write_bytes(content)
        with pytest.raises(ConfigError, match=r"odd\.yaml"):
            load_campaign(tmp_path / "odd.yaml")
    with pytest.raises(ConfigError, match="no such file"):
        load_campaign(tmp_path / "absent.yaml")
    with pytest.raises(ConfigError, match="is a directory"):
        load_campaign(tmp_path)


@pytest.mark.parametrize(
    ("simulator", "actions", "mirrored"),
    [
        ("parameters: {particles: 10000, cohesion: [0 N/m, 0.1 N/m]}", "", True),
        ("parameters: {particles: [2000, 20000]}", "", True),
        ("parameters: {particles: 10000, cohesion: [0 N/m, 0.1 N/m]}\n  symmetry: off", "", None),
        ("parameters: {particles: 1999, cohesion: [0 N/m, 0.1 N/m]}", "", None),
        ("parameters: {particles: [1000, 20000]}", "", None),  # no comparison mixes halves and whole pours
        ("parameters: {particles: 10000, receiver_y: [-5 mm, 5 mm]}", "", None),
        ("parameters: {particles: 10000, cohesion: [0 N/m, 0.1 N/m]}", ", y_offset: [-5 mm, 5 mm]", None),
    ],
)
def test_pours_of_a_campaign_are_simulated_by_half_if_none_is_sideways(
    tmp_path: Path, simulator: str, actions: str, mirrored: bool | None
) -> None:
    text = CAMPAIGN.replace("parameters:\n    cohesion: [0 N/m, 0.1 N/m]", simulator)
    text = text.replace("120 deg/s]}", f"120 deg/s]{actions}}}")
    plan = load_campaign(write(write_good(tmp_path), "campaign.yaml", text))
    assert plan.calibration is not None
    assert plan.calibration.scene.mirrored is mirrored
    assert ("mirrored" in fingerprint(plan)["calibration"]["scene"]) == bool(mirrored)


def test_symmetry_can_not_be_forced(tmp_path: Path) -> None:
    bad = CAMPAIGN.replace("simulator:\n", "simulator:\n  symmetry: on\n")
    assert "campaign.yaml:8:13: simulator.symmetry: 'on' is not known here; should be 'auto' or 'off'" in report(
        write(write_good(tmp_path), "campaign.yaml", bad)
    )


def test_a_run_and_a_planning_go_where_the_campaign_says_else_into_the_working_directory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "campaign").mkdir()
    (tmp_path / "work").mkdir()
    monkeypatch.chdir(tmp_path / "work")
    named = load_campaign(small_campaign.write_campaign(tmp_path / "campaign"))
    text = small_campaign.CAMPAIGN.replace("outputs: {directory: runs}\n", "")
    unnamed = load_campaign(small_campaign.write_campaign(tmp_path / "campaign", text))
    for plan, folder in ((named, "campaign"), (unnamed, "work")):
        for request in (run_task(plan), plan_task(plan)):
            assert request.campaign.outputs.folder == tmp_path / folder / "runs"


def test_values_of_a_program_are_the_campaign_of_the_same_text_and_problems_name_their_keys(tmp_path: Path) -> None:
    plan = load_campaign(write(write_good(tmp_path), "campaign.yaml", CAMPAIGN))
    values, path = json.loads(json.dumps(plan.resolved)), tmp_path / "order.json"
    assert campaign_from(Document.of(values, path)) == campaign_from(Document.parse(json.dumps(values), path))
    values["calibration"]["pours"]["holdout"] = 1000  # a rule between keys of an inner section
    with pytest.raises(ConfigError) as caught:
        campaign_from(Document.of(values, path))
    (problem,) = caught.value.problems
    assert (problem.where, problem.line) == ("calibration.pours.holdout", 0)
