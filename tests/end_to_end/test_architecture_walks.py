"""The walks on the architecture page: their files are those through which a campaign and a stop really pass."""

from __future__ import annotations

import asyncio
import asyncio.base_events
import inspect
import re
import sys
from collections.abc import Callable, Coroutine
from pathlib import Path
from types import FrameType
from typing import Any

import pytest
from typer.testing import CliRunner

from orchestrator.campaigns.file_loading import load_campaign
from orchestrator.cli.app import app
from orchestrator.learning.deployment.d3 import D3Settings
from orchestrator.records.states import State
from orchestrator.runs.run_service import RunResources, RunService
from orchestrator.runs.run_tasks import run_task
from orchestrator.runs.strategy_harness import SCENE, THETA, StrategyHarness
from tests.support.plans import deployment_plan
from tests.support.small_campaign import CAMPAIGN, write_campaign
from tests.support.toy_spillage import narrow_cup
from tests.support.waiting import wait_async

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "explanation" / "architecture.md").read_text(encoding="utf-8")

ONE_POUR = (
    re.sub(r"(?s)calibration:.*(?=deployment:)", "", CAMPAIGN).replace("D3", "D2").replace("pours: 2", "pours: 1")
)
ONE_POUR = re.sub(r"  (prior_simulations|simulations_per_pour):.*\n", "", ONE_POUR)
ONE_POUR = ONE_POUR.replace("cohesion: [0 N/m, 0.1 N/m]", "cohesion: 0.05 N/m")

FORMS = {
    "Document.parse",
    "validate",
    "References.vessel",
    "resolve_campaign",
    "SceneBuilder.scene",
    "check_campaign",
    "deployment_stages",
    "record_of",
    "open_laboratory",
    "Deployment.ask",
    "OneShotPlanning._next",
    "Journal.append",
}
"""The functions in which a campaign changes its form: text, values, scenes, plan, stages, requests, entries."""

EVERY_COMMAND = {"orchestrator/cli/app.py", "orchestrator/cli/command_options.py"}


class Walk:
    """The product's files on the call stack whenever one of the named functions begins, up to the first call of `last`.

    The stack of a task goes on with that of the code that made the task.
    """

    def __init__(self, monkeypatch: pytest.MonkeyPatch, functions: set[str], last: str) -> None:
        self._functions, self._last, self.ended = functions, last, False
        self._made_by, self.files = dict[object, list[str]](), dict[str, None]()
        create: Callable[..., asyncio.Task[Any]] = asyncio.base_events.BaseEventLoop.create_task

        def noting(loop: Any, coroutine: Coroutine[Any, Any, Any], **options: Any) -> asyncio.Task[Any]:
            task = create(loop, coroutine, **options)
            self._made_by[task] = self._stack(sys._getframe(1))
            return task

        monkeypatch.setattr(asyncio.base_events.BaseEventLoop, "create_task", noting)

    def _stack(self, frame: FrameType | None) -> list[str]:
        names: list[str] = []
        while frame is not None:
            path = Path(frame.f_code.co_filename)
            if path.is_relative_to(ROOT) and path.relative_to(ROOT).parts[0] in ("orchestrator", "actors"):
                names.append(str(path.relative_to(ROOT)))
            frame = frame.f_back
        try:
            task = asyncio.current_task()
        except RuntimeError:
            task = None
        return [*self._made_by.get(task, []), *reversed(names)]

    def _profile(self, frame: FrameType, event: str, argument: object) -> None:
        if event == "call" and not self.ended and frame.f_code.co_qualname in self._functions | {self._last}:
            self.files |= dict.fromkeys(self._stack(frame))
            self.ended = frame.f_code.co_qualname == self._last

    def __enter__(self) -> Walk:
        sys.setprofile(self._profile)
        return self

    def __exit__(self, *error: object) -> None:
        sys.setprofile(None)


def listed(title: str) -> list[str]:
    """The Python files of a walk, in the page's order."""
    chapter = PAGE.partition(f"**{title}")[2].partition("\n**")[0].partition("\n## ")[0]
    return list(dict.fromkeys(re.findall(r"`((?:orchestrator|actors|sim_engine)/[\w/]+\.py)`", chapter)))


def walked(folder: Path, monkeypatch: pytest.MonkeyPatch, functions: set[str], last: str, *words: str) -> set[str]:
    """The files through which a command goes."""
    campaign = write_campaign(folder, ONE_POUR)
    with Walk(monkeypatch, functions, last) as walk:
        result = CliRunner().invoke(app, [words[0], str(campaign), "--in-process", *words[1:]])
    assert result.exit_code in (0, 4), result.output  # a single pour by D2 recommends no action
    return set(walk.files) - EVERY_COMMAND


def test_a_campaign_reaches_its_first_pour_through_the_listed_files(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    files = listed("A campaign file, from its text to the first pour")
    assert len(files) <= 20
    assert walked(tmp_path, monkeypatch, FORMS, "PourProcedure._move", "run") == set(files)


@pytest.mark.slow
def test_a_planning_goes_through_the_listed_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    files = listed("A planning")
    of_pours = {"actors/bench/bench_factory.py", "actors/bench/pour_procedure.py"}
    shared = set(listed("A campaign file, from its text to the first pour")) - of_pours
    functions, options = FORMS | {"WorkerPool.simulate"}, ("--iterations", "2", "--seeds", "2")
    assert walked(tmp_path, monkeypatch, functions, "publish_run", "plan", *options) == {*shared, *files}
    assert not shared & set(files)
    assert len(shared) + len(files) <= 32


def test_a_stop_reaches_the_arm_through_the_listed_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    request = run_task(load_campaign(write_campaign(tmp_path, ONE_POUR)))

    async def stopped() -> None:
        handle = RunService().start(request, RunResources(in_process=True))
        run = asyncio.create_task(handle.wait())
        await wait_async(lambda: run.done() or handle.state.state is State.RUNNING, "the open laboratory")
        await handle.emergency_stop()
        with pytest.raises(asyncio.CancelledError):
            await run

    with Walk(monkeypatch, set(), "DeviceArm.stop") as walk:
        asyncio.run(stopped())
    files = listed("An emergency stop, from the page to the controller")
    begin = files.index("orchestrator/runs/run_service.py")
    assert walk.ended
    assert [*walk.files] == files[begin : files.index("actors/arm/arm_device.py") + 1]


DECISIONS = {
    *{
        "Deployment.tell",
        "DeploymentLedger._settle",
        "DeploymentTrial.take",
        "Hybrid._next",
        "ActionChoice.query",
        "fit",
    },
    *{"GaussianProcess.__init__", "ModelAveragedProcess.__init__", "Region.draw", "minimise", "looked_ahead"},
    *{"least_loss", "ActionChoice.judge", "Deployment._pour"},
}


def test_a_decision_of_d3_goes_through_the_listed_files(monkeypatch: pytest.MonkeyPatch) -> None:
    plan = deployment_plan(model="adaptive", simulations_per_pour=1, pours=2)
    strategy = plan.settings.build(plan, SCENE, THETA, 1)
    with Walk(monkeypatch, DECISIONS, "no function") as walk:
        StrategyHarness(narrow_cup).run(strategy)
    assert set(walk.files) - {"orchestrator/runs/strategy_harness.py"} == set(listed("A decision of D3"))


def test_the_files_of_a_particle_at_a_wall_have_what_the_page_names_and_the_step_calls_it() -> None:
    files = listed("A particle at a wall")
    chapter = PAGE.partition("**A particle at a wall")[2].partition("\n**")[0]
    texts = {name: (ROOT / name).read_text(encoding="utf-8") for name in files}
    for name in re.findall(r"\(`(\w+)`\)", chapter):
        assert any(f"def {name}(" in text for text in texts.values()), name
    step, density = texts["sim_engine/fluid/step.py"], texts["sim_engine/fluid/density.py"]
    for part in ("density", "viscosity", "tension", "walls"):
        assert f"from sim_engine.fluid.{part} import" in step
    assert "from sim_engine.fluid.kernels import" in density
    assert "SignedDistanceGrid" in texts["sim_engine/fluid/scene_setup.py"]


def test_a_new_key_is_declared_where_the_page_says() -> None:
    declared, campaign, resolution, plan = listed("A new key")
    assert "stop" in D3Settings.model_fields
    assert Path(declared) == Path(inspect.getfile(D3Settings)).relative_to(ROOT)
    assert "stop" not in (ROOT / campaign).read_text(encoding="utf-8").split()  # one place
    for name, holds in ((declared, "def check("), (resolution, "def resolve_campaign("), (plan, "class CampaignPlan")):
        assert holds in (ROOT / name).read_text(encoding="utf-8")


def test_each_file_of_a_stop_is_used_by_one_before_it() -> None:
    files = listed("An emergency stop, from the page to the controller")
    texts = [(ROOT / name).read_text(encoding="utf-8") for name in files]
    for i in range(1, len(files)):
        # A proxy calls by name, so that the call of a driver's method stands in the file before.
        before = "".join(texts[max(i - 2, 0) : i])
        called = set(re.findall(r"\b(\w*(?:stop|emergency|call)\w*)[(\"]", before))
        defined = set(re.findall(r"def (\w*(?:stop|emergency|call)\w*)\(", texts[i]))
        imported = Path(files[i]).stem in before or Path(files[i - 1]).stem in texts[i]
        assert imported or called & defined, files[i]
