"""Plans of mixtures of water and oil, and outcomes of their doses."""

from __future__ import annotations

from typing import Any

from actors.interfaces import DoseTarget
from orchestrator.learning.campaign_plan import DispensePlan, MixturePlan, PlannedDose
from orchestrator.learning.mixtures import Mix, pouring_order
from orchestrator.learning.requests import Pour, Poured, Slots
from sim_engine.action import Action
from sim_engine.liquids import Liquid
from sim_engine.outcome import PourMeasurement
from sim_engine.scene import Scene
from sim_engine.vessel.shapes import cylinder

ACTION = Action(1.0, 0.09, 0.06)
CUP = cylinder("cup", inner_radius=0.025, inner_height=0.06)  # 118 mL
DENSITIES = {"water": 998.0, "oil": 920.0}


def scene(liquid: str) -> Scene:
    source = cylinder(f"source/{liquid}", inner_radius=0.04, inner_height=0.1)
    return Scene(
        f"mixtures-{liquid}",
        source,
        CUP,
        Liquid(name=liquid, mass=0.3, density=DENSITIES[liquid]),
        fixed=ACTION.values(),
    )


def plan(*rows: dict[str, float], **settings: Any) -> DispensePlan:
    cups = {
        f"rack/A{i}": {
            liquid: PlannedDose(1e-3 * row[liquid], 1e-3, "cup", f"rack/A{i}", liquid) for liquid in pouring_order(row)
        }
        for i, row in enumerate(rows, start=1)
    }
    doses = tuple(dose for row in cups.values() for dose in row.values())
    return DispensePlan(
        (scene("water"), scene("oil")), doses, 0.0, False, "bench", mixtures=MixturePlan(cups, **settings)
    )


def asked(strategy: Mix) -> tuple[Pour, DoseTarget]:
    (request,) = strategy.ask(Slots(0))
    assert isinstance(request, Pour)
    assert request.dose is not None
    return request, request.dose


def poured(pour: Pour, grams: float) -> Poured:
    assert pour.dose is not None
    assert pour.dose.source is not None
    held = pour.dose.source.mass
    knowledge = {"onset_flow": [0.01, 0.0], "covariance": [1e-4, 0.0, 0.0, 0.04], "lag": None, "aim": 0.0, "doses": 1}
    about = {"received": 1e-3 * grams, "left": [held - 1e-3 * grams, 1e-3], "knowledge": knowledge, "deviation": 2e-4}
    return Poured(PourMeasurement(held, 0.0, held - 1e-3 * grams, {"dose": about}))
