"""`decant runs …`, as the command line has it: the catalogue of runs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from orchestrator.commands.options import Json, call, examples

runs = typer.Typer(
    name="runs",
    rich_markup_mode="markdown",
    invoke_without_command=True,
    help="""Find runs and pours of this machine, whoever made them: which action, when, and what it spilled.

Without a verb: the newest twenty. Every run is entered when it begins; what is shown is read from its journal, so that
it is right after a crash, too. `decant runs add FOLDER` enters older ones, and those that were copied from elsewhere.
Dates are `2030-03-01`, `2030-03` (a whole month), `'2030-03-01 14:30'` or `7d` (ago); names may hold * and ?.
""",
    epilog=examples(
        "decant runs",
        "decant runs pours --receiver beaker --since 2030-03 --until 2030-03   # which actions, and what they spilled",
        "decant runs list --strategy D3 --since 7d",
        "decant runs show quickstart-20300301-1",
    ),
)


def _state(path: Path | None) -> Path | None:
    from orchestrator.state_directory import use_state_directory

    if path is not None:
        use_state_directory(path)
    return path


State = Annotated[
    Path | None,
    typer.Option(
        "--state",
        callback=_state,
        is_eager=True,
        help="The state directory; $DECANT_STATE, or ~/.local/state/decant, if not given.",
        show_default=False,
    ),
]
Words = Annotated[list[str] | None, typer.Argument(help="Words that stand in a run's names, tags or notes.")]
Since = Annotated[str | None, typer.Option(help="Begun (of a pour: weighed) at that date or later.")]
Until = Annotated[str | None, typer.Option(help="… at that date or before; a day or month counts to its end.")]
Pourer = Annotated[str | None, typer.Option(help="Vessel that was poured from, by name.")]
Receiver = Annotated[str | None, typer.Option(help="Vessel that was poured into, by name.")]
Liquid = Annotated[str | None, typer.Option(help="What was poured, by name.")]
Strategy = Annotated[str | None, typer.Option(help="C1 to C4, D1 to D3, or one of a package.")]
CampaignName = Annotated[str | None, typer.Option("--campaign", help="Name of the campaign.")]
Mode = Annotated[str | None, typer.Option(help="'virtual' or 'real'.")]
RunState = Annotated[str | None, typer.Option("--in-state", help="finished, paused, failed, unknown, interrupted …")]
Tag = Annotated[str | None, typer.Option(help="A tag of the run.")]
OneRun = Annotated[str | None, typer.Option("--run", help="One run, by its folder's name or path.")]
Which = Annotated[str, typer.Argument(help="A run: its folder's name, the beginning of it, or its path.")]
Limit = Annotated[int | None, typer.Option(min=1, help="The newest so many.")]


def _conditions(given: dict[str, Any]) -> dict[str, Any]:
    """The conditions among a verb's options. `--state` is the state directory, `--in-state` a condition."""
    left_out = ("folder", "state", "formats", "as_json", "in_state")
    state = {"state": given["in_state"]} if "in_state" in given else {}
    return {name: value for name, value in given.items() if name not in left_out} | state


@runs.callback()
def newest(context: typer.Context, state: State = None) -> None:
    """What `decant runs` does without a verb."""
    if context.invoked_subcommand is None:
        from orchestrator.commands import runs as verb

        call(verb.list_runs, {"limit": verb.NEWEST}, as_json=False)


@runs.command(
    "list",
    epilog=examples(
        "decant runs list --receiver beaker --mode real --since 2030-03",
        "decant runs list water spring-clean   # both words, anywhere: names, vessels, tags, notes",
    ),
)
def list_(
    words: Words = None,
    since: Since = None,
    until: Until = None,
    campaign: CampaignName = None,
    pourer: Pourer = None,
    receiver: Receiver = None,
    liquid: Liquid = None,
    strategy: Strategy = None,
    mode: Mode = None,
    in_state: RunState = None,
    tag: Tag = None,
    limit: Limit = None,
    state: State = None,
    as_json: Json = False,
) -> None:
    """List runs, the newest first; every condition that is given must hold."""
    conditions = _conditions(locals())
    from orchestrator.commands import runs as verb

    call(verb.list_runs, conditions, as_json=as_json)


runs.command("search", hidden=True)(list_)


@runs.command(
    epilog=examples(
        "decant runs pours --receiver beaker --since 2030-03-01 --until 2030-03-31",
        "decant runs pours --liquid glycerol --mode real --json",
    )
)
def pours(
    words: Words = None,
    since: Since = None,
    until: Until = None,
    run: OneRun = None,
    campaign: CampaignName = None,
    pourer: Pourer = None,
    receiver: Receiver = None,
    liquid: Liquid = None,
    strategy: Strategy = None,
    mode: Mode = None,
    tag: Tag = None,
    limit: Limit = None,
    state: State = None,
    as_json: Json = False,
) -> None:
    """List pours: which action was used, what it spilled, and what had been expected."""
    conditions = _conditions(locals())
    from orchestrator.commands import runs as verb

    call(verb.list_pours, conditions, as_json=as_json)


@runs.command(epilog=examples("decant runs show quickstart-20300301-1"))
def show(run: Which, state: State = None, as_json: Json = False) -> None:
    """Show one run: where it stands, θ*, what it recommends, its pours, tags, notes, and files."""
    from orchestrator.commands import runs as verb

    call(verb.show, run, as_json=as_json)


@runs.command(epilog=examples("decant runs compare quickstart-20300301-1 quickstart-20300301-2"))
def compare(
    which: Annotated[list[str], typer.Argument(help="Two runs or more.", show_default=False)],
    state: State = None,
    as_json: Json = False,
) -> None:
    """Set runs side by side: the settings in which they differ, and what they came to."""
    from orchestrator.commands import runs as verb

    call(verb.compare, which, as_json=as_json)


@runs.command(epilog=examples("decant runs tag quickstart-20300301-1 good paper", "decant runs tag RUN --remove good"))
def tag(
    run: Which,
    tags: Annotated[list[str] | None, typer.Argument(help="Tags to put on it.")] = None,
    remove: Annotated[list[str] | None, typer.Option(help="A tag to take off. Repeat.")] = None,
    state: State = None,
) -> None:
    """Put tags on a run, or take them off. They are kept in the run's folder, and go wherever it goes."""
    from orchestrator.commands import runs as verb

    call(verb.tag, run, tags or [], remove or [])


@runs.command(epilog=examples("decant runs note quickstart-20300301-1 'the tray was wet from the first pour on'"))
def note(
    run: Which, text: Annotated[str, typer.Argument(help="What is to be remembered.")], state: State = None
) -> None:
    """Write a note about a run, with date and author. It is kept in the run's folder."""
    from orchestrator.commands import runs as verb

    call(verb.note, run, text)


@runs.command(
    epilog=examples(
        "decant runs export table/ --since 2030-03 --until 2030-03", "decant runs export table/ --format csv"
    )
)
def export(
    folder: Annotated[Path, typer.Argument(help="Where the files are written.")],
    since: Since = None,
    until: Until = None,
    campaign: CampaignName = None,
    receiver: Receiver = None,
    mode: Mode = None,
    tag: Tag = None,
    formats: Annotated[list[str] | None, typer.Option("--format", help="csv or parquet; both if not given.")] = None,
    state: State = None,
    as_json: Json = False,
) -> None:
    """Write runs and pours as CSV and Parquet, with a data dictionary: runs.*, pours.*, dictionary.csv."""
    conditions = _conditions(locals())
    from orchestrator.commands import runs as verb

    call(verb.export, folder, conditions, formats, as_json=as_json)


@runs.command(epilog=examples("decant runs add runs/", "decant runs add /media/usb/runs/quickstart-20300301-1"))
def add(
    folders: Annotated[list[Path], typer.Argument(help="Folders of runs, or folders with runs in them.")],
    state: State = None,
) -> None:
    """Enter runs that the catalogue doesn't know: made by an older version, on another machine, or moved."""
    from orchestrator.commands import runs as verb

    call(verb.add, folders)


@runs.command(epilog=examples("decant runs rebuild"))
def rebuild(state: State = None) -> None:
    """Make the index anew from the runs' journals; runs that are gone are forgotten."""
    from orchestrator.commands import runs as verb

    call(verb.rebuild)
