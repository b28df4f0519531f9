"""The `decant` command: declares the commands with their options and help texts.

Each command imports the module that does its work when it is called, so that `--help` starts fast. The daemon's
commands, `decant vessel` and `decant runs` are registered from their own modules.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from orchestrator.cli import queue_commands, robot_commands, run_commands, simulate_command, vessel_command
from orchestrator.cli import report_command as report
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

A campaign file (YAML) defines the liquid, the vessels, the allowed actions, how the simulator is calibrated (C1 to C4)
and how pours are optimised: D1 in simulation, D2 on the bench, D3 with both. Start with:

    decant run configs/campaigns/quickstart.yaml

Exit codes: 0 success, 1 failed, 2 bad input (nothing was started), 3 an operator must answer, 130 interrupted.
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
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version and exit.")
    ] = False,
) -> None:
    """Options that precede the command."""


def _campaign_command(name: str, text: str, *lines: str) -> None:
    """Add a command that runs a campaign or a part of one; all of them have the same options."""

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


_campaign_command(
    "run",
    """Run a campaign: calibrate, then learn to pour. Journal, figures and recording are written to runs/ID/.

Ctrl-C pauses the run: a pour that has started is finished and weighed first. `--resume` continues it.
""",
    "decant run configs/campaigns/quickstart.yaml",
    "decant run configs/campaigns/quickstart.yaml --live   # open the printed address in a browser",
    "decant run my.yaml --resume   # after a stop, a crash or a power failure; finished work is not repeated",
)

_campaign_command(
    "calibrate",
    """Only calibrate: find the θ whose simulated spillage matches the weighed pours (C1 to C4), scored on other pours.

The recommended θ is written to runs/ID/theta.json in SI units (cohesion in N/m, xsph_rate in 1/s), for `--parameters`.
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
        int, typer.Option(min=2, max=1000, help="Simulations of the planned action, for its prediction interval.")
    ] = 5,
    thetas: Thetas = None,
    laboratory: OtherLaboratory = None,
    in_process: InProcess = False,
    as_json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Plan a pour in simulation (D1), for the campaign's receivers or for a new one.

    By default, fifteen actions are simulated, in parallel on all cores. The planned action is then simulated with
    further seeds, which give its prediction and prediction interval. Nothing is poured.

    Actions are shown in deg, deg/s, mm and s.
    """
    options = given(locals(), "campaign")
    from orchestrator.cli import campaign_commands as campaigns

    call(campaigns.plan_pour, campaign, **options)


@app.command(
    epilog=examples(
        "decant study configs/studies/quick.yaml",
        "decant study configs/studies/paper.yaml --dry-run   # estimate the cost",
        "decant study configs/studies/paper.yaml --jobs 2    # continues a stopped study",
    )
)
def study(
    file: Annotated[Path, typer.Argument(help="Study file (YAML).", metavar="STUDY", show_default=False)],
    jobs: Annotated[
        int | None, typer.Option(min=1, help="Number of parallel processes; default: one per core.", show_default=False)
    ] = None,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="List the unfinished cells with an estimate of their cost; start nothing.")
    ] = False,
    report_only: Annotated[
        bool, typer.Option("--report", help="Only write figures, tables and page from the existing results.")
    ] = False,
    as_json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Compare C1 to C4 and D1 to D3 with repetitions, on virtual benches that differ more or less from the simulator.

    Figures (PNG, SVG, CSV), tables and a page are written to runs/study-NAME/report/. Run the same command again to
    continue a study that was stopped or killed.
    """
    from orchestrator.cli import study_command as verb

    call(verb.study, file, jobs=jobs, dry_run=dry_run, report_only=report_only, as_json=as_json)


app.command(
    epilog=examples(
        "decant simulate my.yaml --set angular_velocity=40 --set x_offset=90   # deg/s and mm",
        "decant simulate my.yaml --set 'angular_velocity=0.7 rad/s' --set 'x_offset=9 cm' --png pour.png",
        "decant simulate my.yaml --from pours.csv --parameters theta.json --csv scored.csv --png scored.png",
    )
)(simulate_command.simulate)


@app.command(
    epilog=examples("decant validate my.yaml vase.yaml", "decant validate configs/campaigns/*.yaml"),
)
def validate(
    files: Annotated[
        list[Path], typer.Argument(help="Campaign, study, vessel or laboratory files.", show_default=False)
    ],
    quiet: Quiet = False,
) -> None:
    """Check files without starting anything: keys, units, bounds, vessels, and whether some action can be poured."""
    from orchestrator.cli import file_commands as verb

    call(verb.validate, files)


@app.command(epilog=examples("decant migrate my.yaml rig.yaml"))
def migrate(
    files: Annotated[
        list[Path],
        typer.Argument(help="Campaign, study, vessel, laboratory or daemon files; rewritten.", show_default=False),
    ],
) -> None:
    """Rename what earlier versions called otherwise, in place; comments and layout stay."""
    from orchestrator.cli import file_commands as verb

    call(verb.migrate, files)


@app.command(epilog=examples("decant init lab", "decant run lab/campaigns/quickstart.yaml"))
def init(directory: Annotated[Path, typer.Argument(help="An empty folder, or one that does not exist yet.")]) -> None:
    """Copy example files into a folder: campaigns, laboratories, studies, vessels and weighed pours."""
    from orchestrator.cli import file_commands as starting

    call(starting.init, directory)


@app.command(
    epilog=examples("decant schema > campaign.json", "decant schema result > result.json"),
)
def schema(
    which: Annotated[str, typer.Argument(help="campaign, study, vessel, laboratory, or result.")] = "campaign",
) -> None:
    """Print the JSON schema of campaign files (editors use it for completion), of other files, or of summary.json."""
    from orchestrator.cli import pour_prediction as single

    call(single.schema, which)


app.command(
    epilog=examples(
        "decant doctor configs/laboratories/virtual.yaml",
        "decant doctor configs/laboratories/ur10-kern.yaml --accept-safety   # after reading them on the teach pendant",
    )
)(robot_commands.doctor)

app.command(
    epilog=examples(
        "decant jog configs/laboratories/virtual.yaml         # practise without a robot",
        "decant jog configs/laboratories/ur10-kern.yaml --arm",
    )
)(robot_commands.jog)

app.command(
    epilog=examples(
        "decant pour my.yaml --set angular_velocity=20 --set x_offset=100 --dry-run --png path.png",
        "decant pour my.yaml --set angular_velocity=20 --set x_offset=100 --empty --slow 0.2 --arm",
        "decant pour my.yaml --set angular_velocity=20 --set x_offset=100 --arm",
    )
)(robot_commands.pour)

app.command(epilog=report.EXAMPLES)(report.report)
app.command(epilog=view.EXAMPLES)(view.view)
app.add_typer(run_commands.runs)


@app.command(epilog=examples("decant plugins", "decant plugins --json"))
def plugins(as_json: Json = False) -> None:
    """List the plug-ins of installed packages: strategies, objectives, balances, arms and sources of vessels.

    Exit code 1 if a plug-in can't be used; the output gives its package and the reason.
    """
    from orchestrator.cli import file_commands as verb

    call(verb.plugins, as_json=as_json)


@app.command(
    epilog=examples("decant physics", "decant physics outflow walls --full", "decant physics --full --write docs"),
)
def physics(
    cases: Annotated[list[str] | None, typer.Argument(help="Names of cases; default: all.", show_default=False)] = None,
    full: Annotated[bool, typer.Option("--full", help="Use all resolutions and seeds; takes several minutes.")] = False,
    pours: Annotated[
        int | None, typer.Option(min=1, help="Number of random pours in the case 'walls'.", show_default=False)
    ] = None,
    write: Annotated[
        Path | None,
        typer.Option(
            help="Folder for the page validation.md, its data and figures. Cases that are not run keep their "
            "previous results.",
            show_default=False,
        ),
    ] = None,
    list_cases: Annotated[bool, typer.Option("--list", help="List the cases and exit.")] = False,
    as_json: Json = False,
) -> None:
    """Validate the solver against theory, experiments and other solvers; each case has a criterion.

    Exit code 1 if a criterion is not met.
    """
    from orchestrator.cli import solver_validation as verb

    call(verb.physics, cases or [], full=full, pours=pours, write=write, as_json=as_json, list_cases=list_cases)


queue_commands.register(app)
vessel_command.register(app)


def main() -> None:
    """Run the command line."""
    app()
