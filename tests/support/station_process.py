"""A daemon on a toy laboratory as a process of its own, which a test kills at a chosen stage of an ordered pour.

`python -m tests.support.station_process FOLDER STAGE` prints its URL. Every pour that the bench makes adds a line to
FOLDER/poured.
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
from orchestrator.catalogue.vessel_account import VesselAccount
from orchestrator.daemon import ordering, rig_worker
from orchestrator.daemon.daemon_settings import DaemonSettings, MadsciSettings
from orchestrator.daemon.http_api import serve_app
from orchestrator.daemon.madsci_node import create_node
from orchestrator.daemon.materials import Materials
from orchestrator.daemon.pour_orders import OrderBook
from orchestrator.daemon.supervisor import Supervisor
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
            ordering.Ordering._queue = die  # type: ignore[method-assign]
        case "queued":
            ordering.Ordering._queue = _async_after(ordering.Ordering._queue)  # type: ignore[method-assign]
        case "leased":
            rig_worker.renew_load = after(rig_worker.renew_load)
        case "poured":
            rig_worker.settle = die
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
        return await super().pour(scene, action, **more)


async def serve(folder: Path, stage: str) -> None:
    import actors.laboratory
    from orchestrator.daemon.access_control import Tokens
    from tests.support.toy_campaign import ToyOptimizer, ToySimulators

    def open_laboratory(spec: Any, **arguments: Any) -> HeldLaboratory:
        return HeldLaboratory(ToySimulators(), CountingBench(folder, stage), ToyOptimizer())

    actors.laboratory.open_laboratory = open_laboratory  # type: ignore[assignment]
    state = folder / "state"
    state.mkdir(exist_ok=True)
    settings = DaemonSettings(state, in_process=True, keep_free=0, quick_start=False, rigs=rigs_in(folder))
    die_at(stage)
    daemon = Supervisor(settings)
    app = serve_app(daemon, Tokens(settings.tokens), lambda: None)
    server = uvicorn.Server(uvicorn.Config(app, log_config=None, lifespan="off", access_log=False))
    server.capture_signals = contextlib.nullcontext  # type: ignore[method-assign, assignment]
    listening = socket.socket()
    listening.bind(("127.0.0.1", 0))
    await daemon.start()
    if stage == "node":
        node = create_node(daemon, app.state.ordering, MadsciSettings(allow=["127.0.0.1"]))
        server.config = uvicorn.Config(node, log_config=None, lifespan="off", access_log=False)
    if stage in ("node", "station"):
        materials = Materials(daemon.store)
        materials.add_liquid("water", "", {})
        for vessel, shape in (("beaker", BEAKER), ("vial-1", VIAL)):
            materials.add_vessel(vessel, "", shape, "", "test")
        materials.weigh("beaker", 0.1, 1e-4, "water", "test")
    listening.listen()  # a client may connect as soon as it knows the address
    print(f"http://127.0.0.1:{listening.getsockname()[1]}", flush=True)
    await server.serve([listening])


@contextlib.contextmanager
def node_process(folder: Path, served: str = "node") -> Iterator[str]:
    """Run the daemon with a filled beaker; yields the URL of its 'node' for MADSci, or of the 'station'."""
    process = subprocess.Popen(
        [sys.executable, "-m", __name__, str(folder), served],
        stdout=subprocess.PIPE,
        text=True,
        env=child_environment(),
    )
    try:
        assert process.stdout is not None
        yield process.stdout.readline().strip()
    finally:
        process.kill()
        process.wait()
        if process.stdout is not None:
            process.stdout.close()


if __name__ == "__main__":
    asyncio.run(serve(Path(sys.argv[1]), sys.argv[2]))
