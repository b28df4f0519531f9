"""`ray_runtime`: Ray's own processes die or are cut off under an open laboratory: whoever waits is told why, after
seconds.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import psutil
import pytest

from actors.runtime import ray_runtime
from actors.runtime.child_process import own_environment
from tests.reliability import strikes
from tests.support.waiting import alive, wait_for

pytestmark = pytest.mark.ray

ROOT = Path(__file__).parents[3]

PROGRAM = """
import asyncio, json, sys
from actors.laboratory import open_laboratory
from actors.optimizer.questions import Data, MinimumQuery
from actors.laboratory_settings import LaboratorySettings
from actors.laboratory import WarmSimulators
from sim_engine.liquids import SimulationParameters
from sim_engine.search_space import Axis, Space
from sim_engine.scene import PourTask
from tests.support.fake_simulator import make_scene
from sim_engine.action import Action
from tests.reliability.formula import Formula

TASK = PourTask(make_scene(), Action(1.0, 0.09, 0.05, 1.7, 0.5), SimulationParameters(), 1)

async def tell(asked):
    try:
        await asked
        answer = ""
    except Exception as error:
        answer = f"{type(error).__name__}: {error}"
    print(json.dumps(answer), flush=True)

async def questions(simulators, optimizer):
    problem = MinimumQuery(space=Space((Axis("a", 0.0, 1.0),)), data=Data(((0.2,), (0.8,)), (1.0, 2.0)))
    await simulators.simulate(TASK)
    await optimizer.suggest(problem)
    print(json.dumps("ready"), flush=True)
    await asyncio.to_thread(sys.stdin.readline)
    await tell(simulators.simulate(TASK))
    await tell(optimizer.suggest(problem))
    print(json.dumps("closing"), flush=True)

async def of_its_own():
    heard = []
    desk = LaboratorySettings(name="desk", simulators=1)
    async with open_laboratory(desk, pours=False, make=Formula) as laboratory:
        laboratory.listen(heard.append)
        await questions(laboratory.simulators, laboratory.optimizer)
    print(json.dumps(" ".join(notice.text for notice in heard)))

async def kept():
    warm = WarmSimulators(1, make=Formula)
    await warm.open()
    await questions(warm.share(), warm.optimizer())
    await warm.close()
    print(json.dumps(warm.lost))

asyncio.run({"own": of_its_own, "kept": kept}[sys.argv[1]]())
"""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("whose", "lost"),
    [
        ("own", "raylet"),
        pytest.param("kept", "raylet", marks=pytest.mark.slow),
        pytest.param("own", "connection to this program", marks=pytest.mark.slow),
    ],
)
def test_whoever_asks_simulators_or_optimiser_is_told_what_ray_has_lost(whose: str, lost: str, tmp_path: Path) -> None:
    program = subprocess.Popen(
        [sys.executable, "-c", PROGRAM, whose],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, cwd=ROOT, env={**os.environ, "HOME": str(tmp_path)},
    )  # fmt: skip
    assert program.stdin is not None
    assert program.stdout is not None
    with program:
        try:
            assert json.loads(program.stdout.readline()) == "ready"
            children = psutil.Process(program.pid).children(recursive=True)
            if lost == "raylet":
                names = ("raylet", "ray::SimulatorProcess", "ray::Proposer")
                struck = [p for p in children if p.name().startswith(names)]
                assert len(struck) == 3
                for process in struck:
                    process.kill()
            else:
                assert strikes.cut(p.pid for p in children if p.name() in ("raylet", "gcs_server")) > 2
                # Ray ends its workers as soon as it notices; until then a quick simulation still has a result.
                workers = [p for p in children if p.name().startswith(("ray::SimulatorProcess", "ray::Proposer"))]
                wait_for(lambda: not any(alive(p.pid) for p in workers), "end of Ray's workers")
            program.stdin.write("\n")
            program.stdin.flush()
            simulator, optimiser, closing, said = [json.loads(line) for line in program.stdout if line[0] == '"']
        finally:
            program.kill()
    assert f"Ray on this machine has lost its {lost}" in simulator
    assert "MachineLostError" in optimiser
    assert "Ray on this machine has lost its" in optimiser
    assert closing == "closing"
    assert lost in said or whose == "kept"


@pytest.mark.parametrize("runs", [True, False])
def test_a_start_of_ray_waits_as_long_as_its_process_runs(monkeypatch: pytest.MonkeyPatch, runs: bool) -> None:
    """Ray itself gives its node 30 s: beside twenty busy processes that was too little."""
    with own_environment(**ray_runtime._PRIVATE_SETTINGS):  # which Ray reads when it is imported
        from ray._private import services

    answers: list[dict[str, str] | None] = [None, None, {"node": "registered"}]

    def get_node(address: str, node: str) -> dict[str, str]:
        if (answer := answers.pop(0)) is None:
            raise RuntimeError("not registered yet")
        return answer

    monkeypatch.setattr(services, "get_node", get_node)
    monkeypatch.setattr(ray_runtime, "_raylet_runs", lambda: runs)
    with ray_runtime._ray_internals(helpers=False):
        if runs:
            assert services.get_node("", "") == {"node": "registered"}
        else:
            with pytest.raises(RuntimeError, match="not registered yet"):
                services.get_node("", "")
    assert services.get_node is get_node
