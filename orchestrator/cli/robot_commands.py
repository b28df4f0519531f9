"""Options and help texts of the commands at a bench: `doctor`, `jog` and `pour`.

Their work is done in `doctor`, `jogging` and `pour_command`.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from orchestrator.cli.command_options import (
    Arm,
    Assignments,
    Campaign,
    InProcess,
    Json,
    Laboratory,
    OtherLaboratory,
    Quiet,
    SceneName,
    call,
    given,
)


def doctor(
    laboratory: Laboratory,
    accept_safety: Annotated[
        bool,
        typer.Option(
            "--accept-safety",
            help="Record the controller's current safety settings, by their checksum, as read and accepted: "
            "NAME.safety.json next to the laboratory file. Without such a record nothing is poured.",
        ),
    ] = False,
    tare: Annotated[
        bool,
        typer.Option("--tare", help="Also tare the balance as a test: the load on it then reads zero."),
    ] = False,
    as_json: Json = False,
) -> None:
    """Check everything that a pour needs, and print advice: network, controller, safety settings, balance.

    Nothing moves and no setting is changed. For a virtual laboratory, controller and balance are started for the check.
    Exit code 1 if a check fails.
    """
    from orchestrator.cli import doctor as verb

    call(verb.doctor, laboratory, accept_safety=accept_safety, tare=tare, as_json=as_json)


def jog(laboratory: Laboratory, arm: Arm = False) -> None:
    """Move the arm by small, slow steps that are typed one by one, or bring it home.

    'j5 +2' turns joint 5 by 2 deg, 'z -5' moves the tool by 5 mm, 'home' goes home. The first step along an axis is
    confirmed with Enter; Ctrl-C stops the arm.
    """
    from orchestrator.cli import jogging as verb

    call(verb.jog, laboratory, armed=arm)


def pour(
    campaign: Campaign,
    assignments: Assignments = None,
    scene: SceneName = None,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Plan, check and show the whole path of the arm; move nothing.")
    ] = False,
    connect: Annotated[
        bool, typer.Option("--connect", help="With --dry-run: also check whether the arm is at home.")
    ] = False,
    png: Annotated[
        Path | None, typer.Option(help="Draw the arm's path from the side and from above.", show_default=False)
    ] = None,
    empty: Annotated[
        bool, typer.Option("--empty", help="Run the whole cycle with an empty pourer, without weighing.")
    ] = False,
    slow: Annotated[float, typer.Option(min=0.05, max=1.0, help="With --empty: fraction of the planned speed.")] = 1.0,
    laboratory: OtherLaboratory = None,
    in_process: InProcess = False,
    arm: Arm = False,
    as_json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Pour once with a given action on the campaign's bench, only plan the pour, or try it with an empty pourer.

    A pour with liquid is recorded in a journal and weighed, as a small run; `--empty` writes a record, pour.json.
    """
    options = given(locals(), "campaign")
    from orchestrator.cli import pour_command as verb

    call(verb.pour, campaign, **options)
