"""The `decant` command."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from orchestrator.cli import queue_commands as daemon_verbs
from orchestrator.cli import report_command as report
from orchestrator.cli import robot_commands as bench_verbs
from orchestrator.cli import run_commands as runs_verbs
from orchestrator.cli import simulate_command as simulate_verb
from orchestrator.cli import vessel_command as vessel_verb
from orchestrator.cli import view_command as view
from orchestrator.cli.command_options import (
    Answer,
    Arm,
    Campaign,
    InProcess,
    Json,
    Live,
    LiveAt,
    OtherLaboratory,
    Parameters,
    Quiet,
    Receiver,
    Resume,
    RunId,
    Seed,
    Thetas,
    call,
    examples,
    given,
)

app = typer.Typer(
    name="decant",
    no_args_is_help=True,
    rich_markup_mode="markdown",
    pretty_exceptions_enable=False,
    help="""Teach a robot arm to pour without spilling.

A campaign (YAML) says what is poured from where into what, which actions may be tried, how the simulator is calibrated
(C4) and how pours are found (D1 in simulation, D2 on the bench, D3 by both). Start with:

    decant run configs/campaigns/quickstart.yaml

Exit codes: 0 done, 1 failed, 2 bad input (nothing was started), 3 a person has to answer, 130 interrupted.
""",
)


def _version(wanted: bool) -> None:
    if wanted:
        from importlib.metadata import version

        print(f"decant {version('decant')}")
        raise typer.Exit


@app.callback()
def decant(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version and end.")
    ] = False,
) -> None:
    """What stands before the verbs."""


def _campaign_verb(name: str, text: str, *lines: str) -> None:
    """Add a verb that runs a campaign, or a part of one: all have the same options."""

    def verb(
        campaign: Campaign,
        resume: Resume = False,
        run_id: RunId = None,
        answer: Answer = None,
        in_process: InProcess = False,
        arm: Arm = False,
        live: Live = False,
        live_at: LiveAt = None,
        laboratory: OtherLaboratory = None,
        seed: Seed = None,
        as_json: Json = False,
        quiet: Quiet = False,
    ) -> None:
        options = given(locals(), "campaign", "name")
        from orchestrator.cli import campaign_commands as campaigns

        call(getattr(campaigns, name), campaign, campaigns.RunOptions(**options))

    app.command(name, help=text, epilog=examples(*lines))(verb)


_campaign_verb(
    "run",
    """Run a campaign: calibrate, then learn to pour. Journal, figures and recording go to runs/ID/.

Ctrl-C pauses: a pour that has begun is finished and weighed first. `--resume` goes on where it stopped.
""",
    "decant run configs/campaigns/quickstart.yaml",
    "decant run configs/campaigns/quickstart.yaml --live   # open the printed address in a browser",
    "decant run my.yaml --resume   # after a stop, a crash or a power cut; nothing finished is done again",
)

_campaign_verb(
    "calibrate",
    """Only calibrate: find the θ whose simulated spills match the weighed ones (C1 to C4), scored on unseen pours.

The recommended θ goes to runs/ID/theta.json in SI units (cohesion in N/m, viscosity in 1/s); `--parameters` reads it.
""",
    "decant calibrate configs/campaigns/recorded.yaml --json",
    "decant calibrate my.yaml && decant plan my.yaml --parameters runs/my-20300131-1/theta.json",
)


@app.command(
    epilog=examples(
        "decant plan my.yaml --parameters theta.json",
        "decant plan my.yaml --parameters theta.json --receiver vase.yaml --json",
    )
)
def plan(
    campaign: Campaign,
    parameters: Parameters = None,
    receiver: Receiver = None,
    iterations: Annotated[int | None, typer.Option(min=2, help="Iterations of the optimiser.")] = None,
    seed: Seed = None,
    seeds: Annotated[
        int, typer.Option(min=2, max=1000, help="Simulations of the planned action, for its prediction and its spread.")
    ] = 5,
    thetas: Thetas = None,
    laboratory: OtherLaboratory = None,
    in_process: InProcess = False,
    as_json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Plan a pour in simulation (D1), for the campaign's receivers or one that it never saw.

    Fifteen actions are simulated, as many at a time as there are cores, and the planned one again with fresh seeds: its
    prediction and band are made of these. Nothing is poured. Actions are shown in deg, deg/s, mm and s.
    """
    options = given(locals(), "campaign")
    from orchestrator.cli import campaign_commands as campaigns

    call(campaigns.plan_pour, campaign, **options)


@app.command(
    epilog=examples(
        "decant study configs/studies/quick.yaml",
        "decant study configs/studies/paper.yaml --dry-run   # what it would take",
        "decant study configs/studies/paper.yaml --jobs 2    # goes on where it stopped, however it was stopped",
    )
)
def study(
    file: Annotated[Path, typer.Argument(help="Study file (YAML).", metavar="STUDY", show_default=False)],
    jobs: Annotated[
        int | None, typer.Option(min=1, help="Processes at a time; one per core if not given.", show_default=False)
    ] = None,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="List what is left, with an estimate of its cost; start nothing.")
    ] = False,
    report_only: Annotated[
        bool, typer.Option("--report", help="Only write figures, tables and page of what is there.")
    ] = False,
    as_json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Compare C1 to C4 and D1 to D3, repeated, on virtual benches that are more or less like the simulator.

    Figures (PNG, SVG, CSV), tables and a page go to runs/study-NAME/report/. Stopped or killed, the same command goes
    on.
    """
    from orchestrator.cli import study_command as verb

    call(verb.study, file, jobs=jobs, dry_run=dry_run, report_only=report_only, as_json=as_json)


app.command(
    epilog=examples(
        "decant simulate my.yaml --set angular_velocity=40 --set x_offset=90   # deg/s and mm",
        "decant simulate my.yaml --set 'angular_velocity=0.7 rad/s' --set 'x_offset=9 cm' --png pour.png",
        "decant simulate my.yaml --from pours.csv --parameters theta.json --csv scored.csv --png scored.png",
    )
)(simulate_verb.simulate)


@app.command(
    epilog=examples("decant validate my.yaml vase.yaml", "decant validate configs/campaigns/*.yaml"),
)
def validate(
    files: Annotated[
        list[Path], typer.Argument(help="Campaign, study, vessel or laboratory files.", show_default=False)
    ],
    quiet: Quiet = False,
) -> None:
    """Check files without starting anything: keys, units, bounds, vessels, and that some action can be poured."""
    from orchestrator.cli import file_commands as verb

    call(verb.validate, files)


@app.command(epilog=examples("decant init lab", "decant run lab/campaigns/quickstart.yaml"))
def init(directory: Annotated[Path, typer.Argument(help="A folder that is empty, or not there yet.")]) -> None:
    """Copy a starting set into a folder: campaigns, laboratories, studies, vessels and weighed pours."""
    from orchestrator.cli import file_commands as starting

    call(starting.init, directory)


@app.command(
    epilog=examples("decant schema > campaign.json", "decant schema result > result.json"),
)
def schema(
    which: Annotated[str, typer.Argument(help="campaign, study, vessel, laboratory, or result.")] = "campaign",
) -> None:
    """Print the JSON schema of campaign files (editors complete YAML with it), or of a run's summary.json."""
    from orchestrator.cli import pour_prediction as single

    call(single.schema, which)


app.command(
    epilog=examples(
        "decant doctor configs/laboratories/virtual.yaml",
        "decant doctor configs/laboratories/ur10-kern.yaml --accept-safety   # after reading them on the teach pendant",
    )
)(bench_verbs.doctor)

app.command(
    epilog=examples(
        "decant jog configs/laboratories/virtual.yaml         # practise without a robot",
        "decant jog configs/laboratories/ur10-kern.yaml --arm",
    )
)(bench_verbs.jog)

app.command(
    epilog=examples(
        "decant pour my.yaml --set angular_velocity=20 --set x_offset=100 --dry-run --png path.png",
        "decant pour my.yaml --set angular_velocity=20 --set x_offset=100 --empty --slow 0.2 --arm",
        "decant pour my.yaml --set angular_velocity=20 --set x_offset=100 --arm",
    )
)(bench_verbs.pour)

app.command(epilog=report.EXAMPLES)(report.report)
app.command(epilog=view.EXAMPLES)(view.view)
app.add_typer(runs_verbs.runs)


@app.command(epilog=examples("decant plugins", "decant plugins --json"))
def plugins(as_json: Json = False) -> None:
    """List what installed packages add: strategies, objectives, balances, arms and sources of vessels.

    Exit code 1 if a package registers something that can't be used; it is named with its package and the reason.
    """
    from orchestrator.cli import file_commands as verb

    call(verb.plugins, as_json=as_json)


@app.command(
    epilog=examples("decant physics", "decant physics outflow walls --full", "decant physics --full --write docs"),
)
def physics(
    cases: Annotated[
        list[str] | None, typer.Argument(help="Cases by name; all if none is given.", show_default=False)
    ] = None,
    full: Annotated[bool, typer.Option("--full", help="All resolutions and seeds: minutes instead of one.")] = False,
    pours: Annotated[
        int | None, typer.Option(min=1, help="Random pours of the case 'walls'.", show_default=False)
    ] = None,
    write: Annotated[
        Path | None,
        typer.Option(
            help="Folder for the page validation.md, its data and figures; cases not run now keep what was "
            "written there before.",
            show_default=False,
        ),
    ] = None,
    list_cases: Annotated[bool, typer.Option("--list", help="Name the cases and end.")] = False,
    as_json: Json = False,
) -> None:
    """Hold the solver against physics: theory, experiments and other solvers, each case with its criterion.

    Exit code 1 if a criterion is not met.
    """
    from orchestrator.cli import solver_validation as verb

    call(verb.physics, cases or [], full=full, pours=pours, write=write, as_json=as_json, list_cases=list_cases)


daemon_verbs.register(app)
vessel_verb.register(app)


def main() -> None:
    """Entry point."""
    app()
