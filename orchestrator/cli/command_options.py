"""Arguments and options that several verbs share, and how a verb is called."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import typer

from orchestrator.cli.console import BAD_INPUT, INTERRUPTED, RefusalError, fail, hush

Campaign = Annotated[Path, typer.Argument(help="Campaign file (YAML).", metavar="CAMPAIGN", show_default=False)]
Json = Annotated[bool, typer.Option("--json", help="Print the result as one line of JSON, last on stdout.")]
Resume = Annotated[bool, typer.Option("--resume", help="Go on with the newest unfinished run of this campaign.")]
RunId = Annotated[str | None, typer.Option("--run", help="With --resume: the run, by its folder's name.")]
Answer = Annotated[
    str | None,
    typer.Option(
        help="With --resume: what came of the pour that was under way: 'lost', 'weighed 3.2 0.4' (g spilled, g "
        "retained), or on the virtual bench 'repeat'. Or, where a D3 asks how to go on: 'go on' or "
        "'stop'.",
        show_default=False,
    ),
]
Laboratory = Annotated[Path, typer.Argument(help="Laboratory file (YAML).", metavar="LABORATORY", show_default=False)]
OtherLaboratory = Annotated[
    Path | None,
    typer.Option("--laboratory", help="Laboratory file (YAML) in place of the campaign's.", show_default=False),
]
Quiet = Annotated[
    bool,
    typer.Option(
        "--quiet",
        "-q",
        callback=hush,
        help="Only results, questions, warnings of a run, and errors: no progress, no notes.",
    ),
]
Seed = Annotated[
    int | None,
    # The largest is the schema's, whose module takes longer to import than `--help` may.
    typer.Option(min=0, max=2**63 - 1, help="In place of the campaign's.", show_default=False),
]
Assignments = Annotated[
    list[str] | None,
    typer.Option("--set", help="An action's value: angular_velocity=40 (deg/s), x_offset='90 mm'. Repeat."),
]
Thetas = Annotated[
    int | None,
    typer.Option(
        min=0,
        max=50,
        help="Predict with so many θ of the posterior in --parameters, in turn; 0: with θ* alone. As many as seeds if "
        "not given and the file has a posterior.",
        show_default=False,
    ),
]
SceneName = Annotated[
    str | None,
    typer.Option("--scene", help="'calibration', 'transfer' or a receiver's name; the first receiver if not given."),
]
Arm = Annotated[
    bool,
    typer.Option(
        "--arm",
        help="Arm hardware for this run only: shows what will move, and asks for the laboratory's name.",
    ),
]
InProcess = Annotated[
    bool, typer.Option("--in-process", help="Everything in one process, without Ray: slower, for debugging.")
]
Live = Annotated[
    bool,
    typer.Option(
        "--live",
        help="Serve a live view for browsers while it runs: the address is printed. It can't slow anything down.",
    ),
]
LiveAt = Annotated[
    str | None,
    typer.Option(
        "--live-at",
        metavar="ADDRESS[:PORT]",
        help="Where to serve it: '0.0.0.0' for other machines too (there is no password), with a port of your choice. "
        "Otherwise this machine only, port 9090 or the next free one.",
        show_default=False,
    ),
]
Parameters = Annotated[
    Path | None, typer.Option(help="θ: a theta.json of a calibration, or your own YAML or JSON.", show_default=False)
]
Receiver = Annotated[
    Path | None, typer.Option(help="Vessel file (YAML) in place of the campaign's receiver.", show_default=False)
]


def examples(*commands: str) -> str:
    """The end of a command's help: what one may type."""
    return "Examples:\n\n" + "\n\n".join(f"`{command}`" for command in commands)


def given(options: dict[str, Any], *left_out: str) -> dict[str, Any]:
    """A verb's options by name, for the function that does its work.

    Args:
        options: `locals()` at the verb's beginning.
        left_out: what is not for that function; `--quiet` has had its effect already.
    """
    return {name: value for name, value in options.items() if name not in ("quiet", *left_out)}


def _expanded(path: Path) -> Path:
    from sim_engine.settings.model import in_home

    try:
        return Path(in_home(str(path)))
    except ValueError as error:
        raise RefusalError(str(error), BAD_INPUT) from None


def _in_home(value: Any) -> Any:
    """An argument with its paths expanded: a shell leaves `--state=~/lab` as it is."""
    if isinstance(value, Path):
        return _expanded(value)
    if isinstance(value, list | tuple):
        return type(value)(_in_home(item) for item in value)
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        paths = {field.name: getattr(value, field.name) for field in dataclasses.fields(value)}
        return dataclasses.replace(value, **{name: _in_home(item) for name, item in paths.items()})
    return value


def call(verb: Callable[..., None], *args: Any, **kwargs: Any) -> None:
    """Run a verb; a refusal is printed, and ends with its exit code. `~` in paths is the home directory."""
    try:
        verb(*map(_in_home, args), **{name: _in_home(value) for name, value in kwargs.items()})
    except RefusalError as refusal:
        fail(refusal)
    except KeyboardInterrupt:
        fail(RefusalError("interrupted before anything had begun", INTERRUPTED))
