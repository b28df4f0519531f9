"""The recipe "any PyLabRobot scale": PyLabRobot's own driver of a Mettler balance, over our emulated one.

It needs pylabrobot and pyserial in this environment.
"""

from __future__ import annotations

import importlib.util
import sys
import types
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from decant.plugins import LaboratoryError
from decant.plugins.testing import BalanceBench, BalanceContract, VirtualSerialBalance

RECIPE = Path(__file__).parents[2] / "docs" / "recipes" / "pylabrobot_scale.py"
LABORATORY = "recipe_laboratory"
"""Module with the function that makes the scale."""

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(importlib.util.find_spec("pylabrobot") is None, reason="pylabrobot is not installed"),
]


@pytest.fixture
def recipe(monkeypatch: pytest.MonkeyPatch) -> Any:
    spec = importlib.util.spec_from_file_location("pylabrobot_scale", RECIPE)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, spec.name, module)
    spec.loader.exec_module(module)
    return module


def name_scale(monkeypatch: pytest.MonkeyPatch, backend: Any) -> str:
    """A module of the laboratory whose function makes a scale with this backend."""
    from pylabrobot.scales import Scale

    module = types.ModuleType(LABORATORY)
    module.scale = lambda: Scale("scale", 200, 200, 100, backend=backend())  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, LABORATORY, module)
    return f"{LABORATORY}:scale"


class TestAMettlerBalance(BalanceContract):
    @pytest.fixture
    def bench(self, recipe: Any, monkeypatch: pytest.MonkeyPatch) -> Iterator[BalanceBench]:
        from pylabrobot.scales.mettler_toledo_backend import MettlerToledoWXS205SDUBackend

        far = VirtualSerialBalance.start("mt-sics-weigh-module", baud=0, time_scale=5.0, latency=0.001)
        named = name_scale(monkeypatch, lambda: MettlerToledoWXS205SDUBackend(port=far.port))
        spec = recipe.PylabrobotSettings(scale=named, step=1e-4, span=0.5, deadline=12.0)
        driver = recipe.PylabrobotScale(spec)
        yield BalanceBench(
            driver,
            far.put,
            tolerance=0.2e-3,
            capacity=50.0,
            unplug=far.unplug,
            plug=far.plug,
            restless=lambda active: far.faults(restless=active),
            ignore_tare=lambda active: far.faults(powerless=active),
            lost_within=60.0,
            make=(recipe.PylabrobotScale, spec),
        )
        driver.close()
        far.close()


def test_a_scale_that_ignores_the_tare_is_found(recipe: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    from pylabrobot.scales.chatterbox import ScaleChatterboxBackend

    spec = recipe.PylabrobotSettings(scale=name_scale(monkeypatch, lambda: ScaleChatterboxBackend(12.5)), span=0.2)
    driver = recipe.PylabrobotScale(spec)
    try:
        assert "ScaleChatterboxBackend" in driver.connect()
        assert driver.weigh().mass == pytest.approx(0.0125)
        with pytest.raises(LaboratoryError, match="the tare had no effect"):
            driver.tare()
    finally:
        driver.close()
    assert driver.read().status in ("stable", "lost")
