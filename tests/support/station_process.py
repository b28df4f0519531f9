"""A daemon on a toy laboratory as a process of its own, which a test kills at a chosen stage of an ordered pour.

`python -m tests.support.station_process FOLDER STAGE [PORT NODE_PORT]` prints its URL and that of its MADSci node.
Every pour that the bench makes adds a line to FOLDER/poured. In the stage 'held' a pour ends when FOLDER/go exists.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import signal
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import uvicorn

from actors.runtime.child_process import child_environment
from orchestrator.daemon.http_api import serve_app
from orchestrator.daemon.integrations.madsci_node import create_node
from orchestrator.daemon.rigs import ordering, rig_worker
from orchestrator.daemon.rigs.campaign_queue import CampaignQueue
from orchestrator.daemon.rigs.materials import Materials
from orchestrator.daemon.rigs.pour_orders import OrderBook
from orchestrator.daemon.rigs.supervisor import Supervisor
from orchestrator.daemon.state.daemon_settings import DaemonSettings, MadsciSettings
from orchestrator.materials.vessel_account import VesselAccount
from tests.support.station import BEAKER, VIAL, rigs_in
from tests.support.toy_daemon import HeldBench, HeldLaboratory

STAGES = ("checked", "queued", "leased", "pouring", "poured", "in the account", "weighed")


def die(*arguments: object, **more: object) -> Any:
    os.kill(os.getpid(), signal.SIGKILL)


def after(function: Callable[..., Any]) -> Callable[..., Any]:
    def wrapped(*arguments: Any, **more: Any) -> Any:
        function(*arguments, **more)
        die()

    return wrapped


def die_at(stage: str) -> None:
    """Kill this process when an order reaches a stage."""
    match stage:
        case "checked":
            ordering.Ordering._enqueue = die  # type: ignore[method-assign]
        case "queued":
            ordering.Ordering._enqueue = _async_after(ordering.Ordering._enqueue)  # type: ignore[method-assign]
        case "submitting":
            CampaignQueue.submit = die  # type: ignore[method-assign]
        case "submitted":
            CampaignQueue.submit = after(CampaignQueue.submit)  # type: ignore[method-assign]
        case "leased":
            running = rig_worker.Running
            running._renew_order = _async_after(running._renew_order)  # type: ignore[method-assign]
        case "poured":
            rig_worker.RigWorker.settle = die  # type: ignore[method-assign]
        case "in the account":
            VesselAccount.transfer = after(VesselAccount.transfer)  # type: ignore[method-assign]
        case "weighed":
            OrderBook.settle = after(OrderBook.settle)  # type: ignore[method-assign]


def _async_after(function: Callable[..., Any]) -> Callable[..., Any]:
    async def wrapped(*arguments: Any, **more: Any) -> Any:
        await function(*arguments, **more)
        die()

    return wrapped


class CountingBench(HeldBench):
    """Notes every pour in a file."""

    def __init__(self, folder: Path, stage: str) -> None:
        super().__init__()
        self._path, self._stage = folder / "poured", stage

    async def pour(self, scene: Any, action: Any, **more: Any) -> Any:
        with self._path.open("a") as file:
            file.write("poured\n")
            file.flush()
            os.fsync(file.fileno())
        if self._stage == "pouring":
            die()
        while self._stage == "held" and not (self._path.parent / "go").exists():
            await asyncio.sleep(0.02)
        return await super().pour(scene, action, **more)


async def serve(folder: Path, stage: str, port: int = 0, node_port: int = 0) -> None:
    import actors.laboratory
    from orchestrator.daemon.api.access_control import Tokens
    from tests.support.toy_campaign import ToyOptimizer, ToySimulators

    def open_laboratory(spec: Any, **arguments: Any) -> HeldLaboratory:
        return HeldLaboratory(ToySimulators(), CountingBench(folder, stage), ToyOptimizer())

    actors.laboratory.open_laboratory = open_laboratory  # type: ignore[assignment]
    state = folder / "state"
    state.mkdir(exist_ok=True)
    settings = DaemonSettings(
        state, in_process=True, keep_free=0, quick_start=False, rigs=rigs_in(folder), roots=(folder,)
    )
    die_at(stage)
    daemon = Supervisor(settings)
    app = serve_app(daemon, Tokens(settings.tokens), lambda: None)
    node = create_node(daemon, app.state.ordering, MadsciSettings(allow=["127.0.0.1"]))
    sockets = [listener(port), listener(node_port)]
    await daemon.start()
    if stage in ("node", "station", "held"):
        materials = Materials(daemon.shared.store)
        materials.add_liquid("water", "", {})
        for vessel, shape in (("beaker", BEAKER), ("vial-1", VIAL), *([("vial-2", VIAL)] if stage == "held" else [])):
            materials.add_vessel(vessel, "", shape, "", "test")
        materials.weigh("beaker", 0.1, 1e-4, "water", "test")
    for each in sockets:
        each.listen()  # a client may connect as soon as it knows the address
    print(*(f"http://127.0.0.1:{each.getsockname()[1]}" for each in sockets), flush=True)
    await asyncio.gather(*(server_of(one).serve([each]) for one, each in zip((app, node), sockets, strict=True)))


def listener(port: int) -> socket.socket:
    made = socket.socket()
    made.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # a daemon that was killed had this port
    made.bind(("127.0.0.1", port))
    return made


def server_of(app: Any) -> uvicorn.Server:
    server = uvicorn.Server(uvicorn.Config(app, log_config=None, lifespan="off", access_log=False))
    server.capture_signals = contextlib.nullcontext  # type: ignore[method-assign, assignment]
    return server


@contextlib.contextmanager
def station_process(folder: Path, stage: str, *ports: int) -> Iterator[tuple[str, str, subprocess.Popen[str]]]:
    """Run the daemon; yields its URL, that of its MADSci node, and the process."""
    process = subprocess.Popen(
        [sys.executable, "-m", __name__, str(folder), stage, *map(str, ports)],
        stdout=subprocess.PIPE,
        text=True,
        env=child_environment(),
    )
    try:
        assert process.stdout is not None
        url, node = process.stdout.readline().split()
        yield url, node, process
    finally:
        process.kill()
        process.wait()
        if process.stdout is not None:
            process.stdout.close()


@contextlib.contextmanager
def node_process(folder: Path, served: str = "node") -> Iterator[str]:
    """Run the daemon with a filled beaker; yields the URL of its 'node' for MADSci, or of the 'station'."""
    with station_process(folder, served) as (url, node, _):
        yield node if served == "node" else url


if __name__ == "__main__":
    asyncio.run(serve(Path(sys.argv[1]), sys.argv[2], *map(int, sys.argv[3:])))
