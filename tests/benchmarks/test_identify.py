"""`benchmarks/identify.py`: its benches hide what its posteriors are compared with."""

from __future__ import annotations

from pathlib import Path
from types import ModuleType

import pytest

from decant.running import build_campaign


@pytest.fixture
def study(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(Path(__file__).parents[2] / "benchmarks"))
    import identify

    return identify


@pytest.mark.parametrize("nominal", [0.01, 0.1, 1.0])
@pytest.mark.parametrize(("bench", "particles"), [("as many particles", 600), ("twice as many particles", 1200)])
def test_only_the_bench_knows_the_true_viscosity(
    study: ModuleType, nominal: float, bench: str, particles: int, tmp_path: Path
) -> None:
    true, content = study.drawn(nominal, bench, 1)
    assert nominal / 1.5 <= true <= nominal * 1.5
    content["outputs"] = {"directory": str(tmp_path)}
    campaign = build_campaign(content, tmp_path)
    assert campaign.calibration is not None
    assert campaign.laboratory.bench is not None
    hidden = campaign.laboratory.bench.theta
    declared = campaign.calibration.scene.liquid.dynamic_viscosity
    assert hidden.particles == particles
    assert hidden.viscosity_factor * declared == pytest.approx(true)
    (axis,) = (axis for axis in campaign.calibration.parameters.axes if axis.name == "viscosity_factor")
    assert axis.lower < true / declared < axis.upper
    other, _ = study.drawn(nominal, bench, 2)
    assert other != true


def test_a_row_marks_goals_that_are_missed(study: ModuleType) -> None:
    def run(low: float, middle: float, high: float) -> dict[str, object]:
        return {"nominal": 0.1, "bench": "as many particles", "true": 0.1, "quantiles": [low, middle, high]}

    inside = [run(0.05, 0.11, 0.2)] * 10
    outside = [run(0.15, 0.2, 0.3)] * 2
    assert study.row(inside + outside)[2:4] == ["10 of 12", "1.10"]
    missed = study.row(inside[:5] + outside * 4)
    assert missed[2:4] == ["5 of 13 (**missed**)", "2.00 (**missed**)"]
