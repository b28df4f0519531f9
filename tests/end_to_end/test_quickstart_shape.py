"""The shipped campaigns are what they say they are. Cheap: nothing runs."""

from __future__ import annotations

from pathlib import Path

import pytest

from orchestrator.campaigns.file_loading import load_campaign
from orchestrator.learning.campaign_plan import CampaignPlan
from orchestrator.learning.deployment.d3 import D3Settings
from orchestrator.runs.stages import stages_of
from sim_engine.scene import PoseError

CAMPAIGNS = Path(__file__).parents[2] / "configs" / "campaigns"


def plan(name: str) -> CampaignPlan:
    return load_campaign(CAMPAIGNS / f"{name}.yaml")


def test_paper_has_the_budgets_of_the_paper() -> None:
    paper = plan("paper")
    calibration, deployment = paper.calibration, paper.deployment
    assert calibration is not None
    assert deployment is not None
    assert (calibration.pour_count, calibration.holdout) == (32, 4)
    assert (calibration.strategy, calibration.simulations) == ("C4", 108)
    assert deployment.settings == D3Settings(prior_simulations=37, pours=15, simulations_per_pour=2)
    receivers = {scene.receiver.name for scene in deployment.scenes}
    assert len(receivers) == 3
    assert calibration.scene.receiver.name not in receivers


def test_quickstart_calibrates_and_then_pours_into_a_cup_that_calibration_never_saw() -> None:
    quickstart = plan("quickstart")
    assert quickstart.calibration is not None
    assert quickstart.deployment is not None
    assert [stage.name.partition(":")[0] for stage in stages_of(quickstart)] == [
        "pours",
        "calibration",
        "evaluation",
        "deployment",
    ]
    assert quickstart.deployment.strategy == "D3"
    assert quickstart.deployment.scenes[0].receiver != quickstart.calibration.scene.receiver


@pytest.mark.parametrize("name", ["quickstart", "paper"])
def test_a_resumed_run_of_a_shipped_campaign_asks_nobody(name: str) -> None:
    campaign = plan(name)
    assert campaign.on_unknown == "repeat"


@pytest.mark.parametrize("name", ["quickstart", "paper"])
def test_what_is_real_differs_from_what_simulation_starts_with(name: str) -> None:
    """Else calibration would have nothing to find out."""
    campaign = plan(name)
    bench = campaign.laboratory.bench
    assert campaign.calibration is not None
    assert bench is not None
    hidden, assumed = bench.theta.model_dump(), campaign.parameters.model_dump()
    assert any(hidden[axis] != assumed[axis] for axis in campaign.calibration.parameters.names)
    for axis in campaign.calibration.parameters.axes:
        assert 0.05 < axis.encode(hidden[axis.name]) < 0.95, f"{axis.name} can't be found at an end of what is searched"
    assert bench.pose_error != PoseError()
    assert bench.pose_noise != PoseError()


def test_recorded_fits_28_pours_keeps_4_and_scores_another_receiver() -> None:
    calibration = plan("recorded").calibration
    assert calibration is not None
    assert calibration.records is not None
    assert calibration.transfer is not None
    splits = [pour.split for pour in calibration.records.pours]
    assert (splits.count("train"), splits.count("test")) == (28, 4)
    assert calibration.transfer.scene.receiver != calibration.scene.receiver
    assert len({pour.action.x_offset for pour in calibration.transfer.pours}) > 1
    assert plan("recorded").laboratory.bench is None
