"""The command `decant view`: opens recordings in a browser, side by side if there are several, or simulates a pour
again.

`live_view` makes the live view for commands that run campaigns.
"""

from __future__ import annotations

import contextlib
import re
import signal
import tempfile
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from orchestrator.cli.command_options import LiveAt, run_folder
from orchestrator.cli.console import FAILED, RefusalError, Refused, check_output, print_message, print_note

if TYPE_CHECKING:
    from orchestrator.learning.campaign_plan import CampaignPlan
    from orchestrator.live_view.live_server import LiveView


def view(
    recordings: Annotated[
        list[Path],
        typer.Argument(
            help="Folders of runs, their names in runs/, or recordings (.rrd).",
            metavar="RUN…",
        ),
    ],
    pour: Annotated[
        int | None,
        typer.Option(min=1, help="Simulate this pour of the run again, with the arm's motion and the run's θ*."),
    ] = None,
    particles: Annotated[
        int | None, typer.Option(min=200, max=50_000, help="With --pour: number of particles instead of θ*'s.")
    ] = None,
    stage: Annotated[
        str | None, typer.Option(help="With --pour: stage of the pour, if several stages number their pours from 1.")
    ] = None,
    output: Annotated[Path | None, typer.Option("--output", "-o", help="Write the recording here and exit.")] = None,
    at: LiveAt = None,
) -> None:
    """Serve recordings for a browser and print the address, until Ctrl-C. Needs no display.

    Several runs are shown side by side, on the timeline of simulated time. With --pour, the liquid of one pour is
    simulated again from the journal; -o keeps that recording.
    """
    from sim_engine.resources import installed

    if not installed("rerun"):
        raise RefusalError("view: needs Rerun, which is not installed: pip install 'decant-pouring[live]'")
    if pour is None and (particles is not None or stage is not None):
        raise RefusalError("--particles and --stage go with --pour")
    if pour is not None and len(recordings) != 1:
        raise RefusalError("--pour takes one run")
    check_output(output, "--output", ".rrd")
    with tempfile.TemporaryDirectory(prefix="decant-view-") as scratch:
        if pour is not None:
            shown = _again(recordings[0], pour, particles, stage, output or Path(scratch) / "pour.rrd")
        elif len(recordings) > 1:
            shown = _beside(recordings, output or Path(scratch) / "beside.rrd")
        else:
            shown = _recording_of(recordings[0])
        if output is not None:
            print_note(f"recording  {shown}")
            return
        _serve(shown, at)


def _serve(shown: Path, at: str | None) -> None:
    from orchestrator.live_view.live_server import LOOPBACK, LiveError, LiveView

    address, port = parsed(at) if at is not None else (LOOPBACK, None)
    stopped = False

    def stop(number: int, frame: object) -> None:
        nonlocal stopped
        stopped = True

    before = {number: signal.signal(number, stop) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        with LiveView(address=address, web_port=port, shown=(shown,)) as live:
            print_message(f"{live.url}\nCtrl-C ends it.")
            while not stopped and live.alive:
                time.sleep(0.2)
            if not stopped:
                raise RefusalError("the viewer's server has ended", FAILED)
    except LiveError as error:
        raise RefusalError(str(error)) from None
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _again(source: Path, number: int, particles: int | None, stage: str | None, path: Path) -> Path:
    from orchestrator.cli.console import waiting_for
    from orchestrator.live_view.simulation_view import find_pour, simulation_rrd, task_of
    from sim_engine.simulator import PourSimulator

    run = _run_of(source)
    plan = _plan_of(run)
    pour = find_pour(run, number, stage)
    task = task_of(plan, run, pour, particles)
    simulator, begin = PourSimulator(), time.monotonic()
    with contextlib.closing(simulator), waiting_for(lambda: f"simulating, {time.monotonic() - begin:.0f} s so far"):
        result = simulator.simulate(task)
    spilled = f"{1e3 * task.scene.liquid.mass * result.outcome.spilled:.1f} g spilled in this simulation"
    assert pour.measured is not None
    weighed = f"{1e3 * pour.measured.spilled:.1f} g spilled when it was poured"
    title = f"pour {pour.request.number} of {pour.stage}, simulated again ({weighed})"
    print_note(f"{title}; {spilled}, {result.outcome.particles} particles")
    return simulation_rrd(path, task, result, title)


def _beside(sources: list[Path], path: Path) -> Path:
    from orchestrator.live_view.blueprints import put_beside
    from orchestrator.reports.figure_style import safe_name

    named: dict[str, Path] = {}
    for each in sources:
        file = _recording_of(each)
        name = safe_name(file.parent.name if file.name == "campaign.rrd" else file.stem)
        while name in named:
            name += "_"
        named[name] = file
    return put_beside(named, path)


def _recording_of(source: Path) -> Path:
    """Return the recording of a run, or the file itself.

    Raises:
        RefusalError: there is none (exit code 2).
    """
    if source.suffix == ".rrd" and source.is_file():
        return source
    run = _run_of(source)
    recordings = sorted(run.glob("campaign*.rrd"), key=lambda path: path.stat().st_mtime)
    recordings = [path for path in recordings if "optimising" not in path.name]
    if not recordings:
        raise RefusalError(f"{run}: has no recording; was it run with 'outputs: {{recording: false}}'?")
    return recordings[-1]


def _run_of(source: Path) -> Path:
    from orchestrator.records.journal import JOURNAL_NAME

    run = run_folder(source)
    if not (run / JOURNAL_NAME).is_file():
        raise RefusalError(f"{run}: is not the folder of a run: it has no {JOURNAL_NAME}")
    return run


def _plan_of(run: Path) -> CampaignPlan:
    from orchestrator.campaigns.file_loading import load_campaign
    from orchestrator.campaigns.yaml.yaml_errors import ConfigError
    from orchestrator.runs.run_folder import RESOLVED

    with Refused(ConfigError, at="the run's own campaign can't be read:\n"):
        return load_campaign(run / RESOLVED)


def live_view(plan: CampaignPlan, *, live: bool, at: str | None) -> LiveView | None:
    """Return the requested live view, not yet open, or None.

    Args:
        plan: campaign to show.
        live: whether `--live` was given.
        at: ADDRESS[:PORT]; implies `--live`.

    Raises:
        RefusalError: the view is not available (exit code 2).
    """
    from orchestrator.live_view.live_server import LOOPBACK, LiveView, is_free
    from sim_engine.resources import installed

    if not live and at is None:
        return None
    if not installed("rerun"):
        raise RefusalError("--live: needs Rerun, which is not installed: pip install 'decant-pouring[live]'")
    if not plan.outputs.recording:
        raise RefusalError(
            f"--live: {plan.source} says 'outputs: {{recording: false}}', and a live view shows what is recorded; "
            "leave that out"
        )
    address, port = parsed(at) if at is not None else (LOOPBACK, None)
    if port is not None and not is_free(address, port):
        raise RefusalError(
            f"--live-at {at}: port {port} is taken, by another live view perhaps, or {address} is not an address of "
            "this machine; leave the port out, and a free one is found"
        )
    return LiveView(address=address, web_port=port)


def parsed(at: str) -> tuple[str, int | None]:
    """Parse '0.0.0.0:9091' into address and port; None without a port.

    Raises:
        RefusalError: the text is invalid.
    """
    match = re.fullmatch(r"(?P<address>[A-Za-z0-9.-]+|\[[0-9a-fA-F:]+\])(:(?P<port>\d+))?", at)
    port = None if match is None or match["port"] is None else int(match["port"])
    if match is None or (port is not None and not 0 < port < 65536):
        raise RefusalError(f"--live-at {at!r}: write ADDRESS or ADDRESS:PORT, as 127.0.0.1:9090")
    return match["address"].strip("[]"), port
