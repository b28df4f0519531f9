"""The commands `decant balance check` and `record`: commission a balance, record and explain its traffic.

A balance is named by a laboratory's file, or by its port alone on the first day. The check itself is in
`actors.balance.balance_check`, the file format of recordings in `actors.balance.line_recording`, and the explanation
of lines in `actors.balance.line_explanation`.
"""

from __future__ import annotations

import contextlib
import json
import sys
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from orchestrator.cli.console import FAILED, RefusalError, Refused, print_message

if TYPE_CHECKING:
    from actors.balance.balance_check import CheckOperator
    from actors.balance.balance_settings import BalanceEmulator, SerialBalanceSettings
    from actors.balance.line_recording import Recorder
    from actors.balance.scale_model import Load
    from actors.interfaces import DeviceCheck

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
    options: Given = None,
    record: Annotated[
        Path | None, typer.Option(help="Also record the raw traffic into this file, as 'decant balance record' does.")
    ] = None,
) -> None:
    """Check a balance before the first pour: connection, noise, drift, repeated readings, lag, linearity and vibration.

    You put loads on and take them off as the command asks; have the empty receiver and a cup of water ready and, for
    the linearity, weights of known mass. Every line shows the reading and the right value. The balance is tared,
    nothing else is changed. For a virtual laboratory the loads are simulated. Exit code 1 if a check fails.
    """
    from actors.balance.balance_check import EmulatedHands, check_balance
    from orchestrator.cli.robot_commands import print_table

    checks: list[DeviceCheck] = []
    with _settings(balance, options) as (spec, emulator), _tap(record, balance, emulator is not None) as tap:
        if emulator is None and not sys.stdin.isatty():
            raise RefusalError("the check asks for loads at a terminal, with nothing piped into it")
        hands: CheckOperator = CheckingPerson() if emulator is None else EmulatedHands(partial(_put, emulator))
        driver = _driver(spec, tap)
        try:
            for finding in check_balance(
                driver,
                hands,
                repeatability=spec.deviation,
                step=spec.step,
                time_scale=spec.time_scale,
            ):
                checks.append(finding)
                print_table([finding])
            _finish(tap, record, driver)
        finally:
            driver.close()
    failed = [c for c in checks if c.state == "fail"]
    if failed:
        raise RefusalError(f"{len(failed)} of {len(checks)} checks fail", FAILED)
    print_message("ready" if all(c.state == "ok" for c in checks) else "ready, with warnings")


def record(
    balance: Annotated[
        str | None, typer.Argument(help="Laboratory file (YAML), or the port of a balance.", metavar="BALANCE")
    ] = None,
    to: Annotated[Path | None, typer.Option(help="File to write (.jsonl); must not exist yet.")] = None,
    file: Annotated[
        Path | None,
        typer.Option(
            "--from",
            help="Record nothing; explain this recording, or any file with the lines as they came: the log of a "
            "terminal program, hexadecimal digits, printed Python bytes.",
        ),
    ] = None,
    seconds: Annotated[float, typer.Option(min=0.1, help="Duration [s].")] = 60.0,
    listen: Annotated[bool, typer.Option("--listen", help="Request nothing after connecting, only listen.")] = False,
    remarks: Annotated[str, typer.Option(help="Make and model, and what is put on it and when.")] = "",
    options: Given = None,
    virtual: Annotated[bool, typer.Option("--virtual", help="Say in the file that the balance is emulated.")] = False,
) -> None:
    """Record the raw traffic of a balance: every byte with its time. A test can replay the file through the driver.

    Put loads on and take them off during the recording. Ctrl-C ends it. The file is explained at the end, also if no
    balance is recognised: which protocol fits its lines best, what it reads, and what else came. With --from, exit
    code 1 if no protocol reads a weight. Speed and parity can't be known from the lines.
    """
    from actors.interfaces import LaboratoryError

    if file is not None:
        if balance is not None or to is not None:
            raise RefusalError("--from FILE explains a file; give it without BALANCE and --to")
        if (problem := _print_explanation(file)) is not None:
            raise RefusalError(problem, FAILED)
        return
    if balance is None or to is None:
        raise RefusalError("give the balance and a file to write: BALANCE --to FILE; or a file to explain: --from FILE")
    with (
        _settings(balance, options) as (spec, emulator),
        _tap(to, balance, virtual or emulator is not None, remarks) as tap,
    ):
        assert tap is not None, "a file is given"
        driver = _driver(spec, tap)
        try:
            try:
                print_message(driver.connect())
            except LaboratoryError:
                if tap.count and (problem := _print_explanation(to)) is not None:
                    print_message(problem)
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
        print_message(f"{to}: {tap.count} bytes; {counts}")
        if (problem := _print_explanation(to)) is not None:
            print_message(problem)


def _print_explanation(path: Path) -> str | None:
    """Print which protocol fits the lines of a file, and what it reads; return the problem if none reads a weight."""
    from actors.balance.line_explanation import explain_capture
    from actors.balance.line_recording import Capture

    with Refused(ValueError):
        text, problem = explain_capture(Capture.load(path))
    print("\n".join([f"{path}: {text[0]}", *text[1:]]))
    return problem


def _put(emulator: BalanceEmulator, load: Load) -> None:
    """Set the load of an emulated balance from now on."""
    emulator.order("put", {"times": list(load.times), "masses": list(load.masses)})


class CheckingPerson:
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
def _settings(target: str, options: list[str] | None) -> Iterator[tuple[SerialBalanceSettings, BalanceEmulator | None]]:
    """The balance's settings, and its emulator in a virtual laboratory."""
    from actors.balance.balance_settings import SerialBalanceSettings, balance_kind
    from orchestrator.cli.robot_commands import read_laboratory

    if not target.endswith((".yaml", ".yml")):
        yield _port_settings(target, options), None
        return
    if options:
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


def _port_settings(port: str, options: list[str] | None) -> SerialBalanceSettings:
    """The settings of a balance at a port, checked as those of a file are.

    Raises:
        RefusalError: a setting is invalid; lists all problems.
    """
    from actors.balance.balance_settings import SerialBalanceSettings
    from orchestrator.campaigns.yaml.section_validation import PlacedProblems, validate
    from orchestrator.campaigns.yaml.yaml_source import Document, Place, Report

    lines = [f"port: {json.dumps(port)}"]
    for text in options or ():
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

    match = driver.found
    if tap is not None and to is not None and match is not None:
        weights = LineRecording.load(to).weights(match.dialect)
        tap.add(dialect=match.dialect.name, line=str(match.line), balance=match.identity, weights=weights)
