"""The commands `decant runs …`: queries of the catalogue, printed as tables or JSON.

Everything slow is imported when a command is called, so that
`--help` starts fast.
"""

from __future__ import annotations

import contextlib
import getpass
import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, make_dataclass
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from actors.laboratory_settings import MODE_LABELS
from orchestrator.catalogue.queries import CONDITIONS
from orchestrator.cli.command_options import Json, add_command, call, examples, grouped
from orchestrator.cli.console import FAILED, RefusalError, check_output, print_json, print_message, print_note

if TYPE_CHECKING:
    from orchestrator.catalogue.catalogue import Catalogue
    from orchestrator.catalogue.control_charts import LaboratoryChart
    from orchestrator.records.run_record import Row

NEWEST = 20

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
    from orchestrator.records.run_registry import use_state_directory

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
    ),
]
Which = Annotated[
    str,
    typer.Argument(help="A run: its folder's name, a prefix of the name, or its path."),
]

_OTHERS: dict[str, Any] = {
    "words": Annotated[list[str] | None, typer.Argument(metavar="[WORDS]", help="Words in a run's names or notes.")],
    "run": Annotated[str | None, typer.Option("--run", help="Folder name or path of one run.")],
    "limit": Annotated[int | None, typer.Option("--limit", min=1, help="Show at most this many, the newest.")],
}


def _asked(*others: str) -> Any:
    """A group of options: some of `_OTHERS`, and the conditions of the catalogue. 'state' is `in_state` here."""
    options = {name: _OTHERS[name] for name in others}
    for name, text in CONDITIONS.items():
        option = "in-state" if name == "state" else name
        options[option.replace("-", "_")] = Annotated[str | None, typer.Option(f"--{option}", help=text)]
    return make_dataclass("Asked", [(name, hint, None) for name, hint in options.items()])


RunsAsked, PoursAsked, ChartsAsked = _asked("words", "limit"), _asked("words", "run", "limit"), _asked()


def _conditions(asked: Any) -> dict[str, Any]:
    return {"state" if name == "in_state" else name: value for name, value in asdict(asked).items()}


def _command(*lines: str, name: str | None = None) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Make a decorator that adds a command, with examples for its help."""

    def register(work: Callable[..., None]) -> Callable[..., None]:
        add_command(runs, work, *lines, name=name)
        return work

    return register


@runs.callback()
def newest(context: typer.Context, state: State = None) -> None:
    """Run `decant runs` without a command."""
    if context.invoked_subcommand is None:
        call(list_runs, limit=NEWEST)


@_command(
    "decant runs list --receiver beaker --mode real --since 2030-03",
    "decant runs list water spring-clean   # both words, anywhere: names, vessels, notes",
    name="list",
)
@grouped
def list_runs(asked: RunsAsked, state: State = None, as_json: Json = False) -> None:  # type: ignore[valid-type]
    """List runs, newest first; all given conditions must hold."""
    from orchestrator.reports.console_view import print_table

    with _catalogue() as catalogue, _refusing():
        listed = catalogue.runs(_conditions(asked))
    if as_json:
        print_json({"runs": listed})
        return
    if not listed:
        print_note("no run; `decant runs add FOLDER` enters runs that the catalogue doesn't know")
        return
    rows = [
        {
            "run": run["run"],
            "begun": _date(run["begun"]),
            "mode": _mode(run["mode"]),
            "state": run["state"],
            "verdict": run["verdict"] or "",
            "strategies": ", ".join(run["strategy"]),
            "liquid": ", ".join(run["liquid"]),
            "from": ", ".join(run["pourer"]),
            "into": ", ".join(run["receiver"]),
            "pours": _count_of_pours(run),
            "best loss": "  ".join(
                f"{name} {_loss(best['best_loss'], best['loss'])}" for name, best in run["recommended"].items()
            ),
        }
        for run in listed
    ]
    print_table(rows, right=("pours",))


@_command(
    "decant runs pours --receiver beaker --since 2030-03-01 --until 2030-03-31",
    "decant runs pours --liquid glycerol --mode real --json",
)
@grouped
def pours(asked: PoursAsked, state: State = None, as_json: Json = False) -> None:  # type: ignore[valid-type]
    """List pours with their actions, weighed spillage and predictions."""
    with _catalogue() as catalogue, _refusing():
        listed = catalogue.pours(_conditions(asked))
    if as_json:
        print_json({"pours": listed})
    elif listed:
        _print_pours(listed)
    else:
        print_note("no pour that this holds for")


@_command(
    "decant runs chart",
    "decant runs chart north --mode real --since 2030-03 --png north.png",
    name="chart",
)
@grouped
def chart_command(
    asked: ChartsAsked,  # type: ignore[valid-type]
    laboratory: Annotated[str | None, typer.Argument(help="Name of a laboratory, if there are several.")] = None,
    png: Annotated[Path | None, typer.Option(help="Also draw the charts of one laboratory to this file.")] = None,
    state: State = None,
) -> None:
    """Chart what every run measures, day by day, against limits from the laboratory's own history.

    Quantities: error of predictions and doses, tilt at which a dose flows, film, masses that do not close, empty
    pourer, zero and scatter of the balance, time of a pour. Limits come from up to 30 days in control. After a repair,
    `decant runs note RUN 'new limits: another balance'` lets the charts of the run's laboratory begin again.
    """
    from orchestrator.reports.console_view import print_table
    from orchestrator.reports.control_chart_figure import draw_charts
    from orchestrator.reports.figure_style import save

    check_output(png, "--png", ".png")
    with _catalogue() as catalogue, _refusing():
        charts = catalogue.charts(_conditions(asked))
    if laboratory is not None and laboratory not in (laboratories := {chart.laboratory for chart in charts}):
        raise RefusalError(
            f"{laboratory}: no weighed pour of this laboratory; known: {', '.join(sorted(laboratories)) or 'none'}"
        )
    charts = [chart for chart in charts if laboratory in (None, chart.laboratory)]
    benches = list(dict.fromkeys((chart.laboratory, chart.mode) for chart in charts))
    if png is not None and len(benches) > 1:
        raise RefusalError(
            f"--png: these are {', '.join(f'{name} ({mode})' for name, mode in benches)}; name one of them"
        )
    if not charts:
        print_note("no weighed pour that this holds for")
    for name, mode in benches:
        shown = [chart for chart in charts if (chart.laboratory, chart.mode) == (name, mode)]
        if png is not None:
            print_note(f"picture: {save(draw_charts(shown), png)}")
        print_table([_chart_row(chart) for chart in shown], title=f"{name}  {_mode(mode)}", right=("days", "last"))
        for chart in shown:
            if chart.text:
                print(chart.text)


@_command("decant runs show quickstart-20300301-1")
def show(run: Which, state: State = None, as_json: Json = False) -> None:
    """Show one run: state, θ*, recommendations, pours, notes, and files."""
    from orchestrator.learning.strategy import plural

    with _catalogue() as catalogue, _refusing():
        entry = catalogue.run(run)
    if as_json:
        print_json(entry)
        return
    lines = {
        "run": f"{entry['run']}  {_mode(entry['mode'])}",
        "state": f"{entry['state']}{': ' + entry['reason'] if entry['reason'] else ''}",
        "verdict": entry["reached"].get("text", ""),
        "begun": f"{_date(entry['begun'])}, ended {_date(entry['ended'])}",
        "campaign": f"{entry['campaign']}, seed {entry['seed']}, laboratory {entry['laboratory']}",
        "strategies": ", ".join(entry["strategy"]),
        "liquid": "{}, from {} into {}".format(*(", ".join(entry[key]) for key in ("liquid", "pourer", "receiver"))),
        "work": f"{plural(entry['simulations'], 'simulation')}, pours: {_count_of_pours(entry)}, "
        f"{entry['spilled_g'] or 0:.1f} g spilled",
        "θ*": ", ".join(f"{key} {value:.4g}" for key, value in entry["theta"].items()),
        "test |Δ|": _percent(entry["test_discrepancy"]),
        **{
            f"best for {receiver}": f"{_action(b['action'])}: {_loss(b['predicted_loss'], b['loss'])} expected, "
            f"{_loss(b['best_loss'], b['loss'])} the best poured"
            for receiver, b in entry["recommended"].items()
        },
        "folder": entry["path"],
    }
    width = max(map(len, lines))
    for key, text in lines.items():
        if text:
            print(f"{key:<{width}}  {text}")
    for note in entry["notes"]:
        print(f"{'note':<{width}}  {_date(note['time'])} {note['by']}: {note['text']}")
    if entry["list_of_pours"]:
        print()
        _print_pours(entry["list_of_pours"], of_one_run=True)
    _print_mixtures(Path(entry["path"]))


def _print_mixtures(folder: Path) -> None:
    """The cups of a run that poured mixtures, if it is published."""
    from orchestrator.reports.mixture_report import mixture_lines

    with contextlib.suppress(OSError, ValueError, LookupError):
        print("\n".join(["", *mixture_lines(folder)]))


@_command("decant runs known", "decant runs known beaker")
def known(
    cup: Annotated[str | None, typer.Argument(help="Name of a vessel: the pourer or a receiver.")] = None,
    state: State = None,
) -> None:
    """Show what calibrations have found, by run: mean ± standard deviation from the pours of the run alone."""
    from orchestrator.learning.calibration.campaign_memory import RememberedParameter
    from orchestrator.reports.console_view import print_table

    with _catalogue() as catalogue, _refusing():
        posteriors = [p for p in catalogue.posteriors() if cup in (None, p.pourer, *p.receivers)]
        ages = catalogue.posterior_ages(posteriors)
    if not posteriors:
        print_note(f"no posterior{'' if cup is None else f' about {cup}'}; a finished calibration with C4 has one")
        return
    rows = [
        {
            "run": p.posterior,
            "made": _date(ages[p.posterior].made)[:10] if p.posterior in ages else "",
            "laboratory": f"{p.laboratory}, arm {p.arm}",
            "mode": _mode(p.mode),
            "liquid": p.liquid.name,
            "from": p.pourer,
            "into": ", ".join(p.receivers),
            "pours": str(p.pours),
            "known": "; ".join(str(RememberedParameter(name, *told, ())) for name, told in p.estimates.items()),
        }
        for p in posteriors
    ]
    print_table(rows, right=["pours"])
    for name, age in ages.items():
        if age.text:
            print(f"{name}: stale: {age.text}")


@_command("decant runs posterior quickstart-20300301-1 > beaker.yaml")
def posterior(run: Which, state: State = None) -> None:
    """Print the posterior of a run as a YAML file with units, for `decant runs add` elsewhere, or for `prior`."""
    from orchestrator.catalogue.known_posteriors import posterior_text

    with _catalogue() as catalogue, _refusing():
        print(posterior_text(catalogue.posterior(run)), end="")


@_command("decant runs check quickstart-20300301-1", "decant runs check runs/quickstart-20300301-1")
def check(run: Which, state: State = None, as_json: Json = False) -> None:
    """Check a run's records: SQLite's own check, the hash chain over all entries, and the ledger of pours.

    Exit code 0: complete and unchanged. 1: damaged or incomplete. 2: there is no run, or one of another version.
    """
    from orchestrator.records.journal import JOURNAL_NAME
    from orchestrator.records.journal_check import check_journal

    folder = _folder(run)
    with _refusing():
        report = check_journal(folder / JOURNAL_NAME)
    if as_json:
        print_json(asdict(report))
    else:
        print(f"{folder}: {report.verdict}")
        for pour in report.pours:
            print(f"  {pour}")
    if report.problems:
        raise RefusalError(f"{folder}: {len(report.problems)} problem(s) found", FAILED)


def _folder(run: str) -> Path:
    from orchestrator.records.journal import JOURNAL_NAME
    from orchestrator.records.journal_check import has_begun

    folder = Path(run)
    if not folder.is_dir():
        with _catalogue() as catalogue, _refusing():
            return Path(catalogue.run(run)["path"])
    if not has_begun(folder / JOURNAL_NAME):
        raise RefusalError(f"{folder}: there is no run in this folder")
    return folder


@_command(
    "decant runs correct quickstart-20300301-1 3 'weighed 3.2 0.4'",
    "decant runs correct RUN 3 lost --stage deployment:bowl",
)
def correct(
    run: Which,
    number: Annotated[int, typer.Argument(help="Number of the pour within its stage.")],
    answer: Annotated[
        str, typer.Argument(metavar="OUTCOME", help="'weighed SPILLED RETAINED [LOADED]' in grams, or 'lost'.")
    ],
    stage: Annotated[str | None, typer.Option(help="Stage of the pour, if several have one of this number.")] = None,
    state: State = None,
) -> None:
    """Correct the outcome of a pour that was told wrongly, in a run that is not running now.

    The first outcome stays in the journal, with your name. When the run is resumed, it learns from the corrected one.
    """
    from orchestrator.runs.added_pours import correct_pour

    folder = _folder(run)
    learned = correct_pour(folder, number, stage=stage, answer=answer, by=getpass.getuser())
    later = "the run learns from it when it is resumed" if learned else "its stage has ended, and its result stays"
    print(f"{folder}: pour {number} is corrected; {later}")


@_command("decant runs note quickstart-20300301-1 'the tray was wet from the first pour on'")
def note(
    run: Which,
    text: Annotated[str, typer.Argument(help="Text of the note.")],
    state: State = None,
) -> None:
    """Add a note to a run, with date and author. It is in the run's folder; `decant runs list` finds its words."""
    with _catalogue() as catalogue, _refusing():
        entry = catalogue.note(run, text)
    print(f"{entry['run']}: {len(entry['notes'])} note{'s' * (len(entry['notes']) > 1)}")


@_command(
    "decant runs add runs/",
    "decant runs add /media/usb/runs/quickstart-20300301-1",
    "decant runs add beaker.yaml   # a posterior from another machine",
)
def add(
    folders: Annotated[
        list[Path], typer.Argument(help="Folders of runs, folders that contain runs, or files of posteriors.")
    ],
    state: State = None,
) -> None:
    """Register runs that the catalogue lacks: from another machine, or moved. Files add their posteriors only."""
    from orchestrator.records.run_registry import enter, runs_below

    runs_found: list[Path] = []
    posteriors = [path for path in folders if path.suffix.lower() in (".yaml", ".yml", ".json")]
    if posteriors:
        _import_posteriors(posteriors)
        folders = [path for path in folders if path not in posteriors]
        if not folders:
            return
    for folder in folders:
        if not folder.is_dir():
            raise RefusalError(f"{folder}: is not a folder")
        below = list(runs_below(folder.absolute()))
        if not below:
            raise RefusalError(f"{folder}: there is no run in it (no journal.sqlite, at any depth)")
        runs_found += below
    with _refusing():
        enter(runs_found)
    with _catalogue():
        pass
    print(f"{len(runs_found)} run{'s' * (len(runs_found) > 1)} entered, or known already")


def _import_posteriors(paths: Sequence[Path]) -> None:
    from orchestrator.campaigns.file_loading import load_posterior_file
    from orchestrator.catalogue.known_posteriors import import_posterior

    read = [load_posterior_file(path) for path in paths]
    with _refusing():
        for p in read:
            import_posterior(p)
    print(f"{len(read)} posterior{'s' * (len(read) > 1)} entered: {', '.join(p.posterior for p in read)}")


# -- formatting ------------------------------------------------------------------------------------------------------


def _mode(text: str | None) -> str:
    """Return 'REAL' or 'VIRTUAL', so that the kinds of benches can't be confused."""
    return MODE_LABELS.get(text, "VIRTUAL") if text else ""


_OPEN = "has begun and has no outcome: under way, or UNKNOWN"


def _print_pours(pours: Sequence[Row], *, of_one_run: bool = False) -> None:
    """Print a table of pours; values that are equal in all pours are printed once, above it."""
    from orchestrator.catalogue.run_reading import ACTION_COLUMNS
    from orchestrator.reports.console_view import print_table

    used = {name: [pour[name] for pour in pours] for name in ACTION_COLUMNS}
    used = {name: values for name, values in used.items() if any(value is not None for value in values)}
    equal = {name for name, values in used.items() if len(values) > 1 and len({_number(v, 6) for v in values}) == 1}
    units = _units()
    rows = [
        {
            "": _date(pour["time"]),
            "run": "" if of_one_run else pour["run"],
            "mode": _mode(pour["mode"]),
            "by": pour["strategy"] if pour["purpose"] != "calibration" else f"{pour['strategy']} (calibration)",
            "into": pour["receiver"],
            "pour": str(pour["number"]),
            **{f"{_words(name)} [{units[name]}]": _number(pour[name], 4) for name in used if name not in equal},
            "spilled [g]": "" if pour["spilled_g"] is None else f"{pour['spilled_g']:.1f}",
            "spilled / poured": _percent(pour["spillage"]),
            "loss": _loss(pour["loss"], pour["loss_name"]),
            "expected": _loss(pour["predicted_loss"], pour["loss_name"], pour["predicted_deviation"]),
            "remark": _OPEN if pour["outcome"] == "open" else pour["reason"] or "",
        }
        for pour in pours
    ]
    if equal:
        print(f"in all of them: {_action({name: pours[0][name] for name in used if name in equal})}")
    print_table(rows, right=[name for name in rows[0] if name not in ("", "run", "mode", "by", "into", "remark")])
    weighed = [pour for pour in pours if pour["spillage"] is not None]
    if weighed:
        mean = sum(pour["spillage"] for pour in weighed) / len(weighed)
        least = min(weighed, key=lambda pour: float(pour["spillage"]))
        total = f"{len(pours)} pour{'s' * (len(pours) != 1)}, {len(weighed)} weighed"
        print(
            f"{total}: {_percent(mean)} spilled in the mean, at least {_percent(least['spillage'])} "
            f"(pour {least['number']} of {least['stage']}, {least['run']})"
        )


def _chart_row(chart: LaboratoryChart) -> dict[str, str]:
    last, lasting = chart.points[-1], chart.lasting
    value, limits = f"{last.value:.4g}", "too few days"
    if last.low is not None and last.high is not None:
        places = max(1 - math.floor(math.log10(last.high - last.low)), 0) if last.high > last.low else 3
        value, limits = f"{last.value:.{places}f}", f"{last.low:.{places}f} … {last.high:.{places}f}"
    off = f"off since {_date(lasting.begun)[:10]}: {lasting.deviations:+.1f} standard deviations" if lasting else ""
    return {
        "quantity": f"{chart.label} [{chart.unit}]",
        "days": str(len({_date(point.time)[:10] for point in chart.points})),
        "last": value,
        "limits": limits,
        "state": off or ("" if last.low is None else "in control"),
        "earlier violations": ", ".join(_date(v.begun)[:10] for v in chart.violations if v.ended is not None),
    }


def _loss(value: float | None, name: str | None, deviation: float | None = None) -> str:
    """Format the loss of a pour or a prediction with its unit: '3.4 %', '3.4 ± 1.2 %'."""
    from orchestrator.reports.loss_units import named_loss_unit

    return "" if value is None else named_loss_unit(str(name)).text(value, deviation)


def _percent(value: float | None) -> str:
    """Format a fraction in percent; '' if it is unknown."""
    return "" if value is None else f"{100 * value:.2f} %"


def _count_of_pours(run: Row) -> str:
    """Format the number of pours: '6', or '6 + 1 without a weight'."""
    lost = (run["failed_pours"] or 0) + (run["open_pours"] or 0)
    return f"{run['pours'] or 0}" + (f" + {lost} without a weight" if lost else "")


def _action(values: Mapping[str, float | None]) -> str:
    """Format an action: 'angular velocity 41.2 deg/s, x offset 112 mm'."""
    units = _units()
    present = ((name, value) for name, value in values.items() if value is not None)
    return ", ".join(f"{_words(name)} {value:.4g} {units.get(name, '')}" for name, value in present)


def _units() -> dict[str, str]:
    from orchestrator.catalogue.run_reading import POURS

    return {column.name: column.unit for column in POURS}


def _words(name: str) -> str:
    suffixes = ("_deg_s2", "_deg_s", "_deg", "_mm", "_s")
    return name.removesuffix(next((s for s in suffixes if name.endswith(s)), "")).replace("_", " ")


def _number(value: float | None, digits: int) -> str:
    return "" if value is None else f"{value:.{digits}g}"


def _date(seconds: float | None) -> str:
    """Format a time in this machine's time zone."""
    return "" if seconds is None else datetime.fromtimestamp(seconds).strftime("%Y-%m-%d %H:%M")


# -- access to the catalogue -----------------------------------------------------------------------------------------


@contextlib.contextmanager
def _catalogue() -> Iterator[Catalogue]:
    """Open the catalogue and update it; problems with unreadable runs are printed at the end."""
    from orchestrator.catalogue.catalogue import Catalogue

    with _refusing():
        begin = time.monotonic()

        def progress(number: int, count: int) -> None:
            if time.monotonic() - begin > 2.0 and (number % 20 == 0 or number == count):
                print_note(f"reading runs: {number} of {count}")

        with Catalogue() as catalogue:
            if catalogue.warning:
                print_message(f"note: {catalogue.warning}")
            refreshed = catalogue.refresh(progress)
            yield catalogue
    for problem in refreshed.problems:
        print_message(f"note: {problem}")
    if refreshed.missing:
        print_note(
            f"note: the folder{'s' * (refreshed.missing > 1)} of {refreshed.missing} known run"
            f"{'s are' if refreshed.missing > 1 else ' is'} gone, and no longer listed; after a move: `decant runs add`"
        )


@contextlib.contextmanager
def _refusing() -> Iterator[None]:
    from orchestrator.learning.run_errors import RunError

    try:
        yield
    except RunError as error:
        raise RefusalError(str(error)) from None
    except OSError as error:
        raise RefusalError(f"{error.filename or ''}: {error.strerror or error}".lstrip(": ")) from None
