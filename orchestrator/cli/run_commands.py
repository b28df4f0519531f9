"""Options and help texts of `decant runs …`, the catalogue of runs.

Their work is done in `catalogue_output`.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import typer

from orchestrator.catalogue.query_conditions import CONDITIONS
from orchestrator.cli.command_options import Json, call, examples

KEYWORD = inspect.Parameter.KEYWORD_ONLY

runs = typer.Typer(
    name="runs",
    rich_markup_mode="markdown",
    invoke_without_command=True,
    help="""Find runs and pours of this machine: which action was used, when, and how much it spilled.

Without a command, the newest twenty runs are listed. Every run is registered when it starts. The lists are read from
the runs' journals, so they are correct after a crash, too. `decant runs add FOLDER` registers older runs and copies.
Dates are `2030-03-01`, `2030-03` (a whole month), `'2030-03-01 14:30'` or `7d` (ago); names may contain * and ?.
""",
    epilog=examples(
        "decant runs",
        "decant runs pours --receiver beaker --since 2030-03 --until 2030-03   # actions and their spillage",
        "decant runs list --strategy D3 --since 7d",
        "decant runs show quickstart-20300301-1",
    ),
)


def _state(path: Path | None) -> Path | None:
    from orchestrator.catalogue.run_registry import use_state_directory

    if path is not None:
        use_state_directory(path)
    return path


State = Annotated[
    Path | None,
    typer.Option(
        "--state",
        callback=_state,
        is_eager=True,
        help="The state directory; default: $DECANT_STATE, or ~/.local/state/decant.",
        show_default=False,
    ),
]
Daemon = Annotated[
    bool,
    typer.Option(
        "--daemon",
        help="Query a daemon instead of this machine's catalogue: the one at $DECANT_URL, with $DECANT_TOKEN, or the "
        "one that uses the state directory.",
    ),
]
Which = Annotated[str, typer.Argument(help="A run: its folder's name, a prefix of the name, or its path.")]

_LIMIT = Annotated[int | None, typer.Option("--limit", min=1, help="Show at most this many, the newest.")]
_WORDS = Annotated[list[str] | None, typer.Argument(metavar="[WORDS]", help="Words in a run's names, tags or notes.")]
_OTHERS: dict[str, Any] = {
    "words": _WORDS,
    "run": Annotated[str | None, typer.Option("--run", help="Folder name or path of one run.")],
    "limit": _LIMIT,
}
_CONDITIONS: dict[str, Any] = {
    name: Annotated[str | None, typer.Option("--in-state" if name == "state" else f"--{name}", help=text)]
    for name, text in CONDITIONS.items()
}


def _asking(*others: str) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Make a decorator that adds the catalogue's conditions and some of `_OTHERS` as one mapping."""
    options = {name: _OTHERS[name] for name in others} | _CONDITIONS

    def taking(command: Callable[..., None]) -> Callable[..., None]:
        own = inspect.signature(command, eval_str=True).parameters
        # The state directory is an option as well, so the options have other names up to this point.
        names = {f"asked_{name}": name for name in options}

        def call_it(**given: Any) -> None:
            found = {name: given.pop(key) for key, name in names.items()}
            command(conditions={**found, "words": found.get("words") or ()}, **given)

        parameters = [
            *(inspect.Parameter(key, KEYWORD, default=None, annotation=options[name]) for key, name in names.items()),
            *(one.replace(kind=KEYWORD) for one in own.values() if one.name != "conditions"),
        ]
        call_it.__name__, call_it.__doc__ = command.__name__, command.__doc__
        call_it.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
        call_it.__annotations__ = {one.name: one.annotation for one in parameters}
        return call_it

    return taking


@runs.callback()
def newest(context: typer.Context, state: State = None, daemon: Daemon = False) -> None:
    """Run `decant runs` without a command."""
    if context.invoked_subcommand is None:
        from orchestrator.cli import catalogue_output as verb

        call(verb.list_runs, {"limit": verb.NEWEST}, daemon=daemon, as_json=False)


@runs.command(
    "list",
    epilog=examples(
        "decant runs list --receiver beaker --mode real --since 2030-03",
        "decant runs list water spring-clean   # both words, anywhere: names, vessels, tags, notes",
        "decant runs list --daemon --since 7d   # on the machine at $DECANT_URL",
    ),
)
@_asking("words", "limit")
def list_(conditions: dict[str, Any], state: State = None, daemon: Daemon = False, as_json: Json = False) -> None:
    """List runs, newest first; all given conditions must hold."""
    from orchestrator.cli import catalogue_output as verb

    call(verb.list_runs, conditions, daemon=daemon, as_json=as_json)


runs.command("search", hidden=True)(list_)


@runs.command(
    epilog=examples(
        "decant runs pours --receiver beaker --since 2030-03-01 --until 2030-03-31",
        "decant runs pours --liquid glycerol --mode real --json",
    )
)
@_asking("words", "run", "limit")
def pours(conditions: dict[str, Any], state: State = None, daemon: Daemon = False, as_json: Json = False) -> None:
    """List pours with their actions, weighed spillage and predictions."""
    from orchestrator.cli import catalogue_output as verb

    call(verb.list_pours, conditions, daemon=daemon, as_json=as_json)


@runs.command(epilog=examples("decant runs show quickstart-20300301-1"))
def show(run: Which, state: State = None, daemon: Daemon = False, as_json: Json = False) -> None:
    """Show one run: state, θ*, recommendations, pours, tags, notes, and files."""
    from orchestrator.cli import catalogue_output as verb

    call(verb.show, run, daemon=daemon, as_json=as_json)


@runs.command(
    epilog=examples("decant runs check quickstart-20300301-1", "decant runs check runs/quickstart-20300301-1")
)
def check(run: Which, state: State = None, as_json: Json = False) -> None:
    """Check a run's records: SQLite's own check, the hash chain over all entries, and the ledger of pours.

    Exit code 0: complete and unchanged, or of an older version without a hash chain. 1: damaged or incomplete.
    """
    from orchestrator.cli import catalogue_output as verb

    call(verb.check, run, as_json=as_json)


@runs.command(epilog=examples("decant runs compare quickstart-20300301-1 quickstart-20300301-2"))
def compare(
    which: Annotated[list[str], typer.Argument(help="Two or more runs.", show_default=False)],
    state: State = None,
    daemon: Daemon = False,
    as_json: Json = False,
) -> None:
    """Compare runs: the settings in which they differ, and their outcomes."""
    from orchestrator.cli import catalogue_output as verb

    call(verb.compare, which, daemon=daemon, as_json=as_json)


@runs.command(epilog=examples("decant runs tag quickstart-20300301-1 good paper", "decant runs tag RUN --remove good"))
def tag(
    run: Which,
    tags: Annotated[list[str] | None, typer.Argument(help="Tags to add.")] = None,
    remove: Annotated[list[str] | None, typer.Option(help="A tag to remove. Repeatable.")] = None,
    state: State = None,
    daemon: Daemon = False,
) -> None:
    """Add tags to a run, or remove them. They are stored in the run's folder and are copied with it."""
    from orchestrator.cli import catalogue_output as verb

    call(verb.tag, run, tags or [], remove or [], daemon=daemon)


@runs.command(epilog=examples("decant runs note quickstart-20300301-1 'the tray was wet from the first pour on'"))
def note(
    run: Which,
    text: Annotated[str, typer.Argument(help="Text of the note.")],
    state: State = None,
    daemon: Daemon = False,
) -> None:
    """Add a note to a run, with date and author. It is stored in the run's folder."""
    from orchestrator.cli import catalogue_output as verb

    call(verb.note, run, text, daemon=daemon)


@runs.command(
    epilog=examples(
        "decant runs export table/ --since 2030-03 --until 2030-03", "decant runs export table/ --format csv"
    )
)
@_asking("words", "limit")
def export(
    folder: Annotated[Path, typer.Argument(help="Folder for the files.")],
    conditions: dict[str, Any],
    formats: Annotated[list[str] | None, typer.Option("--format", help="csv or parquet; default: both.")] = None,
    state: State = None,
    daemon: Daemon = False,
    as_json: Json = False,
) -> None:
    """Export runs and pours as CSV and Parquet, with a data dictionary: `runs.*`, `pours.*` and `dictionary.csv`."""
    from orchestrator.cli import catalogue_output as verb

    call(verb.export, folder, conditions, formats, daemon=daemon, as_json=as_json)


@runs.command(epilog=examples("decant runs add runs/", "decant runs add /media/usb/runs/quickstart-20300301-1"))
def add(
    folders: Annotated[list[Path], typer.Argument(help="Folders of runs, or folders that contain runs.")],
    state: State = None,
) -> None:
    """Register runs that the catalogue lacks: from an older version, from another machine, or moved."""
    from orchestrator.cli import catalogue_output as verb

    call(verb.add, folders)


@runs.command(epilog=examples("decant runs rebuild"))
def rebuild(state: State = None) -> None:
    """Rebuild the index from the runs' journals; runs that no longer exist are removed from it."""
    from orchestrator.cli import catalogue_output as verb

    call(verb.rebuild)
