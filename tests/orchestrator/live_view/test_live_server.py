"""`live_server`: a live view shows everything to everybody who looks, early or late, and nobody who looks is in
anybody's way.
"""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import time
import urllib.request
from pathlib import Path

import pytest

from orchestrator.cli.view_command import live_view, parsed
from orchestrator.live_view.blueprints import put_beside
from orchestrator.live_view.live_server import LiveError, LiveView, answers
from orchestrator.live_view.recording_sink import SENDING
from orchestrator.live_view.rerun_subscriber import RerunMonitor
from orchestrator.live_view.viewer_server import run_rerun
from orchestrator.records.events import LogLine
from orchestrator.runs.run_folder import RECORDING
from sim_engine.errors import DecantError
from tests.support import example_run
from tests.support.rerun_recordings import Contents, seen, tabs_as_they_came, viewer
from tests.support.waiting import PATIENCE

EXPECTED = (
    ("/cell/receiver/mesh", "Mesh3D:vertex_positions"),
    ("/cell/pourer/mesh", "Mesh3D:vertex_positions"),
    ("/cell/path/planned", "LineStrips3D:strips"),
    ("/cell/table", "Boxes3D:half_sizes"),
    ("/simulation/receiver/mesh", "Mesh3D:vertex_positions"),
    ("/simulation/liquid", "Points3D:class_ids"),
    ("/balance/shown", "Scalars:scalars"),
    ("/balance/verdict", "Scalars:scalars"),
    ("/learning/narrow_cup/loss/predicted", "Scalars:scalars"),
    ("/learning/narrow_cup/surrogate", "EncodedImage:blob"),
    ("/learning/calibration/surrogate", "EncodedImage:blob"),
    ("/machine/activity/simulator_1", "StateChange:state"),
    ("/machine/load/busy", "Scalars:scalars"),
    ("/log/narrow_cup", "TextLog:text"),
    ("/status", "TextDocument:text"),
)


@pytest.mark.slow
def test_viewer_who_joins_late_sees_all_that_happened(tmp_path: Path) -> None:
    plan = example_run.campaign()
    with LiveView() as live:
        with urllib.request.urlopen(live.url, timeout=60.0) as page:
            assert b"<html" in page.read().lower()
        monitor = RerunMonitor(tmp_path / RECORDING, plan, url=live.stream)
        for event in example_run.events(plan):
            monitor(event)
        with viewer(live.stream, tmp_path / "seen.rrd"):
            contents = seen(
                tmp_path / "seen.rrd",  # the newest comes first
                lambda c: c.rows("/learning/narrow_cup/loss/measured") == 3 and c.rows("/simulation/liquid") == 62,
            )
        for entity, component in EXPECTED:
            assert contents.values(entity, component), entity
        assert monitor.close(PATIENCE)
        with viewer(live.stream, tmp_path / "after.rrd"):
            seen(tmp_path / "after.rrd", lambda c: ["ended: finished"] in c.values("/log/campaign", "TextLog:text"))
    assert (monitor.failed, monitor.dropped) == (0, 0)
    # what is on disk is complete, whoever looked
    assert Contents(monitor.path).rows("/learning/narrow_cup/loss/measured") == 3


@pytest.mark.slow
def test_who_comes_late_gets_the_newest_first_in_the_arrangement_that_is_shown_now(tmp_path: Path) -> None:
    plan = example_run.campaign()
    with LiveView() as live:
        monitor = RerunMonitor(tmp_path / RECORDING, plan, url=live.stream)
        told = list(example_run.events(plan))[:-1]
        while not monitor.path.stat().st_size:  # what comes while programs are loaded is sent in one piece
            time.sleep(0.1)
        for part in (told[:8], told[8:]):
            for event in part:
                monitor(event)
            time.sleep(4.0 * SENDING)  # each part is sent on its own
        assert monitor.close(PATIENCE)
        with viewer(live.stream, tmp_path / "seen.rrd"):
            contents = seen(
                tmp_path / "seen.rrd",
                lambda c: c.rows("/learning/narrow_cup/loss/measured") == 3 and c.rows("/log/campaign") > 0,
            )
    steps = contents.columns["/status"]["step"]
    assert steps.index(max(steps)) < steps.index(min(steps)), "what is going on comes before what was"  # type: ignore[type-var]
    assert tabs_as_they_came(tmp_path / "seen.rrd")[-2:] == ["Calibrating", "Deploying"]


@pytest.mark.slow
def test_two_campaigns_are_served_side_by_side(tmp_path: Path) -> None:
    plan = example_run.campaign(pours=1)
    with LiveView() as live:
        monitors = [RerunMonitor(tmp_path / name / RECORDING, plan, url=live.stream) for name in ("first", "second")]
        for monitor in monitors:
            for event in example_run.events(plan):
                monitor(event)
        with viewer(live.stream, tmp_path / "seen.rrd"):
            seen(tmp_path / "seen.rrd", lambda c: c.rows("/learning/narrow_cup/loss/measured") == 2)
        assert all(monitor.close(PATIENCE) for monitor in monitors)


def test_live_view_listens_on_this_machine_only() -> None:
    with LiveView() as live:
        listening = {
            line.split()[1]
            for line in Path("/proc/net/tcp").read_text().splitlines()[1:]
            if line.split()[3] == "0A" and int(line.split()[1].split(":")[1], 16) in live._ports
        }
        assert len(listening) == 2
        assert all(address.startswith("0100007F:") for address in listening)


def test_taken_port_is_refused_where_it_was_asked_for_and_passed_over_otherwise() -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        with pytest.raises(LiveError, match=f"port {port} of 127.0.0.1 is taken"):
            LiveView(web_port=port).open()
        with pytest.raises(DecantError, match=f"port {port} is taken"):
            live_view(example_run.campaign(), live=False, at=f"127.0.0.1:{port}")
    with LiveView() as one, LiveView() as other:
        assert not {*one._ports} & {*other._ports}


def test_address_that_is_not_one_is_refused_with_what_would_be_right() -> None:
    assert parsed("0.0.0.0") == ("0.0.0.0", None)
    assert parsed("[::1]:9000") == ("::1", 9000)
    for wrong in ("9090:", "a b", "127.0.0.1:99999"):
        with pytest.raises(DecantError, match="write ADDRESS or ADDRESS:PORT"):
            parsed(wrong)


@pytest.mark.slow
@pytest.mark.parametrize("death", [signal.SIGKILL, signal.SIGSTOP])
def test_server_that_dies_or_hangs_costs_the_recording_nothing(tmp_path: Path, death: signal.Signals) -> None:
    plan = example_run.campaign(pours=1)
    with LiveView() as live:
        monitor = RerunMonitor(tmp_path / RECORDING, plan, url=live.stream)
        monitor(LogLine(level="info", text="before"))
        pid = live.server_pid
        os.kill(pid, death)
        for event in example_run.events(plan):
            monitor(event)
        assert monitor.close(PATIENCE)
        if death == signal.SIGSTOP:
            os.kill(pid, signal.SIGCONT)
    assert Contents(monitor.path).rows("/learning/narrow_cup/loss/measured") == 1


@pytest.mark.parametrize("death", [signal.SIGKILL, signal.SIGSTOP])
def test_writer_that_dies_or_hangs_never_holds_up_the_campaign(tmp_path: Path, death: signal.Signals) -> None:
    plan = example_run.campaign(pours=1)
    monitor = RerunMonitor(tmp_path / "campaign.rrd", plan, capacity=50)
    os.kill(monitor.pid, death)
    told = list(example_run.events(plan))
    for _ in range(200):
        for event in told:
            monitor(event)
    assert monitor.dropped + monitor.failed > 100, "what is missing is counted"
    assert not monitor.close(2.0)


def test_nothing_is_left_behind_when_a_live_view_ends() -> None:
    live = LiveView()
    live.open()
    ports, host = live._ports, live.host
    live.close()
    live.close()
    end = time.monotonic() + PATIENCE
    while any(answers(host, port) for port in ports):
        assert time.monotonic() < end
        time.sleep(0.1)


def test_server_ends_when_the_process_that_minds_it_is_killed() -> None:
    live = LiveView()
    live.open()
    ports, host, server = live._ports, live.host, live.server_pid
    try:
        assert live._process is not None
        live._process.kill()
        end = time.monotonic() + PATIENCE
        while any(answers(host, port) for port in ports):
            assert time.monotonic() < end, "the server outlives it"
            time.sleep(0.1)
    finally:
        live.close()
        with contextlib.suppress(OSError):
            os.kill(server, signal.SIGKILL)


@pytest.mark.slow
def test_rerun_sends_no_statistics_and_touches_no_settings_of_the_user(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where statistics are on Rerun makes its settings file and a queue of events in the user's home at once."""
    home = tmp_path / "home"
    home.mkdir()
    monkeypatch.setenv("HOME", str(home))
    for name in ("CI", "XDG_CONFIG_HOME", "XDG_DATA_HOME"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("FORCE_RERUN_ANALYTICS", "1")
    before = dict(os.environ)

    path = tmp_path / "campaign.rrd"
    plan = example_run.campaign()
    monitor = RerunMonitor(path, plan)
    for event in example_run.events(plan):
        monitor(event)
    assert monitor.close(PATIENCE)
    assert run_rerun("rrd", "stats", str(path)).returncode == 0
    assert put_beside({"one": path, "two": path}, tmp_path / "beside.rrd").stat().st_size > 0
    with LiveView() as live, urllib.request.urlopen(live.url, timeout=60.0) as page:
        assert page.status == 200
    assert [str(found.relative_to(home)) for found in home.rglob("*rerun*")] == []
    assert dict(os.environ) == before
