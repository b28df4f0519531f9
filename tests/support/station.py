"""Materials and orders for tests of the station's API."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import Any

from orchestrator.campaigns.file_loading import load_laboratory
from orchestrator.daemon.state.daemon_settings import Rig
from tests.support.toy_daemon import Served
from tests.support.waiting import PATIENCE

BEAKER = {"profile": {"unit": "mm", "inner": [[0, 0], [30, 0], [30, 70]], "wall": "4 mm", "floor": "4 mm"}}
VIAL = {"profile": {"unit": "mm", "inner": [[0, 0], [20, 0], [20, 90]], "wall": "4 mm", "floor": "4 mm"}}
LABORATORY = "{name: numbers, bench: {liquid: {particles: 400}, time_scale: 0}}\n"


def rigs_in(folder: Path, *names: str) -> tuple[Rig, ...]:
    """Rigs of a simulated bench without waiting times."""
    path = folder / "numbers.yaml"
    path.write_text(LABORATORY, encoding="utf-8")
    return tuple(Rig(name, path, load_laboratory(path)) for name in names or ("left",))


def setting_up(mass: str = "100 g") -> list[tuple[str, dict[str, Any]]]:
    """The calls that register a liquid, a filled beaker and two vials."""
    return [
        ("/materials/liquids", {"id": "water", "code": "L-1", "properties": {"name": "water"}}),
        ("/materials/vessels", {"id": "beaker", "code": "4001", "shape": BEAKER}),
        ("/materials/vessels", {"id": "vial-1", "shape": VIAL}),
        ("/materials/vessels", {"id": "vial-2", "shape": VIAL}),
        ("/materials/vessels/beaker/weighed", {"mass": mass, "liquid": "water"}),
    ]


async def set_up(served: Served, mass: str = "100 g") -> None:
    for path, body in setting_up(mass):
        await served.post(path, body)


def order(key: str = "order-1", **changes: Any) -> dict[str, Any]:
    body = {"id": key, "source": "beaker", "receiver": "vial-1", "predict": False}
    if "amount" not in changes:
        body["action"] = {"angular_velocity": "100 deg/s", "x_offset": "70 mm"}
    return body | changes


async def until_pour(served: Served, key: str, *states: str) -> dict[str, Any]:
    async with asyncio.timeout(PATIENCE):
        while True:
            found: dict[str, Any] = await served.get(f"/pours/{key}")
            if found["state"] in states:
                return found
            await asyncio.sleep(0.02)


async def content(served: Served, vessel: str) -> dict[str, Any]:
    found = await served.get("/materials")
    return next(one["content"] for one in found["vessels"] if one["id"] == vessel)
