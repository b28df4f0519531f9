"""Arguments and options that several commands share. `command` turns a function with such parameters into a command."""

from __future__ import annotations

import functools
import inspect
import os
from collections.abc import Callable
from dataclasses import is_dataclass
from pathlib import Path
from typing import Annotated, Any

import typer

from orchestrator.cli.console import INTERRUPTED, RefusalError, fail, set_quiet
from sim_engine.errors import DecantError

Campaign = Annotated[Path, typer.Argument(help="Campaign file (YAML).", metavar="CAMPAIGN")]
Json = Annotated[bool, typer.Option("--json", help="Print the result as one line of JSON, last on stdout.")]
Resume = Annotated[bool, typer.Option("--resume", help="Continue the newest unfinished run of this campaign.")]
RunId = Annotated[str | None, typer.Option("--run", help="With --resume: name of the run's folder.")]
Answer = Annotated[
    str | None,
    typer.Option(
        help="With --resume: the outcome of the interrupted pour: 'lost', 'weighed 3.2 0.4' (g spilled, g retained), "
        "or on the virtual bench 'repeat'."
    ),
]
Laboratory = Annotated[Path, typer.Argument(help="Laboratory file (YAML).", metavar="LABORATORY")]
OtherLaboratory = Annotated[
    Path | None,
    typer.Option("--laboratory", help="Laboratory file (YAML) instead of the campaign's."),
]
Seed = Annotated[
    int | None,
    # The limit equals the schema's, whose module takes too long to import for `--help`.
    typer.Option(min=0, max=2**63 - 1, help="Seed, instead of the campaign's."),
]
Assignments = Annotated[
    list[str] | None,
    typer.Option("--set", help="Value of an action: angular_velocity=40 (deg/s), x_offset='90 mm'. Repeatable."),
]
Thetas = Annotated[
    int | None,
    typer.Option(
        min=0,
        max=50,
        help="Number of posterior draws of θ in --parameters to predict with; 0: θ* alone. By default as many as "
        "seeds, if the file has a posterior.",
    ),
]
SceneName = Annotated[
    str | None,
    typer.Option("--scene", help="'calibration', 'transfer' or a receiver's name; default: the first receiver."),
]
EnableMotion = Annotated[
    bool,
    typer.Option(
        "--enable-motion",
        help="Enable motion of the hardware for this run only: shows what will move, requires the laboratory's name.",
    ),
]
InProcess = Annotated[
    bool, typer.Option("--in-process", help="Run everything in one process, without Ray: slower, for debugging.")
]
Live = Annotated[
    bool,
    typer.Option(
        "--live",
        help="Serve a live view for browsers during the run and print its address. It does not slow the run down.",
    ),
]
LiveAt = Annotated[
    str | None,
    typer.Option(
        "--live-at",
        metavar="ADDRESS[:PORT]",
        help="Address of the live view: '0.0.0.0' for other machines too (without a password), optionally with a "
        "port. Default: this machine only, port 9090 or the next free one.",
    ),
]
Parameters = Annotated[Path | None, typer.Option(help="θ: theta.json of a calibration, or a YAML or JSON file.")]
Receiver = Annotated[
    Path | None,
    typer.Option(help="Vessel file (YAML) instead of the campaign's receiver."),
]
RunFolder = Annotated[Path, typer.Argument(help="Folder of a run, or its name in runs/.", metavar="RUN")]
_QUIET = inspect.Parameter(
    "quiet",
    inspect.Parameter.KEYWORD_ONLY,
    default=False,
    annotation=Annotated[
        bool,
        typer.Option(
            "--quiet",
            "-q",
            callback=set_quiet,
            help="Print only results, questions, warnings and errors: no progress, no notes.",
        ),
    ],
)


def examples(*commands: str) -> str:
    """Format the examples at the end of a command's help."""
    return "Examples:\n\n" + "\n\n".join(f"`{command}`" for command in commands)


def run_folder(run: Path) -> Path:
    """The folder of a run, which may be given by its name in runs/."""
    return run if run.exists() or len(run.parts) > 1 else Path("runs") / run


def _expanded(path: Path) -> Path:
    from sim_engine.settings.model import in_home

    try:
        return Path(in_home(str(path)))
    except ValueError as error:
        raise RefusalError(str(error)) from None


def _in_home(value: Any) -> Any:
    """Expand ~ in the paths of an argument: a shell does not expand it in `--state=~/lab`."""
    if isinstance(value, Path):
        return _expanded(value)
    if isinstance(value, list | tuple):
        return type(value)(_in_home(item) for item in value)
    return value


def call(work: Callable[..., None], /, *args: Any, **kwargs: Any) -> None:
    """Run a command; the text of an error is printed, and its exit code is used. `~` in paths is the home directory."""
    try:
        if os.environ.get("DECANT_ENGINE"):
            from sim_engine.engine_package import engine_name

            engine_name()  # an unknown one is refused before anything starts
        work(*map(_in_home, args), **{name: _in_home(value) for name, value in kwargs.items()})
    except DecantError as error:
        fail(error)
    except KeyboardInterrupt:
        fail(RefusalError("interrupted before anything had begun", INTERRUPTED))


def grouped(work: Callable[..., None]) -> Callable[..., None]:
    """Replace each parameter whose type is a dataclass by its fields: options that several commands share."""
    declared = inspect.signature(work, eval_str=True)
    groups: dict[str, Any] = {p.name: p.annotation for p in declared.parameters.values() if is_dataclass(p.annotation)}
    fields = {name: inspect.signature(group, eval_str=True).parameters for name, group in groups.items()}
    flat = [p for each in declared.parameters.values() for p in fields.get(each.name, {each.name: each}).values()]
    signature = declared.replace(
        parameters=[each.replace(kind=inspect.Parameter.POSITIONAL_OR_KEYWORD) for each in flat]
    )

    @functools.wraps(work)
    def run(*args: Any, **kwargs: Any) -> None:
        bound = signature.bind(*args, **kwargs)
        bound.apply_defaults()
        arguments = bound.arguments
        values = {
            name: group(**{field: arguments.pop(field) for field in fields[name]}) for name, group in groups.items()
        }
        work(**arguments, **values)

    run.__signature__ = signature  # type: ignore[attr-defined]
    run.__annotations__ = {p.name: p.annotation for p in flat}
    return run


def command(work: Callable[..., None], *, quiet: bool = False) -> Callable[..., None]:
    """Make a command of a function whose parameters declare its arguments and options.

    The command does what `call` does.

    Args:
        work: the function.
        quiet: whether the command has the option `--quiet`. The option's callback applies it; the function doesn't
            get it.
    """

    @functools.wraps(work)
    def run(*args: Any, **kwargs: Any) -> None:
        kwargs.pop(_QUIET.name, None)
        call(work, *args, **kwargs)

    if quiet:
        signature = inspect.signature(work, eval_str=True)
        parameters = [*signature.parameters.values(), _QUIET]
        run.__signature__ = signature.replace(parameters=parameters)  # type: ignore[attr-defined]
        run.__annotations__ = {p.name: p.annotation for p in parameters}
    return run


def add_group(app: typer.Typer, name: str, text: str, *shown: str, quiet: bool = False) -> functools.partial[None]:
    """Add a group of commands to the application, or find the one of this name; returns `add_command` for it.

    Args:
        app: the application.
        name: name of the group.
        text: its help text.
        shown: examples: how its commands are used together.
        quiet: whether its commands have the option `--quiet`.
    """
    groups = (group.typer_instance for group in app.registered_groups)
    group = next((each for each in groups if each is not None and each.info.name == name), None)
    if group is None:
        group = typer.Typer(
            name=name, no_args_is_help=True, rich_markup_mode="markdown", help=text, epilog=examples(*shown)
        )
        app.add_typer(group)
    return functools.partial(add_command, group, quiet=quiet)


def add_command(
    app: typer.Typer,
    work: Callable[..., None],
    *shown: str,
    name: str | None = None,
    unknown_options: bool = False,
    quiet: bool = False,
) -> None:
    """Add a command to the application or to a group.

    Args:
        app: the application or the group.
        work: the function; its docstring is the help text.
        shown: examples.
        name: name of the command; None: that of the function.
        unknown_options: whether unknown options are taken as words instead of being refused.
        quiet: whether it has the option `--quiet`.
    """
    settings = {"ignore_unknown_options": unknown_options}
    add = app.command(name or work.__name__, context_settings=settings, epilog=examples(*shown))
    add(command(work, quiet=quiet))
