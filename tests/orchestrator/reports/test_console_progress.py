"""`console_progress`: what a person at the terminal, or a reader of a CI log, gets to see of a run."""

from __future__ import annotations

import io
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from orchestrator.learning.requests import Failed, Pour, Poured, Simulate, Simulated
from orchestrator.learning.strategy import Progress
from orchestrator.records.events import (
    CampaignClosed,
    CampaignOpened,
    LogLine,
    PourProgressed,
    RequestFinished,
    RequestStarted,
    SpeculationProgressed,
    StageOpened,
    StrategyProgressed,
)
from orchestrator.reports.console_progress import ProgressDisplay
from orchestrator.reports.progress_state import ProgressState
from sim_engine.outcome import PourMeasurement
from tests.support.example_run import LEARNT, campaign, events


def console(*, terminal: bool) -> Console:
    return Console(file=io.StringIO(), force_terminal=terminal, width=150, highlight=False)


def written(display_console: Console) -> str:
    return display_console.file.getvalue()  # type: ignore[attr-defined, no-any-return]


def test_log_without_terminal_names_stages_pours_and_warnings_in_plain_lines() -> None:
    plan, plain = campaign(), console(terminal=False)
    with ProgressDisplay(plan, console=plain) as display:
        for event in events(plan):
            display(event)
    text = written(plain)
    assert "\x1b" not in text
    lines = text.splitlines()
    assert "narrow-cup begins: calibration, narrow cup; mode virtual; runs/narrow-cup-1" in lines
    assert "calibration: stage 1 of 2" in lines
    assert (
        "pour 3/3 into narrow  angular velocity 40 deg/s, x offset 90 mm  predicted 6.67 ± 2.00 %  measured 6.00 %"
        in lines
    )
    assert "the balance drifts" in lines
    assert lines[-1].startswith("campaign finished; 2 simulations, 0.9 s each")
    assert lines[-1].endswith("best so far 6.00 % (pour 3)")


def test_log_without_terminal_has_at_most_one_progress_line_in_two_seconds() -> None:
    now = 0.0
    plan, plain = campaign(), console(terminal=False)
    display = ProgressDisplay(plan, console=plain, clock=lambda: now)
    display(StageOpened(stage="calibration", index=1, count=1))
    for step in range(100):
        now = 0.1 * step
        display(StrategyProgressed(stage="calibration", progress=Progress(step, 100), result=LEARNT))
    assert len([line for line in written(plain).splitlines() if "/100" in line]) == 5  # at 0, 2, 4, 6 and 8 s


def test_plain_lines_say_how_busy_the_pool_was_not_who_is_idle_at_the_moment_a_result_arrives() -> None:
    now = 0.0
    plan, plain = campaign(), console(terminal=False)
    display = ProgressDisplay(plan, console=plain, clock=lambda: now)
    simulations = [r for r in events(plan) if isinstance(r, RequestFinished) and isinstance(r.request, Simulate)]
    display(CampaignOpened(time=0.0, name="x", run_directory=Path("x"), stages=(), mode="none", simulators=2))
    display(StageOpened(time=0.0, stage="calibration", index=1, count=1))
    # two simulators: both work from 0 to 6 s, one of them on to 8 s, nobody from there to 10 s
    for key, finished in enumerate(simulations, start=1):
        display(RequestStarted(time=0.0, stage="calibration", id=key, request=finished.request))
    for key, (finished, end) in enumerate(zip(simulations, (6.0, 8.0), strict=True), start=1):
        display(replace(finished, time=end, id=key, frames=None))
    for time_now, done in ((10.0, 2), (14.0, 3)):
        now = time_now
        display(StrategyProgressed(time=now, stage="calibration", progress=Progress(done, 8), result=LEARNT))
    lines = [line for line in written(plain).splitlines() if "/8" in line]
    assert "pool 70 % busy · 2 simulations" in lines[0]
    assert "pool 0 % busy · 2 simulations" in lines[1]


def test_simulators_that_work_ahead_while_the_arm_pours_are_not_shown_as_idle() -> None:
    now = 0.0
    plan, plain = campaign(), console(terminal=False)
    display = ProgressDisplay(plan, console=plain, clock=lambda: now)
    display(CampaignOpened(time=0.0, name="x", run_directory=Path("x"), stages=(), mode="none", simulators=2))
    display(StageOpened(time=0.0, stage="pours", index=1, count=2))
    display(SpeculationProgressed(time=0.0, running=2, waiting=0))
    display(SpeculationProgressed(time=8.0, running=1, waiting=5))
    now = 10.0
    display(StrategyProgressed(time=now, stage="pours", progress=Progress(0, 0, 1, 8), result=LEARNT))
    assert "pool 90 % busy · 0 simulations · 5 more made ahead" in written(plain)


def test_terminal_shows_bars_the_running_pours_checkpoint_and_the_pool() -> None:
    plan, terminal = campaign(), console(terminal=True)
    display = ProgressDisplay(plan, console=terminal)
    told = list(events(plan))
    running = next(i for i, event in enumerate(told) if isinstance(event, PourProgressed))
    for event in told[: running + 1]:
        display(event)
    screen = console(terminal=False)
    screen.print(display._render())
    text = written(screen)
    assert "━" in text
    assert "pour 1/3 into narrow  angular velocity 40 deg/s, x offset 90 mm  predicted 20.00 ± 2.00 %" in text
    assert "tilting" in text
    assert "40 %" in text
    assert "tilt 30 deg" in text
    assert "balance 0.3 g" in text
    assert "pool 0/2 busy · 2 simulations, 0.9 s each" in text


@pytest.mark.parametrize(
    ("cpu_s", "shown"), [(0.031, "0.031 s each"), (0.9, "0.9 s each"), (12.4, "12 s each"), (312.0, "310 s each")]
)
def test_simulations_that_were_made_ahead_are_counted_with_their_own_time(cpu_s: float, shown: str) -> None:
    """Their answers come at once, so that the wall time of their requests is nearly 0."""
    plan = campaign()
    progress = ProgressState(plan)
    for event in events(plan):
        ahead = event
        if isinstance(event, RequestFinished) and isinstance(event.outcome, Simulated):
            made = Simulated(replace(event.outcome.outcome, cpu_s=cpu_s))
            ahead = replace(event, outcome=made, seconds=0.0002)
        progress(ahead)
    assert f"2 simulations, {shown}" in progress.counts_line()


def test_display_writes_nothing_to_stdout(capsys: pytest.CaptureFixture[str]) -> None:
    plan = campaign()
    with ProgressDisplay(plan) as display:
        for event in events(plan):
            display(event)
    captured = capsys.readouterr()
    assert captured.out == ""
    assert "campaign finished" in captured.err


def test_text_that_looks_like_markup_is_shown_as_it_is() -> None:
    plain = console(terminal=False)
    ProgressDisplay(campaign(), console=plain)(LogLine(level="error", text="balance [/dev/ttyUSB0] is silent"))
    assert written(plain).strip() == "balance [/dev/ttyUSB0] is silent"


def test_pours_and_simulations_are_told_apart_with_the_time_left_in_all() -> None:
    plan, plain = campaign(), console(terminal=False)
    display = ProgressDisplay(plan, console=plain)
    display(
        CampaignOpened(
            time=0.0,
            name="x",
            run_directory=Path("x"),
            stages=("narrow cup",),
            mode="virtual",
            simulators=2,
        )
    )
    display(StageOpened(time=0.0, stage="narrow cup", index=1, count=1))
    done = Progress(simulations=14, of_simulations=40, pours=6, of_pours=6)
    display(StrategyProgressed(time=9.0, stage="narrow cup", progress=done, result=LEARNT))
    (line,) = [line for line in written(plain).splitlines() if "/40" in line]
    assert line.startswith("narrow cup: 6/6 pours · 14/40 simulations")
    assert line.endswith(" left in all")
    screen = console(terminal=False)
    screen.print(display._render())
    assert "6/6 pours · 14/40 simulations" in written(screen)


@pytest.mark.parametrize(
    ("progress", "text"),
    [
        (Progress(194, 400, limited=True), "194 of ≤400 simulations"),
        (Progress(194, 194, limited=True), "194 simulations"),
        (Progress(44, 40, 1, 1), "1/1 pour · 44/44 simulations"),
        (Progress(1, 16, 0, 6, limited=True) + Progress(0, 24), "0 of ≤6 pours · 1 of ≤40 simulations"),
        (Progress(), ""),
    ],
)
def test_counts_never_exceed_their_total_and_limits_are_not_shown_as_totals(progress: Progress, text: str) -> None:
    assert str(progress) == text


def test_best_so_far_is_kept_per_receiver_and_ignores_calibration_pours() -> None:
    plan = campaign()
    tally = ProgressState(plan)
    told = list(events(plan))
    for event in told:
        tally(event)
    calibration_pour = next(
        e for e in told if isinstance(e, RequestFinished) and isinstance(e.request, Pour) and e.request.number == 3
    )
    assert isinstance(calibration_pour.request, Pour)
    tally(replace(calibration_pour, id=91, request=replace(calibration_pour.request, scene="tumbler", number=9)))
    worse = PourMeasurement(loaded=0.2, spilled=0.1, retained=0.0)
    tally(replace(calibration_pour, id=92, request=replace(calibration_pour.request, number=4), outcome=Poured(worse)))
    assert {scene: best.pour for scene, best in tally.best.items()} == {"narrow cup": 3}


def test_confirming_pours_are_counted_apart_and_are_no_best_so_far() -> None:
    plan = campaign()
    assert plan.deployment is not None
    tally = ProgressState(replace(plan, deployment=replace(plan.deployment, confirm=5)))
    for event in events(plan):
        if isinstance(event, (RequestStarted, RequestFinished)) and isinstance(event.request, Pour):
            tally(replace(event, request=replace(event.request, purpose="confirm")))
    assert (tally.pour_line() or "").startswith("confirming pour 3/5 into narrow  ")
    assert tally.best == {}


def test_failed_pours_and_simulations_are_shown_as_such() -> None:
    plan = campaign()
    tally = ProgressState(plan)
    tally(CampaignOpened(name="x", run_directory=Path("x"), stages=("s",), mode="virtual", simulators=2))
    simulation: Any = next(
        e for e in events(plan) if isinstance(e, RequestFinished) and isinstance(e.request, Simulate)
    )
    tally(replace(simulation, outcome=Failed("simulation", "diverged"), frames=None))
    assert "1 failed (diverged)" in tally.pool_line()
    for _ in range(2):
        touching = Failed("invalid_action", "cups touch: at tilt 37° the pourer enters the receiver by 4.1 mm")
        tally(replace(simulation, outcome=touching, frames=None))
    assert "3 failed (mostly cups touch)" in tally.pool_line()
    for event in events(plan):
        if isinstance(event, RequestFinished) and isinstance(event.request, Pour):
            tally(replace(event, outcome=Failed("pour_failed", "the gripper slipped")))
            break
        tally(event)
    assert "failed: the gripper slipped" in (tally.pour_line() or "")


def test_a_refused_pour_keeps_its_number_and_the_next_one_says_how_many_were_begun() -> None:
    plan = campaign()
    tally, pours = ProgressState(plan), [e for e in events(plan) if isinstance(getattr(e, "request", None), Pour)]
    for event in pours:
        first = isinstance(event, RequestFinished) and event.request.number == 1
        tally(replace(event, outcome=Failed("invalid_action", "joint 6 would turn at 150 deg/s")) if first else event)
        if isinstance(event, RequestStarted):
            lines = {1: "pour 1/3 into", 2: "pour 2 (1 of 3) into", 3: "pour 3 (2 of 3) into"}
            assert (tally.pour_line() or "").startswith(lines[event.request.number])


def test_a_pour_that_is_refused_before_it_starts_does_not_repeat_the_line_of_the_one_before() -> None:
    plan = campaign()
    tally, pours = ProgressState(plan), [e for e in events(plan) if isinstance(getattr(e, "request", None), Pour)]
    for event in pours:
        second = event.request.number == 2
        if isinstance(event, RequestFinished) and second:
            tally(replace(event, outcome=Failed("invalid_action", "joint 6 would turn at 150 deg/s")))
            line = tally.pour_line() or ""
            assert line.startswith("pour 2")
            assert "joint 6 would turn at 150 deg/s" in line
        elif not second:
            tally(event)


def test_display_can_be_left_after_a_failure_and_says_how_the_run_ended() -> None:
    plan, terminal = campaign(), console(terminal=True)
    display = ProgressDisplay(plan, console=terminal)
    display.__enter__()
    display(CampaignClosed(state="failed", results={}))
    display.__exit__(RuntimeError, RuntimeError("power cut"), None)
    assert "campaign failed" in written(terminal)
    assert written(terminal).rstrip().endswith("\x1b[?25h")  # the cursor is back
