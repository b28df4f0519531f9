"""`benchmarks/laboratory_months.py`: its runs are read by the catalogue as those of a laboratory are."""

from __future__ import annotations

from pathlib import Path
from types import ModuleType

import pytest

from orchestrator.catalogue.catalogue import Catalogue
from orchestrator.catalogue.control_charts import QUANTITIES
from orchestrator.records.run_registry import use_state_directory


@pytest.fixture
def months(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> ModuleType:
    monkeypatch.syspath_prepend(str(Path(__file__).parents[2] / "benchmarks"))
    use_state_directory(tmp_path / "state")
    import laboratory_months

    return laboratory_months


def test_a_chart_of_every_quantity_has_what_the_journals_say(months: ModuleType, tmp_path: Path) -> None:
    bench = months.Bench(months.np.random.default_rng(7), gripper=10.0, film=1e-3, balance=0.01, placement=20.0)
    run = months.write_day(tmp_path / "runs", 0, bench)
    months.enter([run])
    with Catalogue() as catalogue:
        assert catalogue.refresh().problems == []
        charts = {chart.quantity: chart.points[-1].value for chart in catalogue.charts({})}
    assert list(charts) == [quantity.column for quantity in QUANTITIES]
    assert charts["prediction_error"] == pytest.approx(0.12 / 0.0089, abs=3.0)
    assert charts["onset_deg"] == pytest.approx(-10.0, abs=1.0)
    assert charts["film_g"] == pytest.approx(1.25, abs=0.2)
    assert charts["empty_pourer_g"] == pytest.approx(0.99 * 152.0, abs=0.2)
    assert (charts["dose_error_g"], charts["zero_g"], charts["missing_g"]) == (
        pytest.approx(0.0, abs=0.6),
        pytest.approx(0.0, abs=0.03),
        pytest.approx(0.0, abs=0.2),
    )
    assert charts["reading_noise_g"] == pytest.approx(0.015, abs=0.01)
