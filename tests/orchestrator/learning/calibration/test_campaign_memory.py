"""`campaign_memory`: a prior from earlier campaigns: how it is combined, how a calibration uses it, and when it
loses its weight.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from decant import load_campaign
from orchestrator.campaigns.campaign_prior import KnownPosterior, arm_of, shape_digest
from orchestrator.campaigns.file_loading import load_posterior_file
from orchestrator.campaigns.fingerprint import fingerprint
from orchestrator.campaigns.shipped import shipped
from orchestrator.campaigns.yaml.yaml_errors import ConfigError
from orchestrator.catalogue.catalogue import Catalogue
from orchestrator.catalogue.known_posteriors import import_posterior, posterior_of, posterior_text
from orchestrator.cli.app import app
from orchestrator.learning.calibration.active_design import ActiveDesign
from orchestrator.learning.calibration.calibration_scores import ScoredPair, Scores
from orchestrator.learning.calibration.campaign_memory import CampaignMemory, RememberedParameter, predicted
from orchestrator.learning.calibration.pour_design import DesignResult, StratifiedDesign, WeighedPoint
from orchestrator.learning.campaign_plan import MeasuredPour
from orchestrator.records.events import StageClosed
from orchestrator.records.run_record import Header, RunState
from orchestrator.records.run_registry import VARIABLE
from orchestrator.runs.run_folder import simulator_version
from orchestrator.runs.stages import with_evidence
from orchestrator.runs.strategy_harness import SCENE, StrategyHarness
from sim_engine.action import DEG
from sim_engine.liquids import SimulationParameters
from sim_engine.search_space import Axis, Space
from tests.support.plans import calibration_plan

SEARCHED = Space((Axis("receiver_x", -0.02, 0.02),))
ACTIONS = Space((Axis("x_offset", 0.09, 0.13),))
SLOW = replace(SCENE, fixed={**SCENE.fixed, "angular_velocity": 60 * DEG})


@pytest.fixture
def state(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A state directory of its own."""
    monkeypatch.setenv(VARIABLE, str(tmp_path / "state"))
    return tmp_path / "state"


# -- the combination ---------------------------------------------------------------------------------------------------


def test_one_earlier_campaign_is_widened_by_the_usual_difference() -> None:
    mean, deviation = predicted([(0.014, 0.001)], 0.0025)
    assert mean == pytest.approx(0.014)
    # the earlier campaign differs from the common mean, and so does the next one
    assert deviation == pytest.approx(float(np.hypot(0.001, 0.0025 * 2**0.5)), rel=0.01)


def test_campaigns_that_agree_narrow_the_prior_and_those_that_differ_widen_it() -> None:
    alike = [(0.0140, 0.001), (0.0141, 0.001), (0.0139, 0.001), (0.0140, 0.001), (0.0140, 0.001)]
    differing = [
        (mean + shift, 0.001) for (mean, _), shift in zip(alike, (-0.006, 0.006, -0.005, 0.005, 0), strict=True)
    ]
    assert predicted(alike, 0.0025)[1] < predicted(alike[:1], 0.0025)[1] < predicted(differing, 0.0025)[1]


def test_the_eight_schools_of_the_textbook_have_its_common_mean() -> None:
    # The eight schools: Gelman et al., Bayesian Data Analysis, table 5.2 (estimates and standard errors); the book's
    # posterior mean of the common effect is 8, and a new school is far less certain than the mean of all.
    schools = [
        (28.0, 15.0),
        (8.0, 10.0),
        (-3.0, 16.0),
        (7.0, 11.0),
        (-1.0, 9.0),
        (1.0, 11.0),
        (18.0, 10.0),
        (12.0, 18.0),
    ]
    mean, deviation = predicted(schools, 10.0)
    assert mean == pytest.approx(8.0, abs=0.5)
    assert 6.0 < deviation < 14.0


# -- the calibration ---------------------------------------------------------------------------------------------------


def spilled(action: Any, theta: SimulationParameters, rng: np.random.Generator) -> float:
    """A smooth rise with the distance between arm and receiver."""
    distance = action.x_offset + theta.receiver_x - 0.11
    return float(0.5 + 0.4 * np.tanh(distance / 0.02) + 0.003 * rng.standard_normal())


def calibrated(remembered: float | None, pours: int = 3, **changes: Any) -> Any:
    """A calibration on a bench whose receiver stands 8 mm farther away, with a memory of another place."""
    rng, truth = np.random.default_rng(1), SimulationParameters(receiver_x=0.008)
    made = [action_at(0.10 + 0.01 * i) for i in range(pours)]
    measured = [MeasuredPour(action, spilled(action, truth, rng), 0.98, "train") for action in made]
    memory = None
    if remembered is not None:
        memory = CampaignMemory((RememberedParameter("receiver_x", remembered, 0.001, ("earlier-1",)),))
    searched = {"actions": ACTIONS, "parameters": SEARCHED, "fixed_parameters": {}, "simulations": "auto"}
    plan = calibration_plan(**searched | changes, scene=SLOW, memory=memory)
    strategy = plan.settings.build(plan, measured, 1)
    harness = StrategyHarness(spilled)
    harness.run(strategy)
    return strategy


def action_at(x_offset: float) -> Any:
    return SLOW.action({"x_offset": x_offset})


def test_a_memory_that_is_right_keeps_its_weight_and_names_its_run() -> None:
    strategy = calibrated(0.0075)
    found = strategy.result().memory
    (group,) = found.groups
    assert (group.group, group.runs, group.contradicted) == ("placement", ("earlier-1",), False)
    assert group.probability > 0.8
    assert "earlier-1" in strategy.decisions[0].text
    assert "the pours confirm the memory of the placement (earlier-1)" in found.text
    assert "the uncalibrated parameters are those of this prior" in found.text
    assert not found.questions
    assert abs(strategy.theta.receiver_x - 0.008) < 0.002
    assert abs(found.alone["receiver_x"].mean - 0.008) < 0.004  # later campaigns get what these pours alone tell


@pytest.mark.parametrize(("remembered", "pours"), [(-0.012, 3), (0.015, 2)])
def test_a_memory_that_the_pours_contradict_loses_its_weight_and_the_run_says_so(remembered: float, pours: int) -> None:
    strategy = calibrated(remembered, pours)
    (group,) = strategy.result().memory.groups
    assert group.contradicted
    assert "uncalibrated" not in strategy.result().memory.text
    assert any(
        "contradict the memory of the placement (earlier-1" in one.text and one.urgent for one in strategy.decisions
    )
    # the start of the search depends on the memory: without starting again, it would have been searched elsewhere
    alone = calibrated(None, pours)
    assert strategy.theta == alone.theta
    assert strategy.result().found == alone.result().found
    assert strategy.result().simulations > alone.result().simulations


def test_a_contradicted_memory_does_not_pull_at_the_result_of_a_fixed_number_of_simulations() -> None:
    strategy = calibrated(-0.012, simulations=60)
    assert strategy.result().memory.contradicted
    assert abs(strategy.theta.receiver_x - calibrated(None, simulations=60).theta.receiver_x) < 0.0005


def test_without_a_memory_the_result_is_as_it_was() -> None:
    assert "memory" not in calibrated(None).result().model_dump(mode="json")


@pytest.mark.parametrize(("design", "contradicted"), [("active", True), ("stratified", False)])
def test_pours_that_are_chosen_with_a_memory_can_contradict_it(design: str, contradicted: bool) -> None:
    # Where nothing is spilled, pours agree with every place of the receiver: a wrong memory would stay unnoticed.
    wide = Space((Axis("x_offset", 0.0, 0.3),))
    wrong = CampaignMemory((RememberedParameter("receiver_x", -0.012, 0.001, ("earlier-1",)),))
    searched: dict[str, Any] = {"actions": wide, "parameters": SEARCHED, "fixed_parameters": {}, "memory": wrong}
    plan = calibration_plan(**searched, scene=SLOW, simulations="auto", pour_count=3, holdout=0, design_simulations=40)
    made = ActiveDesign(plan, None, 1) if design == "active" else StratifiedDesign((SLOW,), wide, 3, 0, 1)
    truth = SimulationParameters(receiver_x=0.008)
    StrategyHarness(spilled, lambda action, _, rng: spilled(action, truth, rng)).run(made)
    strategy = plan.settings.build(plan, made.measured, 1)
    StrategyHarness(spilled).run(strategy)
    found = strategy.result().memory
    assert found.contradicted is contradicted
    (question,) = found.questions
    assert "was the receiver or the arm moved?" in question
    assert question.startswith("The pours contradict" if contradicted else "The pours say little about the placement")
    told = "contradict the memory" if contradicted else "neither confirm nor contradict the memory"
    assert any(f"the pours {told} of the placement" in decision.text for decision in strategy.decisions)


# -- the campaign file -------------------------------------------------------------------------------------------------


def known(name: str, **changes: Any) -> KnownPosterior:
    """A posterior that fits the shipped quickstart."""
    header = fingerprint(load_campaign(shipped("campaigns/quickstart.yaml")))
    scene = header["calibration"]["scene"]
    content: dict[str, Any] = {
        **{"posterior": name, "simulator": simulator_version(), "laboratory": "virtual", "mode": "virtual"},
        **{"arm": arm_of(header["laboratory"]), "pourer": "beaker", "shape": shape_digest(scene), "pours": 12},
        "receivers": ["tumbler"],
        "liquid": {"name": "water", "density": 998.0, "surface_tension": 0.0728, "viscosity": 1e-3},
        "fixed": {"particles": 600.0},
        "parameters": {
            "friction": {"mean": 0.2, "deviation": 0.1},
            "receiver_x": {"mean": 0.0139, "deviation": 0.001},
        },
    }
    return KnownPosterior.model_validate(content | changes)


def with_prior(tmp_path: Path, prior: str) -> Path:
    path = tmp_path / "second.yaml"
    shipped_text = Path(shipped("campaigns/quickstart.yaml")).read_text(encoding="utf-8")
    configs = Path(shipped("campaigns/quickstart.yaml")).parent.parent
    path.write_text(shipped_text.replace("../", f"{configs}/").replace("seed: 7", f"seed: 7\nprior: {prior}"), "utf-8")
    return path


def test_the_catalogue_is_a_prior_and_a_run_keeps_it_when_the_catalogue_grows(state: Path, tmp_path: Path) -> None:
    import_posterior(known("first-1"))
    path = with_prior(tmp_path, "catalogue")
    plan = load_campaign(path)
    assert plan.memory is not None
    assert plan.memory.runs == ("first-1",)
    import_posterior(known("first-2"))
    assert load_campaign(path).memory.runs == ("first-1", "first-2")  # type: ignore[union-attr]
    from decant.running import build_campaign

    again = build_campaign(plan.resolved, tmp_path)  # as the run's record has it
    assert fingerprint(again) == fingerprint(plan)
    assert fingerprint(load_campaign(path, memory=plan.memory)) == fingerprint(plan)  # as `--resume` does


@pytest.mark.parametrize(
    ("prior", "pours", "design"),
    [
        ("catalogue", "{count: 12, holdout: 4}", ("active", 64)),
        ("catalogue", "{count: 12, holdout: 4, design: stratified}", ("stratified", 0)),
        ("catalogue", "{count: 12, holdout: 4, design: active, simulations: 30}", ("active", 30)),
        (None, "{count: 12, holdout: 4}", ("stratified", 0)),
        ("nothing known", "{count: 12, holdout: 4}", ("stratified", 0)),
    ],
)
def test_with_a_prior_each_pour_is_chosen_by_its_information_unless_the_file_says_otherwise(
    state: Path, tmp_path: Path, prior: str | None, pours: str, design: tuple[str, int]
) -> None:
    if prior == "catalogue":
        import_posterior(known("first-1"))
    path = with_prior(tmp_path, "catalogue")
    text = path.read_text("utf-8").replace("{count: 12, holdout: 4}", pours)
    path.write_text(text if prior else text.replace("prior: catalogue\n", ""), "utf-8")
    plan = load_campaign(path).calibration
    assert plan is not None
    assert (plan.design, plan.design_simulations) == design


def test_an_empty_catalogue_is_stated_and_the_prior_is_uniform(state: Path, tmp_path: Path) -> None:
    memory = load_campaign(with_prior(tmp_path, "catalogue")).memory
    assert memory is not None
    assert not memory.parameters
    assert "uniform" in memory.text
    assert "no posterior yet" in " ".join(memory.lines)


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"simulator": "0123456789abcdef"}, "another simulator (version 0123456789abcdef"),
        ({"arm": "ur3e"}, "another arm (ur3e, here ur10)"),
        ({"mode": "hardware"}, "it is of a hardware laboratory"),
        ({"fixed": {"particles": 2000.0}}, "particles 2000, here it is 600"),
        (
            {"parameters": {"cohesion": {"mean": 0.02, "deviation": 0.001}}},
            "it is about cohesion, which is not searched",
        ),
    ],
)
def test_a_named_posterior_that_does_not_fit_is_refused_and_in_the_catalogue_left_out(
    state: Path, tmp_path: Path, changes: dict[str, Any], reason: str
) -> None:
    import_posterior(known("first-1", **changes))
    with pytest.raises(ConfigError, match=r"second\.yaml:5:") as error:
        load_campaign(with_prior(tmp_path, "[first-1]"))
    assert reason in str(error.value)
    memory = load_campaign(with_prior(tmp_path, "catalogue")).memory
    assert memory is not None
    assert not memory.parameters
    assert reason in memory.left_out[0]


def test_an_unknown_run_is_refused(state: Path, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="nosuch: no such run in the catalogue"):
        load_campaign(with_prior(tmp_path, "[nosuch]"))


def test_another_liquid_keeps_walls_and_placement(state: Path, tmp_path: Path) -> None:
    oil = {"name": "oil", "density": 920.0, "surface_tension": 0.033, "viscosity": 0.06}
    import_posterior(known("first-1", liquid=oil, laboratory="other"))
    memory = load_campaign(with_prior(tmp_path, "catalogue")).memory
    assert memory is not None
    assert list(memory.means) == ["friction"]  # the placement is that of another laboratory
    assert "its placement is not transferred" in " ".join(memory.left_out)


# -- the weighed pours -------------------------------------------------------------------------------------------------

POURED: dict[str, Any] = {
    "liquid": {"name": "water", "density": 998.0, "surface_tension": 0.0728, "viscosity": 1e-3, "mass": 0.2},
    "weighed": [
        {"into": "tumbler", "action": {"angular_velocity": speed, "x_offset": 0.11, "height": 0.1}, "poured": 0.98,
         "measured": 0.1, "simulated": 0.12}
        for speed in (1.2, 1.6)
    ],
}  # fmt: skip


def deploys_only(tmp_path: Path, prior: str = "catalogue") -> Path:
    """The shipped quickstart without its calibration."""
    path = with_prior(tmp_path, prior)
    head, tail = path.read_text("utf-8").split("calibration:")
    searched = "    friction: [0, 0.6]"
    path.write_text(head.split(searched)[0] + "deployment:" + tail.split("deployment:")[1], "utf-8")
    return path


def test_a_prior_brings_the_weighed_pours_with_their_simulations(state: Path, tmp_path: Path) -> None:
    import_posterior(known("first-1", **POURED))
    plan = load_campaign(deploys_only(tmp_path))
    assert plan.deployment is not None
    assert plan.memory is not None
    assert [pair.into for pair in plan.memory.pours or ()] == ["first-1 into tumbler"] * 2
    evidence = with_evidence(plan.deployment, {}, None, plan.deployment.scenes[0], plan.parameters).evidence
    assert evidence is not None
    assert "2 pours of first-1 into tumbler by 2.0 % of the largest loss on average" in evidence.lines[0]
    from decant.running import build_campaign

    again = build_campaign(plan.resolved, tmp_path)  # as the run's record has it
    assert (again.memory, fingerprint(again)) == (plan.memory, fingerprint(plan))


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"weighed": []}, "its file or its run has none with their simulations"),
        ({"shape": "0123456789abcdef", "pourer": "jug"}, "they are from another vessel ('jug')"),
        ({"liquid": {**POURED["liquid"], "mass": 0.1}}, "they are of 100 g, here it is 200 g"),
        ({"liquid": {**POURED["liquid"], "viscosity": 0.06}}, "its viscosity is 0.06, here it is 0.001 (SI)"),
        ({"laboratory": "other"}, "they are of laboratory 'other', here it is 'virtual'"),
        ({"parameters": {"receiver_x": {"mean": 0.2, "deviation": 0.001}}}, "simulations have another receiver_x"),
    ],
)
def test_pours_that_say_nothing_about_the_simulator_here_are_left_out_with_the_reason(
    state: Path, tmp_path: Path, changes: dict[str, Any], reason: str
) -> None:
    import_posterior(known("first-1", **{**POURED, **changes}))
    path = deploys_only(tmp_path)
    if "parameters" in changes:
        path.write_text(
            path.read_text("utf-8").replace("particles: 600", "particles: 600\n    receiver_x: 3 mm"), "utf-8"
        )
        import_posterior(known("first-1", **{**POURED, "parameters": known("x").model_dump()["parameters"]}))
    plan = load_campaign(path)
    assert plan.deployment is not None
    assert plan.memory is not None
    assert plan.memory.pours is None
    (line,) = [line for line in plan.memory.lines if "its weighed pours are not transferred" in line]
    assert line.startswith("not used: first-1: ")
    assert reason in line
    assert with_evidence(plan.deployment, {}, None, plan.deployment.scenes[0], plan.parameters) == plan.deployment


def test_a_campaign_whose_strategy_believes_no_pours_is_told_nothing_of_them(state: Path, tmp_path: Path) -> None:
    import_posterior(known("first-1", **{**POURED, "shape": "0123456789abcdef"}))
    path = with_prior(tmp_path, "catalogue")
    path.write_text(path.read_text("utf-8").split("deployment:")[0] + "outputs: {directory: ../../runs}\n", "utf-8")
    memory = load_campaign(path).memory
    assert memory is not None
    assert (memory.pours, memory.left_out) == (None, ())


def test_of_very_many_earlier_runs_the_newest_pours_are_enough(state: Path, tmp_path: Path) -> None:
    for number in range(4):
        import_posterior(known(f"run-{number}", **{**POURED, "weighed": POURED["weighed"] * 12}))
    memory = load_campaign(deploys_only(tmp_path)).memory
    assert memory is not None
    assert list(dict.fromkeys(pair.into for pair in memory.pours or ())) == ["run-3 into tumbler", "run-2 into tumbler"]
    assert memory.left_out == ("weighed pours of 2 older runs: 48 of newer ones are enough",)


@pytest.mark.parametrize(
    ("change", "problem"),
    [({"action": {"x_offset": 9.0}}, "x_offset"), ({"poured": 1.2}, "1.2 is too large; at most 1")],
)
def test_impossible_pours_in_the_file_of_a_posterior_are_refused(
    tmp_path: Path, change: dict[str, Any], problem: str
) -> None:
    path, posterior = tmp_path / "first.yaml", known("first-1", **POURED)
    text = posterior_text(posterior)
    assert load_posterior_file(write(path, text)).weighed == posterior.weighed
    (name, value), *_ = change.items()
    wrong = text.replace("poured: 0.98", f"poured: {value}") if name == "poured" else text.replace("0.11", "9.0")
    with pytest.raises(ConfigError, match=problem):
        load_posterior_file(write(path, wrong))


def write(path: Path, text: str) -> Path:
    path.write_text(text, encoding="utf-8")
    return path


def test_a_run_that_was_evaluated_tells_its_pours_as_if_each_had_been_left_out_of_the_fit(tmp_path: Path) -> None:
    header = fingerprint(load_campaign(shipped("campaigns/quickstart.yaml")))
    axes = header["calibration"]["parameters"]["axes"]
    header["calibration"]["parameters"]["axes"] = [axis for axis in axes if axis["name"] == "receiver_x"]
    scene = header["calibration"]["scene"]["name"]
    splits = ["test", "train", "train"]
    made = {"action": {}, "action_si": {"angular_velocity": 1.0, "x_offset": 0.1}}
    poured = [
        WeighedPoint(number=i, split=split, scene=scene, **made,
                    spillage=0.1, poured=0.9, invalid_tries=0)
        for i, split in enumerate(splits[::-1], 1)
    ]  # fmt: skip
    pairs = [
        ScoredPair(theta=theta, split=split, scene=scene, measured=0.1, simulated=simulated, reason="")
        for theta, simulated in (("theta", 0.12), ("uncalibrated", 0.5))
        for split in splits
    ]
    scores = Scores(simulations=6, undefined={}, discrepancy={}, random_median={}, thetas={}, pairs=tuple(pairs))
    record = RunState(Header("second", header))
    record.closed["pours"] = StageClosed(stage="pours", result=DesignResult(pours=tuple(poured)))
    record.closed["calibration"] = StageClosed(stage="calibration", result=calibrated(None).result())
    assert posterior_of(tmp_path, record).weighed == []  # without their simulations they say nothing
    record.closed["evaluation"] = StageClosed(stage="evaluation", result=scores)
    weighed = posterior_of(tmp_path, record).weighed
    assert [pour.into for pour in weighed] == ["tumbler"] * 3
    assert [pour.simulated for pour in weighed] == pytest.approx([0.12, 0.14, 0.14])  # 0.1 + 0.02 / (1 − 1 / 2)
    assert weighed[0].action["x_offset"] == 0.1
    assert posterior_of(tmp_path, record).liquid.mass == pytest.approx(0.2)


def test_after_a_move_the_placement_comes_from_the_runs_since_then(state: Path, tmp_path: Path) -> None:
    import_posterior(known("first-1"))
    there = {"friction": {"mean": 0.2, "deviation": 0.1}, "receiver_x": {"mean": -0.006, "deviation": 0.001}}
    import_posterior(known("second-1", parameters=there, contradicts=["first-1"]))
    memory = load_campaign(with_prior(tmp_path, "catalogue")).memory
    assert memory is not None
    runs = {one.name: one.runs for one in memory.parameters}
    assert runs == {"friction": ("first-1", "second-1"), "receiver_x": ("second-1",)}
    assert memory.means["receiver_x"] == pytest.approx(-0.006)
    assert "first-1: its placement is not transferred, the pours of second-1 contradict it" in memory.left_out


def test_a_campaign_is_told_since_when_later_pours_disagree_with_its_prior(
    state: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(str(Path(__file__).parents[4] / "benchmarks"))
    import laboratory_months as months

    def days(first: int, last: int, placement: float) -> None:
        benches = {day: months.Bench(months.np.random.default_rng(day), placement) for day in range(first, last)}
        months.enter([months.write_day(tmp_path / "days", day, b, "virtual") for day, b in benches.items()])

    import_posterior(known("day-00", receivers=["cup"]))
    import_posterior(known("day-08", receivers=["other"]))
    days(0, 9, 0.0)
    path = with_prior(tmp_path, "catalogue")
    assert load_campaign(path).memory.stale == ()  # type: ignore[union-attr]
    days(9, 11, 20.0)
    plan = load_campaign(path)
    assert plan.memory is not None
    assert plan.memory.runs == ("day-00", "day-08")
    (text,) = plan.memory.stale  # the other one is about other cups
    assert text.startswith("day-00: since 2030-03-2")
    assert "standard deviations; a calibration with 12 pours would renew it" in text
    assert f"stale, and used: {text}" in plan.memory.lines
    from decant.running import build_campaign

    assert build_campaign(plan.resolved, tmp_path).memory == plan.memory  # a run's record keeps it
    with Catalogue(state) as catalogue:
        ages = catalogue.posterior_ages(catalogue.posteriors())
    assert ages["day-00"].later_pours > 20
    assert ages["day-00"].deviations == pytest.approx(7.0, abs=3.0)
    assert (ages["day-08"].later_pours, ages["day-08"].since) == (0, None)
    assert "day-00: stale: since 2030-03-2" in CliRunner().invoke(app, ["runs", "known"]).stdout


@pytest.mark.parametrize(("remembered", "contradicts"), [(-0.012, ["earlier-1"]), (0.0075, [])])
def test_a_posterior_names_the_runs_whose_placement_its_pours_contradict(
    tmp_path: Path, remembered: float, contradicts: list[str]
) -> None:
    header = fingerprint(load_campaign(shipped("campaigns/quickstart.yaml")))
    axes = header["calibration"]["parameters"]["axes"]
    header["calibration"]["parameters"]["axes"] = [axis for axis in axes if axis["name"] == "receiver_x"]
    record = RunState(Header("second", header))
    record.closed["calibration"] = StageClosed(stage="calibration", result=calibrated(remembered).result())
    assert posterior_of(tmp_path, record).contradicts == contradicts


def test_a_posterior_is_exported_and_imported_with_its_units(state: Path, tmp_path: Path) -> None:
    path = tmp_path / "first.yaml"
    path.write_text(posterior_text(known("first-1")), encoding="utf-8")
    assert "{mean: 13.9 mm, deviation: 1.0 mm}" in path.read_text(encoding="utf-8")
    estimates = load_posterior_file(path).estimates
    assert estimates["receiver_x"] == pytest.approx((0.0139, 0.001))
    outcome = CliRunner().invoke(app, ["runs", "add", str(path)])
    assert outcome.exit_code == 0, outcome.output
    shown = CliRunner().invoke(app, ["runs", "known", "tumbler"])
    assert "first-1" in shown.output
    with Catalogue(state) as catalogue:
        (again,) = catalogue.posteriors()
    assert again.posterior == "first-1"
    assert again.estimates["receiver_x"] == pytest.approx((0.0139, 0.001))
    assert load_campaign(with_prior(tmp_path, f"[{path}]")).memory.runs == ("first-1",)  # type: ignore[union-attr]


def test_c1_takes_no_prior(state: Path, tmp_path: Path) -> None:
    path = with_prior(tmp_path, "catalogue")
    text = path.read_text(encoding="utf-8").replace("strategy: C4", "strategy: C1")
    path.write_text(text.replace("simulations: auto", "simulations: 200"), encoding="utf-8")
    with pytest.raises(ConfigError, match="prior: belongs to C4"):
        load_campaign(path)
