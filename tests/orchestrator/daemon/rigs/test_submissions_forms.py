"""`submissions`: shipped campaigns as text with their files, and which laboratory a campaign runs in."""

from __future__ import annotations

from pathlib import Path

import pytest
from pydantic import ValidationError

from orchestrator.campaigns.file_loading import load_campaign, load_laboratory
from orchestrator.daemon.rigs.pour_request import PourIn, SubmissionIn
from orchestrator.daemon.rigs.submissions import (
    Submission,
    SubmissionError,
    check,
    names_laboratory,
    pack,
    pack_unresolved,
    receive,
    run_request,
)
from orchestrator.daemon.state.daemon_settings import DaemonSettings, Rig
from tests.support.toy_daemon import CAMPAIGN, campaign_in

SHIPPED = Path(__file__).parents[4] / "configs" / "campaigns"


def with_rigs(folder: Path, **changes: tuple[str, str]) -> DaemonSettings:
    """A daemon whose rigs have the laboratory of the toy campaign, changed."""
    begin, end = CAMPAIGN.index("laboratory:\n") + len("laboratory:\n"), CAMPAIGN.index("liquid: {name")
    lines = [line[2:] for line in CAMPAIGN[begin:end].splitlines()]
    rigs = []
    for name, (old, new) in changes.items():
        path = folder / f"{name}.yaml"
        path.write_text("\n".join(lines).replace(old, new) + "\n", encoding="utf-8")
        rigs.append(Rig(name, path, load_laboratory(path)))
    settings = DaemonSettings(folder / "state", in_process=True, rigs=tuple(rigs))
    settings.snapshots.mkdir(parents=True)
    return settings


def without_laboratory(folder: Path) -> Path:
    """The toy campaign without its laboratory."""
    campaign = campaign_in(folder)
    text = campaign.read_text(encoding="utf-8")
    begin, end = text.index("laboratory:\n"), text.index("liquid: {name")
    campaign.write_text(text[:begin] + text[end:], encoding="utf-8")
    return campaign


@pytest.mark.parametrize("path", sorted(SHIPPED.glob("*.yaml")), ids=lambda path: path.stem)
def test_a_shipped_campaign_is_submitted_unchanged_with_its_files(path: Path, tmp_path: Path) -> None:
    settings = DaemonSettings(tmp_path / "state", in_process=True)
    settings.snapshots.mkdir(parents=True)
    text, files = pack_unresolved(path)
    assert text == path.read_text(encoding="utf-8")
    if (plan := load_campaign(path)).laboratory.mode == "hardware":
        with pytest.raises(SubmissionError, match="runs campaigns on hardware only on a rig that its settings name"):
            receive(settings, Submission(text=text, files=files), "00000a", "somebody")
        return
    item = receive(settings, Submission(text=text, files=files), "00000a", "somebody")
    packed, packed_files = pack(plan)
    again = receive(settings, Submission(text=packed, files=packed_files), "00000b", "somebody")
    assert item.body_hash == again.body_hash
    assert run_request(settings, item, settings.rig(item.rig)).campaign.name == plan.name


def test_a_campaign_without_a_laboratory_runs_on_the_rig(tmp_path: Path) -> None:
    settings = with_rigs(tmp_path, left=("numbers", "numbers"), right=("400", "500"))
    campaign = without_laboratory(tmp_path)
    assert not names_laboratory(campaign)
    text, files = pack_unresolved(campaign)
    with pytest.raises(SubmissionError, match="names no 'laboratory'; say on which rig it runs: left, right"):
        receive(settings, Submission(text=text, files=files), "00000a", "somebody")
    for name, particles in (("left", 400), ("right", 500)):
        item = receive(settings, Submission(text=text, files=files, rig=name), f"00000{name[0]}", "somebody")
        check(settings, item)
        bench = run_request(settings, item, settings.rig(item.rig)).campaign.laboratory.bench
        assert (item.rig, bench.liquid.particles) == (name, particles)  # type: ignore[union-attr]


def test_another_laboratory_than_the_rig_s_is_refused_with_the_first_difference(tmp_path: Path) -> None:
    settings = with_rigs(tmp_path, left=("simulators: 2", "simulators: 7"), right=("400", "500"))
    text, files = pack(load_campaign(campaign_in(tmp_path)))
    submission = Submission(text=text, files=files, rig="right")
    said = "laboratory: bench: liquid: particles is 400 in the campaign and 500 at rig 'right'.*Leave out 'laboratory'"
    with pytest.raises(SubmissionError, match=said):
        receive(settings, submission, "00000a", "somebody")
    assert list(settings.snapshots.iterdir()) == []
    # the number of simulators is the daemon's own
    assert receive(settings, Submission(text=text, files=files, rig="left"), "00000b", "somebody").rig == "left"


def test_a_daemon_without_rigs_says_that_the_laboratory_is_missing(tmp_path: Path) -> None:
    settings = DaemonSettings(tmp_path / "state", in_process=True)
    settings.snapshots.mkdir(parents=True)
    text, files = pack_unresolved(without_laboratory(tmp_path))
    with pytest.raises(SubmissionError, match=r"campaign\.yaml:.*'laboratory' is missing"):
        receive(settings, Submission(text=text, files=files), "00000a", "somebody")


def test_a_null_in_a_request_is_a_key_that_is_left_out() -> None:
    """Clients of typed languages write null for an id that there is not."""
    request = SubmissionIn.model_validate({"text": "name: x", "id": None, "rig": None, "after": None})
    assert (request.id, request.rig) == ("", "")
    with pytest.raises(ValidationError, match="Field required"):
        PourIn.model_validate({"id": None, "source": "jug", "receiver": "cup", "amount": "20 g"})
