"""`campaign_file`: bad campaigns and records in addition to those of `tests/golden`."""

from __future__ import annotations

from pathlib import Path

import pytest

from orchestrator.campaigns.file_loading import load_campaign
from tests.support.campaign_files import CAMPAIGN, CSV, DEPLOYED, RECORDED, report, write


def test_the_good_inputs_that_the_table_spoils_are_good(folder: Path) -> None:
    for text in (CAMPAIGN, RECORDED, DEPLOYED):
        load_campaign(write(folder, "good.yaml", text))


BAD_CAMPAIGNS = {
    "all pours but one held out": (
        CAMPAIGN,
        "holdout: 2",
        "holdout: 7",
        "pours.holdout: keeps 7 of 8 pours for testing, so that 1 is left to fit; a calibration needs 2",
    ),
    "a single pour": (
        CAMPAIGN,
        "count: 8, holdout: 2",
        "count: 1",
        "pours.count: keeps 0 of 1 pours for testing, so that 1 is left to fit; a calibration needs 2",
    ),
    "too many pours": (
        CAMPAIGN,
        "count: 8",
        "count: 1000000000",
        "pours.count: 1000000000 is too large; at most 2,000: the surrogates are made for some hundreds of pours",
    ),
    "too many pours for a deployment": (
        DEPLOYED,
        "pours: 15",
        "pours: 1000000000",
        "deployment.pours: 1000000000 is too large; at most 2,000: the surrogates",
    ),
    "too many simulations between pours": (
        DEPLOYED,
        "pours: 15",
        "pours: 15\n  simulations_per_pour: 1000000000",
        "deployment.simulations_per_pour: 1000000000 is too large; at most 200,000: at ten simulations a second",
    ),
    "too many simulations before pours": (
        DEPLOYED,
        "pours: 15",
        "pours: 15\n  prior_simulations: 1000000000",
        "deployment.prior_simulations: 1000000000 is too large; at most 200,000",
    ),
    "too large a baseline": (
        CAMPAIGN,
        "simulations: 20",
        "simulations: 20\n  random_baseline: 1000000000",
        "calibration.random_baseline: 1000000000 is too large; at most 200,000",
    ),
    "home of nobody": (
        CAMPAIGN,
        "name: test",
        "name: test\noutputs: {directory: ~nobody-of-this-name/runs}",
        "outputs.directory: '~nobody-of-this-name' is not the home directory of any user",
    ),
    "open bracket": (CAMPAIGN, "0.1 N/m]", "0.1 N/m", "not YAML: "),
}


@pytest.mark.parametrize("case", BAD_CAMPAIGNS, ids=lambda case: case.replace(" ", "-"))
def test_bad_campaign_is_refused_with(case: str, folder: Path) -> None:
    good, old, new, expected = BAD_CAMPAIGNS[case]
    assert old in good
    text = report(write(folder, "bad.yaml", good.replace(old, new, 1)))
    assert expected in text
    assert text.count("bad.yaml:") == 1, "one cause, one message"


def test_a_record_with_a_single_training_pour_is_refused(folder: Path) -> None:
    write(folder, "pours.csv", CSV.replace("train", "test", 1))
    text = report(write(folder, "recorded.yaml", RECORDED))
    assert "calibration.pours.from: has 1 training pour with at least 5% poured; a calibration needs 2" in text
