"""The command `decant doctor`: checks whether a bench is ready to pour, and advises how to solve each problem.

The checks read the arm, its safety settings, the balance and the installed packages. Nothing moves; the balance is
tared only on request.
"""

from __future__ import annotations

import dataclasses
import getpass
import time
from pathlib import Path
from typing import TYPE_CHECKING

from actors.arm.arm_settings import ArmDiagnostics, SafetyRecord
from actors.balance.balance_settings import balance_diagnostics
from actors.interfaces import DeviceCheck, LaboratoryError
from actors.laboratory import check_bench_packages, check_laboratory, reached
from orchestrator.cli.console import BAD_INPUT, FAILED, RefusalError, Refused, print_json, say
from orchestrator.installed_plugins import broken
from orchestrator.runs.safety_approval import SafetyRecordError, read_record, record_path, write_record

if TYPE_CHECKING:
    from actors.laboratory_settings import LaboratorySettings


_MARKS = {"ok": ("ok", "green"), "warn": ("warn", "yellow"), "fail": ("FAIL", "bold red")}


def doctor(path: Path, *, accept_safety: bool, tare: bool, as_json: bool) -> None:
    """Check everything that a pour needs, and print advice. Nothing moves.

    Args:
        path: laboratory file.
        accept_safety: record the controller's safety settings as accepted.
        tare: also tare the balance.
        as_json: print one line of JSON instead of the table.

    Raises:
        RefusalError: a check fails (exit code 1), or the file can't be used (2).
    """
    spec = read_laboratory(path)
    if spec.arm is None:
        raise without_arm(
            path, spec, "looked at are an arm (whether it answers, its safety settings, tool and payload) and a balance"
        )
    virtual = spec.mode != "hardware"
    say(
        f"laboratory {spec.name}, {spec.mode}"
        + (": no robot, no balance; both are started for this" if virtual else "")
    )
    try:
        record = None if virtual else read_record(path)
    except SafetyRecordError as error:
        if not accept_safety:
            raise RefusalError(str(error), BAD_INPUT) from None
        record = None
    with Refused(LaboratoryError):
        check_bench_packages(spec)
    with Refused(LaboratoryError, code=FAILED), reached(spec) as ready:
        assert ready.arm is not None
        look = ready.arm.diagnostics()
        if accept_safety and not virtual:
            record = _accept(path, look)
        checks = look.checks(record, accept=f"decant doctor {path} --accept-safety", virtual=virtual)
        checks += balance_diagnostics(ready.balance, tare=tare)
    checks += _packages(spec)
    checks += [DeviceCheck("plug-in", "warn", str(one), f"mend or remove {one.package}") for one in broken()]
    failed = [check for check in checks if check.state == "fail"]
    if as_json:
        table = [dataclasses.asdict(check) for check in checks]
        print_json({"laboratory": spec.name, "mode": spec.mode, "ready": not failed, "checks": table})
    else:
        print_table(checks)
    if failed:
        raise RefusalError(f"{len(failed)} of {len(checks)} checks fail; nothing should move before they are mended")
    say("ready" if all(check.state == "ok" for check in checks) else "ready, with warnings")


def _packages(spec: LaboratorySettings) -> list[DeviceCheck]:
    """Check the packages that a run needs, with the run's own check."""
    try:
        check_laboratory(spec.with_values(ray=None), need_bench=True)
    except LaboratoryError as error:
        return [DeviceCheck("packages", "fail", str(error), "install them into the environment that Decant runs in")]
    return []


def without_arm(path: Path, spec: LaboratorySettings, asked: str) -> RefusalError:
    """Return the refusal for a laboratory without an arm, with a suggestion.

    Args:
        asked: the command's purpose, as part of the message.
    """
    has = "its bench is simulated" if spec.bench is not None else "it has no bench"
    return RefusalError(
        f"{path}: laboratory {spec.name} has no 'arm', {has}: {asked}. Name a laboratory that has one, for example "
        "laboratories/virtual.yaml",
        BAD_INPUT,
    )


def read_laboratory(path: Path) -> LaboratorySettings:
    """Load a laboratory's file.

    Raises:
        RefusalError: the file is invalid; lists all problems, exit code 2.
    """
    from orchestrator.config.file_loading import load_laboratory
    from orchestrator.config.yaml.yaml_errors import ConfigError

    with Refused(ConfigError):
        return load_laboratory(path)


def print_table(checks: list[DeviceCheck]) -> None:
    """Print the checks on stdout, each followed by its advice."""
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    table = Table(box=None, pad_edge=False, show_header=False, padding=(0, 2, 0, 0))
    for check in checks:
        mark, style = _MARKS[check.state]
        said = Text(check.found)
        if check.advice:
            said.append(f"\n→ {check.advice}", style="bold" if check.state == "fail" else "")
        table.add_row(Text(mark, style=style), Text(check.name), said)
    console = Console(highlight=False)
    (console if console.is_terminal else Console(highlight=False, width=1000)).print(table)


def _accept(path: Path, look: ArmDiagnostics) -> SafetyRecord:
    """Record the current safety settings as accepted.

    Raises:
        RefusalError: the controller does not report them, or the record can't be written.
    """
    if not look.checksum or not look.serial:
        raise RefusalError(
            "the controller doesn't tell its safety checksum and serial number, so nothing can be accepted; run "
            f"'decant doctor {path}' without --accept-safety to see why",
            FAILED,
        )
    record = SafetyRecord(
        checksum=look.checksum,
        serial=look.serial,
        model=look.model,
        software=look.software,
        date=time.strftime("%Y-%m-%dT%H:%M:%S%z"),
        accepted_by=getpass.getuser(),
    )
    try:
        written = write_record(path, record)
    except OSError as error:
        raise RefusalError(f"{record_path(path)}: can't be written: {error.strerror}", BAD_INPUT) from None
    say(
        f"safety checksum {record.checksum} of robot {record.serial} is accepted by {record.accepted_by}: {written}\n"
        "Compare it with the teach pendant, have a second person read the safety settings, and commit the file."
    )
    return record
