"""A simulator that is wrong: D3 says so, and goes on by its policy."""

from __future__ import annotations

import asyncio
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from actors.optimizer.questions import Suggestion
from orchestrator.journal.journal import JOURNAL_NAME, JournalReader, Kind
from orchestrator.requests import Suggest
from orchestrator.results.loss_units import deployment_unit
from orchestrator.results.model_check_figures import draw_trust, trust_line
from orchestrator.runs.unknown_pours import OperatorNeededError
from orchestrator.strategies.deployment.d2 import RealOnly
from orchestrator.strategies.deployment.d3 import Hybrid
from orchestrator.strategies.deployment.model_check import TrustCheck, TrustSettings
from orchestrator.strategies.deployment.real_pours import PourTrial
from orchestrator.strategy_harness import SCENE as PLAYED
from orchestrator.strategy_harness import THETA, StrategyHarness
from sim_engine.outcome import Loss
from tests.orchestrator import plans
from tests.orchestrator.plans import deployment_plan
from tests.orchestrator.reported import is_picture
from tests.orchestrator.test_stages import laboratory
from tests.orchestrator.toy import SCENE, SPACE, ToyLaboratory, answering, run_toy, toy_plan
from tests.orchestrator.toys import narrow_cup


def upside_down(action: Any, theta: Any, rng: Any) -> float:
    return 1.0 - narrow_cup(action, theta, rng)


def without_noise(values: dict[str, float]) -> float:
    class Quiet:
        def standard_normal(self) -> float:
            return 0.0

    return narrow_cup(PLAYED.action(values), THETA, Quiet())  # type: ignore[arg-type]


def hybrid(seed: int = 1, policy: Any = "D2", **changes: Any) -> Hybrid:
    return Hybrid(deployment_plan(trust=TrustSettings(policy=policy), **changes), PLAYED, THETA, seed)


def weighed(*costs: float) -> list[PourTrial]:
    return [
        PourTrial(n, (0.1 * n, 0.5), {}, None, 0.0, cost=cost, status="weighed")
        for n, cost in enumerate(costs, start=1)
    ]


def said(*means: float, deviation: float = 0.0, noise: float = 0.03) -> Suggestion:
    return Suggestion(
        (), predictions=means, prediction_deviations=(deviation,) * len(means), hyperparameters={"noise": noise}
    )


def test_the_alarm_is_for_pours_far_from_simulation_in_its_own_deviations() -> None:
    check = TrustCheck(TrustSettings(limit=2.5), worst=1.0)
    check.compare(weighed(0.5, 0.3, 0.4), said(0.1, 0.1, 0.1, deviation=0.04))
    spread = np.hypot(np.hypot(0.04, 0.03), 0.01)
    assert check.result().z_scores == pytest.approx(np.array([0.4, 0.2, 0.3]) / spread)
    assert check.alarm
    assert check.policy == "D2"
    doubtful = TrustCheck(TrustSettings(limit=2.5), worst=1.0)
    doubtful.compare(weighed(0.5, 0.3, 0.4), said(0.1, 0.1, 0.1, deviation=0.3))
    assert not doubtful.alarm


def test_two_pours_say_nothing_and_later_ones_are_compared_until_there_are_enough() -> None:
    check = TrustCheck(TrustSettings(pours=4), worst=1.0)
    assert check.due(weighed(0.9, 0.9)) == []
    pours = weighed(0.1, 0.1, 0.1, 0.1, 0.9)
    assert len(check.due(pours[:3])) == 3
    check.compare(pours[:3], said(0.1, 0.1, 0.1))
    assert check.due(pours[:3]) == []
    assert len(check.due(pours)) == 4
    check.compare(pours[:4], said(0.1, 0.1, 0.1, 0.1))
    assert check.due(pours) == []
    assert not check.alarm
    assert "borne out" in check.decisions[-1].text


def test_an_error_that_nobody_cares_about_raises_no_alarm() -> None:
    check = TrustCheck(TrustSettings(), worst=1.0)
    check.compare(weighed(0.02, 0.02, 0.02), said(0.0, 0.0, 0.0, noise=1e-4))
    assert not check.alarm


def test_a_wrong_simulator_is_forgotten_from_the_alarm_on() -> None:
    strategy = hybrid(pours=6, per_pour=2)
    played = StrategyHarness(upside_down, narrow_cup).run(strategy)
    questions = [r.problem for r in played.asked if isinstance(r, Suggest) and r.purpose in ("pour", "conclude")]
    assert [len(q.simulated) > 0 for q in questions] == [True] * 3 + [False] * 4
    assert [q.mean for q in questions[3:]] == ["constant"] * 4
    assert len(played.simulations) == 20 + 3 * 2
    alarm = [d for d in strategy.decisions if d.urgent]
    assert len(alarm) == 1
    assert alarm[0].text.startswith("trust alarm: weighed for simulated")
    trust = strategy.result().trust
    assert (trust.alarm, trust.followed) == (True, "D2")
    assert type(trust).model_validate_json(trust.model_dump_json()) == trust
    assert (strategy.progress().simulations_left, strategy.progress().pours_left) == (0, 0)


def pessimistic(action: Any, theta: Any, rng: Any) -> float:
    """Twice what is really spilled, at least a third of it; the best action is the same."""
    return min(0.35 + 2.0 * narrow_cup(action, theta, rng), 1.0)


def test_a_simulator_that_promised_too_little_is_not_forgotten_and_people_are_told() -> None:
    strategy = hybrid(pours=6, per_pour=2, model="scaled")
    played = StrategyHarness(pessimistic, narrow_cup).run(strategy)
    trust = strategy.result().trust
    assert np.mean(np.abs(trust.z_scores)) > 2.5
    assert (trust.alarm, trust.followed) == (False, None)
    assert not [d for d in strategy.decisions if d.urgent]
    assert [d for d in strategy.decisions if d.text.startswith("pours are better than simulated: weighed for")]
    last = [r.problem for r in played.asked if isinstance(r, Suggest)][-1]
    assert len(last.simulated) == 20 + 6 * 2
    line = trust_line(trust)
    assert line is None


def test_one_pour_that_is_better_does_not_excuse_those_that_are_worse() -> None:
    check = TrustCheck(TrustSettings(limit=2.5), worst=1.0)
    check.compare(weighed(0.05, 0.5, 0.5), said(0.9, 0.1, 0.1))
    assert check.alarm


def test_a_wrong_simulator_is_believed_less_where_the_policy_is_to_widen() -> None:
    played = StrategyHarness(upside_down, narrow_cup).run(hybrid(policy="widen", pours=4))
    last = [r.problem for r in played.asked if isinstance(r, Suggest)][-1]
    assert (last.mean, last.widening, len(last.simulated)) == ("pooled", 3.0, 20)


def test_a_right_simulator_is_used_to_the_end() -> None:
    strategy = hybrid(pours=5, model="scaled")
    played = StrategyHarness(narrow_cup).run(strategy)
    last = [r.problem for r in played.asked if isinstance(r, Suggest)][-1]
    assert last.mean == "scaled"
    assert not [d for d in strategy.decisions if d.urgent]
    assert strategy.result().trust.followed is None


@pytest.mark.slow
def test_on_a_wrong_simulator_d3_ends_no_worse_than_d2_and_on_a_right_one_it_is_ahead_at_pour_3() -> None:
    seeds = range(10)

    def ends(strategy: Any, simulated: Any = narrow_cup) -> float:
        StrategyHarness(simulated, narrow_cup).run(strategy)
        return without_noise(strategy.best_values)

    plan = deployment_plan(strategy="D2", pours=15)
    real = np.array([ends(RealOnly(plan, PLAYED, THETA, seed)) for seed in seeds])
    for model in ("residual", "scaled"):
        wrong = np.array([ends(hybrid(seed, pours=15, model=model), upside_down) for seed in seeds])
        # 1 % of the load is what a simulator may be wrong by: less is not a difference
        assert wrong.mean() - real.mean() < 0.01 + 2 * np.hypot(real.std(), wrong.std()) / np.sqrt(len(seeds))
        first = [
            np.min(StrategyHarness(narrow_cup).run(hybrid(seed, pours=3, model=model)).real_spills) for seed in seeds
        ]
        of_d2 = [
            np.min(
                StrategyHarness(narrow_cup).run(RealOnly(plan.with_settings(pours=3), PLAYED, THETA, seed)).real_spills
            )
            for seed in seeds
        ]
        assert np.mean(first) < 0.5 * np.mean(of_d2)


# -- asked on resume -------------------------------------------------------------------------------------------------


def asking(directory: Path, policy: Any = "ask") -> Any:
    deployment = plans.deployment(
        scenes=(SCENE,),
        actions=SPACE,
        loss=Loss(),
        pours=5,
        prior_simulations=6,
        per_pour=1,
        trust=TrustSettings(policy=policy),
    )
    return toy_plan(directory, deployment=deployment)


def wrong_laboratory() -> ToyLaboratory:
    """Its simulators say that nothing is spilled anywhere."""
    room = laboratory()
    honest = room.simulators.simulate

    async def rosy(task: Any) -> Any:
        result = await honest(task)
        return replace(result, outcome=replace(result.outcome, received=1.0, spilled=0.0))

    room.simulators.simulate = rosy  # type: ignore[method-assign]
    return room


def run(directory: Path, policy: Any = "ask", **arguments: Any) -> Any:
    return asyncio.run(run_toy(directory, wrong_laboratory(), plan=asking(directory, policy), stages=None, **arguments))


def asked_for(directory: Path) -> list[Any]:
    """Everything that was asked of the laboratory, in order."""
    with JournalReader(directory / JOURNAL_NAME) as journal:
        requests = [entry.body["request"] for entry in journal.entries(kinds=[Kind.REQUESTED])]
    return [request for request in requests if request["type"] != "Ask"]


def test_a_campaign_that_asks_pauses_and_goes_on_as_answered(tmp_path: Path) -> None:
    directory = tmp_path / "asked"
    with pytest.raises(OperatorNeededError, match=r"The simulator is wrong here.*--answer 'D2'") as caught:
        run(directory)
    assert caught.value.exit_code == 3
    with JournalReader(directory / JOURNAL_NAME) as journal:
        assert journal.state() == "paused"
    with pytest.raises(OperatorNeededError):  # nobody there: the same question
        run(directory, resume=True)
    with pytest.raises(OperatorNeededError):
        run(directory, resume=True, ask_operator=answering("lost"))
    result = run(directory, resume=True, ask_operator=answering("d2"))
    assert result.state == "finished"
    assert next(iter(result.results.values())).trust.followed == "D2"
    with JournalReader(directory / JOURNAL_NAME) as journal:
        assert [e.body["answer"] for e in journal.entries(kinds=[Kind.OPERATOR_ANSWERED])] == ["D2"]
    # what it asked for is what a campaign asks for that has decided so beforehand
    run(tmp_path / "decided", "D2")
    assert asked_for(directory) == asked_for(tmp_path / "decided")


def test_an_answer_is_replayed_exactly(tmp_path: Path) -> None:
    """Paused again after the answer, the run repeats it from its journal and asks nobody."""
    directory, pours = tmp_path / "run", 0

    async def paused_after_the_answer() -> None:
        def watch(event: Any) -> None:
            nonlocal pours
            if type(event).__name__ == "PourProgressed":
                task.cancel()

        plan = asking(directory)
        task = asyncio.create_task(
            run_toy(directory, wrong_laboratory(), plan=plan, stages=None, resume=True,
                    ask_operator=answering("widen"), watchers=[watch])
        )  # fmt: skip
        with pytest.raises(asyncio.CancelledError):
            await task

    with pytest.raises(OperatorNeededError):
        run(directory)
    asyncio.run(paused_after_the_answer())
    result = run(directory, resume=True)
    assert result.state == "finished"
    assert next(iter(result.results.values())).trust.followed == "widen"


# -- pictures ----------------------------------------------------------------------------------------


def test_an_alarm_is_drawn_and_told(tmp_path: Path) -> None:
    check = TrustCheck(TrustSettings(), worst=1.0)
    check.compare(weighed(0.5, 0.3, 0.4), said(0.1, 0.1, 0.1))
    trust = check.result()
    plan = toy_plan(tmp_path)
    assert plan.deployment is not None
    path = draw_trust(tmp_path / "trust.png", trust, unit=deployment_unit(plan.deployment), receiver="cup")
    assert is_picture(path)
    line = trust_line(trust)
    assert line is not None
    assert "after pour 3 its simulations were forgotten" in line
    nothing = TrustCheck(TrustSettings(), worst=1.0).result()
    with pytest.raises(ValueError, match="no pour was compared"):
        draw_trust(tmp_path / "nothing.png", nothing, unit=deployment_unit(plan.deployment), receiver="cup")
