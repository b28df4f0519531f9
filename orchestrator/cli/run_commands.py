"""`decant runs …`, as the command line has it: the catalogue of runs."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import typer

from orchestrator.catalogue.queries import CONDITIONS
from orchestrator.cli.command_options import Json, call, examples

KEYWORD = inspect.Parameter.KEYWORD_ONLY

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
        help="The state directory; $DECANT_STATE, or ~/.local/state/decant, if not given.",
        show_default=False,
    ),
]
Daemon = Annotated[
    bool,
    typer.Option(
        "--daemon",
        help="Ask the daemon in place of this machine's catalogue: the one at $DECANT_URL, with $DECANT_TOKEN, or the "
        "one that has the state directory.",
    ),
]
Which = Annotated[str, typer.Argument(help="A run: its folder's name, the beginning of it, or its path.")]

_LIMIT = Annotated[int | None, typer.Option("--limit", min=1, help="The newest so many.")]
_WORDS = Annotated[
    list[str] | None, typer.Argument(metavar="[WORDS]", help="Words that stand in a run's names, tags or notes.")
]
_OTHERS: dict[str, Any] = {
    "words": _WORDS,
    "run": Annotated[str | None, typer.Option("--run", help="One run, by its folder's name or path.")],
    "limit": _LIMIT,
}
_CONDITIONS: dict[str, Any] = {
    name: Annotated[str | None, typer.Option("--in-state" if name == "state" else f"--{name}", help=text)]
    for name, text in CONDITIONS.items()
}


def _asking(*others: str) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """A command that takes all conditions of the catalogue, and some of `_OTHERS`: they reach it as one mapping."""
    options = {name: _OTHERS[name] for name in others} | _CONDITIONS

    def taking(command: Callable[..., None]) -> Callable[..., None]:
        own = inspect.signature(command, eval_str=True).parameters
        # The state directory is an option as well: a run's state goes by another name until here.
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
    """What `decant runs` does without a verb."""
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
    """List runs, the newest first; every condition that is given must hold."""
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
    """List pours: which action was used, what it spilled, and what had been expected."""
    from orchestrator.cli import catalogue_output as verb

    call(verb.list_pours, conditions, daemon=daemon, as_json=as_json)


@runs.command(epilog=examples("decant runs show quickstart-20300301-1"))
def show(run: Which, state: State = None, daemon: Daemon = False, as_json: Json = False) -> None:
    """Show one run: where it stands, θ*, what it recommends, its pours, tags, notes, and files."""
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
    which: Annotated[list[str], typer.Argument(help="Two runs or more.", show_default=False)],
    state: State = None,
    daemon: Daemon = False,
    as_json: Json = False,
) -> None:
    """Set runs side by side: the settings in which they differ, and what they came to."""
    from orchestrator.cli import catalogue_output as verb

    call(verb.compare, which, daemon=daemon, as_json=as_json)


@runs.command(epilog=examples("decant runs tag quickstart-20300301-1 good paper", "decant runs tag RUN --remove good"))
def tag(
    run: Which,
    tags: Annotated[list[str] | None, typer.Argument(help="Tags to put on it.")] = None,
    remove: Annotated[list[str] | None, typer.Option(help="A tag to take off. Repeat.")] = None,
    state: State = None,
    daemon: Daemon = False,
) -> None:
    """Put tags on a run, or take them off. They are kept in the run's folder, and go wherever it goes."""
    from orchestrator.cli import catalogue_output as verb

    call(verb.tag, run, tags or [], remove or [], daemon=daemon)


@runs.command(epilog=examples("decant runs note quickstart-20300301-1 'the tray was wet from the first pour on'"))
def note(
    run: Which,
    text: Annotated[str, typer.Argument(help="What is to be remembered.")],
    state: State = None,
    daemon: Daemon = False,
) -> None:
    """Write a note about a run, with date and author. It is kept in the run's folder."""
    from orchestrator.cli import catalogue_output as verb

    call(verb.note, run, text, daemon=daemon)


@runs.command(
    epilog=examples(
        "decant runs export table/ --since 2030-03 --until 2030-03", "decant runs export table/ --format csv"
    )
)
@_asking("words", "limit")
def export(
    folder: Annotated[Path, typer.Argument(help="Where the files are written.")],
    conditions: dict[str, Any],
    formats: Annotated[list[str] | None, typer.Option("--format", help="csv or parquet; both if not given.")] = None,
    state: State = None,
    daemon: Daemon = False,
    as_json: Json = False,
) -> None:
    """Write runs and pours as CSV and Parquet, with a data dictionary: runs.*, pours.*, dictionary.csv."""
    from orchestrator.cli import catalogue_output as verb

    call(verb.export, folder, conditions, formats, daemon=daemon, as_json=as_json)


@runs.command(epilog=examples("decant runs add runs/", "decant runs add /media/usb/runs/quickstart-20300301-1"))
def add(
    folders: Annotated[list[Path], typer.Argument(help="Folders of runs, or folders with runs in them.")],
    state: State = None,
) -> None:
    """Enter runs that the catalogue doesn't know: made by an older version, on another machine, or moved."""
    from orchestrator.cli import catalogue_output as verb

    call(verb.add, folders)


@runs.command(epilog=examples("decant runs rebuild"))
def rebuild(state: State = None) -> None:
    """Make the index anew from the runs' journals; runs that are gone are forgotten."""
    from orchestrator.cli import catalogue_output as verb

    call(verb.rebuild)
