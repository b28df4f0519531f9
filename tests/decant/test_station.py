"""`station`: the library's station: ten pours from a program, as in the tutorial, and a campaign whose progress is
shown.
"""

from __future__ import annotations

import asyncio
from pathlib import Path

import pytest

import decant
from tests.golden.world import FormulaLaboratory
from tests.support.small_campaign import write_campaign
from tests.support.station import VIAL
from tests.support.station_process import node_process


@pytest.mark.slow
def test_a_program_asks_for_pours_and_reads_them_as_a_table_with_units(tmp_path: Path) -> None:
    pytest.importorskip("pandas")
    with node_process(tmp_path, "station") as url, decant.Station(url, state=tmp_path / "state") as station:
        station.add_vessel("vial-2", VIAL)
        expected = station.pour("try", source="beaker", receiver="vial-2", amount="30 g", dry_run=True)
        assert expected.state == "dry run"
        assert expected.expected_g is not None
        pour = station.pour("plan:1", source="beaker", receiver="vial-1", amount="30 g", wait=300)
        assert pour.state == "weighed"
        assert pour.received_g is not None
        assert pour.received_g > 0.0
        assert "received_g" in pour._repr_html_()
        station.weigh("beaker", "100 g")
        station.pour("plan:2", source="beaker", receiver="vial-2", amount="2 g")
        table = station.pours()
        assert list(table["id"]) == ["plan:2", "plan:1"]
        assert table.attrs["units"]["received_g"] == "g"
        assert station.cancel("plan:2").id == "plan:2"
        assert set(station.vessels()["id"]) == {"beaker", "vial-1", "vial-2"}
        with pytest.raises(decant.DecantError, match="there is no vessel 'nothing'"):
            station.pour("plan:4", source="nothing", receiver="vial-2", amount="5 g")


@pytest.mark.slow
def test_a_campaign_is_checked_without_running_and_started_with_progress(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    campaign = decant.load_campaign(write_campaign(tmp_path))
    assert decant.check(campaign).problems == ()
    monkeypatch.setattr("actors.laboratory.open_laboratory", lambda spec, **more: FormulaLaboratory())

    async def work() -> decant.Run:
        running = await decant.start(campaign)
        assert not running.done
        return await running

    with pytest.warns(UserWarning, match=".+"):
        found = asyncio.run(work())
    assert found.result.state == "finished"
    assert len(found.pours) == 5
