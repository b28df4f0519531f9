"""A daemon inside a test: the real queue, store, API and campaigns, on a laboratory without physics."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator, Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import httpx
import pytest

from actors.interfaces import OperatorQuestion, PourProgress, ProgressCallback
from orchestrator.campaigns.file_loading import load_campaign
from orchestrator.daemon.http_api import serve_app
from orchestrator.daemon.rigs.rig_worker import SharedServices
from orchestrator.daemon.rigs.submissions import pack
from orchestrator.daemon.rigs.supervisor import Supervisor
from orchestrator.daemon.state.access_tokens import Role, Tokens, token_of
from orchestrator.daemon.state.daemon_settings import DaemonSettings
from orchestrator.daemon.state.daemon_store import AT_REST
from sim_engine.outcome import PourMeasurement
from sim_engine.scene import Scene
from tests.support.small_campaign import write_campaign
from tests.support.toy_campaign import ToyBench, ToyLaboratory, ToyOptimizer, ToySimulators
from tests.support.waiting import PATIENCE

CAMPAIGN = """\
name: cup
seed: 3
laboratory:
  name: numbers
  simulators: 2
  bench: {liquid: {particles: 400}, time_scale: 0}
liquid: {name: water, mass: 100 g}
pourer: beaker.yaml
motion: {hold_time: 0.3 s, return_velocity: 180 deg/s}
simulator: {parameters: {particles: 300}}
deployment:
  strategy: D2
  receiver: narrow.yaml
  motion: {max_angle: 115 deg, height: 60 mm}
  actions: {angular_velocity: [60 deg/s, 180 deg/s], x_offset: [60 mm, 100 mm]}
  pours: 3
on_unknown: repeat
outputs: {recording: false, figures: false}
"""


class HeldBench(ToyBench):
    """A bench whose pours end when the test says so, and which asks what it is told to ask."""

    def __init__(self) -> None:
        super().__init__()
        self.go = asyncio.Event()
        self.go.set()
        self.begun = asyncio.Event()
        self.stopped = asyncio.Event()
        self.checkpoint = "tilt"
        self.operator: Any = None
        self.question: OperatorQuestion | None = None
        self.answers: list[str] = []
        self.dose: Any = None

    async def pour(
        self, scene: Scene, action: Any, *, seed: int, progress: ProgressCallback | None = None, dose: Any = None
    ) -> PourMeasurement:
        if progress is not None:
            progress(PourProgress(self.checkpoint, 0.5))
        self.dose = dose
        self.begun.set()
        if self.question is not None:
            self.answers.append(await self.operator.ask(self.question))
        try:
            await self.go.wait()
        except asyncio.CancelledError:
            self.aborted.append(seed)
            raise
        return await super().pour(scene, action, seed=seed)


@dataclass
class HeldLaboratory(ToyLaboratory):
    bench: Any = field(default_factory=HeldBench)
    arm_stops: int = 0
    spec: Any = None

    async def stop_arm(self) -> bool:
        self.arm_stops += 1
        self.bench.stopped.set()
        return True


@dataclass
class Served:
    """A running daemon and ways to talk to it."""

    supervisor: Supervisor
    http: httpx.AsyncClient
    tokens: dict[Role, str]
    laboratories: list[HeldLaboratory]
    campaign: Path
    ended: list[bool] = field(default_factory=list)

    @property
    def daemon(self) -> SharedServices:
        return self.supervisor.shared

    def headers(self, role: Role = Role.ADMIN) -> dict[str, str]:
        return {"Authorization": f"Bearer {self.tokens[role]}"}

    async def get(self, path: str, role: Role = Role.VIEWER, **query: Any) -> Any:
        answer = await self.http.get(f"/api/v1{path}", headers=self.headers(role), params=query)
        assert answer.status_code < 300, answer.text
        return answer.json()

    async def post(self, path: str, body: Any = None, role: Role = Role.OPERATOR, status: int = 0) -> Any:
        answer = await self.http.post(f"/api/v1{path}", headers=self.headers(role), json=body)
        assert answer.status_code == status or (not status and answer.status_code < 300), answer.text
        return answer.json()

    async def submit(self, **changes: Any) -> str:
        """Submit the campaign, and wait until it has been checked."""
        text, files = pack(load_campaign(self.campaign))
        found = await self.post("/campaigns", {"text": text, "files": files, **changes})
        key: str = found["id"]
        await self.checked(key)
        return key

    async def checked(self, key: str) -> dict[str, Any]:
        """Wait until a campaign has been checked."""
        async with asyncio.timeout(PATIENCE):
            async for _ in self.daemon.feed.read(0, beat=0.05):
                found: dict[str, Any] = await self.get(f"/campaigns/{key}")
                if found["state"] != "checking":
                    return found
        raise AssertionError("unreachable")

    async def until(self, key: str, *states: str) -> dict[str, Any]:
        """Wait until a campaign is in one of these states, and nobody holds its rig if it rests there."""
        async with asyncio.timeout(PATIENCE):
            async for _ in self.daemon.feed.read(0, beat=0.05):
                found: dict[str, Any] = await self.get(f"/campaigns/{key}")
                resting = found["state"] not in AT_REST or found["progress"] is None
                if found["state"] in states and resting:
                    return found
        raise AssertionError("unreachable")

    async def question(self) -> dict[str, Any]:
        """The first question that is open, once there is one."""
        async with asyncio.timeout(PATIENCE):
            async for _ in self.daemon.feed.read(0, beat=0.05):
                if found := await self.get("/questions"):
                    first: dict[str, Any] = found[0]
                    return first
        raise AssertionError("unreachable")

    async def pouring(self) -> HeldLaboratory:
        """The laboratory of the campaign that runs, once a pour has begun there."""
        async with asyncio.timeout(PATIENCE):
            while not self.laboratories:
                await asyncio.sleep(0.01)
            await self.laboratories[-1].bench.begun.wait()
        return self.laboratories[-1]


Make = Callable[[], HeldLaboratory]


@contextlib.asynccontextmanager
async def serving(folder: Path, make: Make = HeldLaboratory, **settings: Any) -> AsyncIterator[Served]:
    """A daemon with its state below a folder, in which the campaign's files are too."""
    state = folder / "state"
    chosen = DaemonSettings(state, in_process=True, keep_free=0, **settings)
    state.mkdir(exist_ok=True)
    tokens = Tokens(chosen.tokens)
    made: list[HeldLaboratory] = []

    def open_laboratory(spec: Any, **arguments: Any) -> HeldLaboratory:
        laboratory = make()
        laboratory.bench.operator, laboratory.spec = arguments["operator"], spec
        made.append(laboratory)
        return laboratory

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("actors.laboratory.open_laboratory", open_laboratory)
        daemon = Supervisor(chosen)
        known = {role: token_of(chosen.tokens, role) or "" for role in Role}
        ended: list[bool] = []
        app = serve_app(daemon, tokens, lambda: ended.append(True))
        transport = httpx.ASGITransport(app=app)
        async with httpx.AsyncClient(transport=transport, base_url="http://127.0.0.1:1") as http:
            await daemon.start()
            try:
                yield Served(daemon, http, known, made, campaign_in(folder), ended)
            finally:
                for laboratory in made:
                    laboratory.bench.go.set()
                daemon.shared.stopping = True
                daemon.hurry()
                await daemon.close()


def campaign_in(folder: Path) -> Path:
    path = folder / "small.yaml"
    return path if path.exists() else write_campaign(folder, CAMPAIGN)


def held() -> HeldLaboratory:
    """A laboratory whose first pour does not end by itself."""
    laboratory = HeldLaboratory(ToySimulators(), HeldBench(), ToyOptimizer())
    laboratory.bench.go.clear()
    return laboratory


def run(work: Any) -> None:
    """A test's coroutine, with an end."""

    async def limited() -> None:
        async with asyncio.timeout(PATIENCE):
            await work

    asyncio.run(limited())
