"""The commands `decant balance check`, `record` and `explain`: commission a balance, record and explain its traffic.

A balance is named by a laboratory's file, or by its port alone on the first day. The check itself is in
`actors.balance.balance_check`, the file format of recordings in `actors.balance.line_recording`, and the comparison of
dialects in `actors.balance.line_explanation`.
"""

from __future__ import annotations

import contextlib
import json
import sys
import time
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from orchestrator.cli.command_options import Json
from orchestrator.cli.console import FAILED, RefusalError, Refused, print_json, print_message

if TYPE_CHECKING:
    from actors.balance.balance_check import CheckOperator
    from actors.balance.balance_settings import BalanceEmulator, SerialBalanceSettings
    from actors.balance.line_explanation import DialectFit
    from actors.balance.line_recording import Capture, Recorder
    from actors.balance.scale_model import Load
    from actors.interfaces import DeviceCheck
    from orchestrator.cli.command_results import ExplainedDialectOutput

CHECK_SCALE = 4.0
"""Bench seconds per second of the clock while a virtual balance is checked: its lag must stay longer than this
machine's."""

Balance = Annotated[
    str,
    typer.Argument(
        help="Laboratory file (YAML), or the port of a balance: /dev/serial/by-id/…, or host:port.", metavar="BALANCE"
    ),
]
Given = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        help="With a port: a setting of the balance, as in a laboratory file: dialect=kcp, baud=9600, dtr=false. "
        "Repeatable; unless given, dialect and line settings are detected.",
    ),
]


def check(
    balance: Balance,
    given: Given = None,
    record: Annotated[
        Path | None, typer.Option(help="Also record the raw traffic into this file, as 'decant balance record' does.")
    ] = None,
    as_json: Json = False,
) -> None:
    """Check a balance before the first pour: connection, noise, drift, repeated readings, lag, linearity and vibration.

    You put loads on and take them off as the command asks; have the empty receiver and a cup of water ready and, for
    the linearity, weights of known mass. Every line shows the reading and the right value. The balance is tared,
    nothing else is changed. For a virtual laboratory the loads are simulated. Exit code 1 if a check fails.
    """
    from actors.balance.balance_check import EmulatedHands, check_balance
    from orchestrator.cli.robot_commands import print_table

    checks: list[DeviceCheck] = []
    with _settings(balance, given) as (spec, emulator), _tap(record, balance, emulator is not None) as tap:
        if emulator is None and not sys.stdin.isatty():
            raise RefusalError("the check asks for loads at a terminal, with nothing piped into it")
        hands: CheckOperator = Person() if emulator is None else EmulatedHands(partial(_put, emulator))
        driver = _driver(spec, tap)
        try:
            for found in check_balance(
                driver,
                hands,
                repeatability=spec.deviation,
                step=spec.step,
                time_scale=spec.time_scale,
            ):
                checks.append(found)
                if not as_json:
                    print_table([found])
            _finish(tap, record, driver)
        finally:
            driver.close()
    failed = [one for one in checks if one.state == "fail"]
    if as_json:
        from orchestrator.cli.command_results import BalanceCheckOutput

        print_json(BalanceCheckOutput(balance=balance, ready=not failed, checks=checks))
    if failed:
        raise RefusalError(f"{len(failed)} of {len(checks)} checks fail", FAILED)
    print_message("ready" if all(one.state == "ok" for one in checks) else "ready, with warnings")


def record(
    balance: Balance,
    to: Annotated[Path, typer.Option(help="File to write (.jsonl); must not exist yet.")],
    seconds: Annotated[float, typer.Option(min=0.1, help="Duration [s].")] = 60.0,
    listen: Annotated[bool, typer.Option("--listen", help="Request nothing after connecting, only listen.")] = False,
    remarks: Annotated[str, typer.Option(help="Make and model, and what is put on it and when.")] = "",
    given: Given = None,
    virtual: Annotated[bool, typer.Option("--virtual", help="Say in the file that the balance is emulated.")] = False,
) -> None:
    """Record the raw traffic of a balance: every byte with its time. A test can replay the file through the driver.

    Put loads on and take them off during the recording. Ctrl-C ends it. If no balance is recognised, the file holds
    what came meanwhile; 'decant balance explain' shows what it is.
    """
    from actors.interfaces import LaboratoryError

    with (
        _settings(balance, given) as (spec, emulator),
        _tap(to, balance, virtual or emulator is not None, remarks) as tap,
    ):
        driver = _driver(spec, tap)
        try:
            try:
                print_message(driver.connect())
            except LaboratoryError:
                if tap is not None and tap.count:
                    print_message(f"{to} holds what was sent and received; 'decant balance explain {to}' shows it")
                raise
            end = time.monotonic() + seconds
            with contextlib.suppress(KeyboardInterrupt):
                while (left := end - time.monotonic()) > 0.0:
                    if listen:
                        driver.listen(min(left, 1.0))
                        continue
                    seen = driver.read()
                    print(f"\r{seen.shown or seen.status:<24} {seen.status:<12}", end="", file=sys.stderr, flush=True)
                    time.sleep(min(0.05, left))
            print_message("")
            _finish(tap, to, driver)
        finally:
            driver.close()
        counts = ", ".join(f"{count} {name}" for name, count in driver.statistics().items())
        print_message(f"{to}: {0 if tap is None else tap.count} bytes; {counts}")


def explain(
    file: Annotated[
        Path,
        typer.Argument(
            help="Recording of 'decant balance record', or any file with the lines as they came: the log of a terminal "
            "program, hexadecimal digits, printed Python bytes.",
            metavar="FILE",
        ),
    ],
    as_json: Json = False,
) -> None:
    """Explain the lines of a balance: which protocols understand them, what each reads, what each refuses and why.

    Needs no balance. Exit code 1 if no protocol reads a weight, 2 if the file can't be read. Speed and parity can't be
    known from the lines.
    """
    from actors.balance.line_explanation import best_fits, explain_lines, is_text
    from actors.balance.line_recording import Capture

    with Refused(ValueError):
        capture = Capture.load(file)
    fits = explain_lines(capture.lines)
    best = best_fits(fits)
    if as_json:
        from orchestrator.cli.command_results import BalanceExplainOutput

        print_json(
            BalanceExplainOutput(
                file=file,
                lines=len(capture.lines),
                recorded=dict(capture.about),
                notes=list(capture.notes),
                best=[fit.dialect.name for fit in best],
                dialects=[_explained(fit) for fit in fits],
            )
        )
    else:
        _print_fits(file, capture, fits)
    if not capture.lines:
        raise RefusalError("the balance sent nothing: is it switched on, and is it the right port and cable?", FAILED)
    if not best:
        text = "no dialect reads a weight in these lines. "
        if not is_text(b"".join(capture.lines)):
            text += "They are not text: speed or parity differ; set 'baud' and 'format' as in the balance's menu"
        else:
            text += "Set the balance to print the weight in g with its unit, or choose another protocol in its menu"
            if not capture.about:
                text += ". A program that cuts blanks at the ends of lines off damages them"
        raise RefusalError(text, FAILED)
    if not as_json:
        _print_settings(capture, best)


_MOST = 4
"""Weights and refused lines that are printed for a dialect; --json has all."""


def _print_fits(file: Path, capture: Capture, fits: Sequence[DialectFit]) -> None:
    """Print a table of the dialects, and the lines that each does not read as a weight."""
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    different = len(set(capture.lines))
    print(f"{file}: number of lines {len(capture.lines)}, of different lines {different}")
    for note in capture.notes:
        print(f"note: {note}")
    table = Table(box=None, pad_edge=False, header_style="", padding=(0, 2, 0, 0))
    for title in ("dialect", "understood", "weights", "stable weights as read"):
        table.add_column(title)
    for fit in fits:
        more = f", … ({len(fit.reads)})" if len(fit.reads) > _MOST else ""
        cells = (fit.dialect.name, str(fit.understood), str(fit.weights), ", ".join(fit.reads[:_MOST]) + more)
        table.add_row(*(Text(cell) for cell in cells))
    console = Console(highlight=False)
    (console if console.is_terminal else Console(highlight=False, width=1000)).print(table)
    for fit in fits:
        for line in _not_weights(fit):
            print(f"{fit.dialect.name}: {line}")


def _not_weights(fit: DialectFit) -> list[str]:
    """What a dialect does not read as a weight, and why."""
    from actors.balance.line_explanation import shown_bytes

    if not fit.understood and fit.refused:
        line, (reason, _) = next(iter(fit.refused.items()))
        return [f"refuses all {fit.total} lines, the first {shown_bytes(line)}: {reason}"]
    found = [f"{count} × {what}" for what, count in fit.states.items()]
    found += [f"{count} × {what}, not a weight" for what, count in fit.others.items()]
    refused = [f"refuses {count} × {shown_bytes(line)}: {reason}" for line, (reason, count) in fit.refused.items()]
    more = [f"refuses {len(refused) - _MOST} other lines (--json shows all)"] if len(refused) > _MOST else []
    return found + refused[:_MOST] + more


def _print_settings(capture: Capture, best: Sequence[DialectFit]) -> None:
    """Print the settings that fit best."""
    fit = best[0]
    names = " or ".join(one.dialect.name for one in best)
    alike = "; 'dialect: auto' tells them apart by their replies" if len(best) > 1 else ""
    print(f"best fit: {names} ({fit.weights} weights in {fit.total} lines){alike}")
    line = capture.about.get("line")
    print(
        f"  dialect: {fit.dialect.name}"
        + (f"   # recorded with {line}" if line else "   # baud and format: see its menu")
    )
    if len(fit.marks) > 1:
        print("  weight: net   # or gross; it sends both")


def _explained(fit: DialectFit) -> ExplainedDialectOutput:
    from actors.balance.line_explanation import shown_bytes
    from orchestrator.cli.command_results import ExplainedDialectOutput, RefusedLinesOutput

    return ExplainedDialectOutput(
        dialect=fit.dialect.name,
        title=fit.dialect.title,
        understood=fit.understood,
        weights=fit.weights,
        reads=list(fit.reads),
        marks=sorted(fit.marks),
        states=dict(fit.states),
        others=dict(fit.others),
        refused=[
            RefusedLinesOutput(line=shown_bytes(line), count=count, reason=reason)
            for line, (reason, count) in fit.refused.items()
        ],
    )


def _put(emulator: BalanceEmulator, load: Load) -> None:
    """Set the load of an emulated balance from now on."""
    emulator.order("put", {"times": list(load.times), "masses": list(load.masses)})


class Person:
    """`actors.balance.balance_check.CheckOperator` at this terminal."""

    def empty(self) -> None:
        """See `CheckOperator.empty`."""
        _ask("Take everything off the balance but its tray, and let go. Then press Enter: ")

    def announce(self) -> None:
        """See `CheckOperator.announce`."""
        _ask("Take the empty receiver in your hand. Press Enter, wait for 'now', put it on in one movement, let go: ")

    def put(self) -> None:
        """See `CheckOperator.put`."""
        print_message("now")

    def rise(self, mass: float, seconds: float) -> bool:
        """See `CheckOperator.rise`."""
        text = (
            f"Leave the receiver on. Take {1e3 * mass:.0f} g of water or more in a cup. Press Enter, pour it slowly "
            f"and steadily into the receiver, for {seconds:g} s; 'skip' without water: "
        )
        return _ask(text) != "skip"

    def reference(self) -> float | None:
        """See `CheckOperator.reference`."""
        from actors.balance.readings import typed_weight

        while True:
            text = _ask(
                "Put on one weight of known mass, nothing else. Type its mass, as '200 g'; Enter: no (more) such: "
            )
            if not text:
                return None
            try:
                return typed_weight(text).mass
            except ValueError as error:
                print_message(str(error))

    def move(self) -> bool:
        """See `CheckOperator.move`."""
        return (
            _ask("Let the arm move, without liquid, and press Enter while it moves; 'skip' without an arm: ") != "skip"
        )


def _ask(prompt: str) -> str:
    from orchestrator.cli.motion_control import typed_line

    try:
        return typed_line(prompt).strip()
    except EOFError:
        raise RefusalError("the terminal was closed", FAILED) from None


@contextlib.contextmanager
def _settings(target: str, given: list[str] | None) -> Iterator[tuple[SerialBalanceSettings, BalanceEmulator | None]]:
    """The balance's settings, and its emulator in a virtual laboratory."""
    from actors.balance.balance_settings import SerialBalanceSettings, balance_kind
    from orchestrator.cli.robot_commands import read_laboratory

    if not target.endswith((".yaml", ".yml")):
        yield _port_settings(target, given), None
        return
    if given:
        raise RefusalError("--set belongs to a port; a laboratory file has the settings")
    spec = read_laboratory(Path(target)).balance
    if not isinstance(spec, SerialBalanceSettings) or spec.typed:
        raise RefusalError(f"{target}: it has no balance on a serial line or over TCP")
    if spec.virtual is None:
        yield spec, None
        return
    emulator = balance_kind(spec.with_values(time_scale=CHECK_SCALE)).start_emulator()
    assert emulator is not None
    try:
        print_message("virtual: no balance; one is started for this, and its loads are simulated")
        assert isinstance(emulator.balance, SerialBalanceSettings)
        yield emulator.balance, emulator
    finally:
        emulator.close()


def _port_settings(port: str, given: list[str] | None) -> SerialBalanceSettings:
    """The settings of a balance at a port, checked as those of a file are.

    Raises:
        RefusalError: a setting is invalid; lists all problems.
    """
    from actors.balance.balance_settings import SerialBalanceSettings
    from orchestrator.campaigns.yaml.section_validation import PlacedProblems, validate
    from orchestrator.campaigns.yaml.yaml_source import Document, Place, Report

    lines = [f"port: {json.dumps(port)}"]
    for text in given or ():
        key, equals, value = text.partition("=")
        if not equals:
            raise RefusalError(f"--set {text}: should be a key and a value, as dialect=kcp")
        lines.append(f"{key.strip()}: {value.strip()}")
    report = Report()
    place = Place(Document.parse("\n".join(lines), Path("--set")))
    settings = validate(SerialBalanceSettings, place, report)
    if settings is not None:
        settings.check_laboratory(PlacedProblems(place, report), mode="hardware")
    report.raise_if_any()
    assert settings is not None, "settings without problems are settings"
    return settings


@contextlib.contextmanager
def _tap(to: Path | None, target: str, virtual: bool, remarks: str = "") -> Iterator[Recorder | None]:
    """The recorder of a new file; None without a file."""
    from actors.balance.line_recording import Recorder

    if to is None:
        yield None
        return
    about = {"port": target, "date": time.strftime("%Y-%m-%d"), "remarks": remarks}
    with Refused(OSError, at=f"--to {to}: "), to.open("x", encoding="utf-8") as file:
        yield Recorder(file, "virtual" if virtual else "hardware", about)


def _driver(spec: SerialBalanceSettings, tap: Recorder | None) -> Any:
    """The driver of the settings; its module is not imported here."""
    from actors.balance.balance_settings import balance_kind

    driver, arguments = balance_kind(spec).driver("balance")
    return driver(*arguments, tap)


def _finish(tap: Recorder | None, to: Path | None, driver: Any) -> None:
    """Add to the recording what was detected and the weights as they are understood today."""
    from actors.balance.line_recording import LineRecording

    found = driver.found
    if tap is not None and to is not None and found is not None:
        weights = LineRecording.load(to).weights(found.dialect)
        tap.add(dialect=found.dialect.name, line=str(found.line), balance=found.identity, weights=weights)
