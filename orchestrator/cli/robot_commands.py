"""The commands `decant robot …`: check a laboratory, move its arm by small steps.

- `check` checks whether a bench is ready to pour, and advises how to solve each problem. Nothing moves; the balance is
  tared only on request.
- `jog` moves the arm by typed steps, `home` brings it home; the session itself is in `motion_control`.
- `teach` writes the arm's pose into the laboratory file as a place; `try` moves to one and back.
"""

from __future__ import annotations

import contextlib
import dataclasses
import getpass
import json
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from orchestrator.cli.command_options import EnableMotion, Laboratory
from orchestrator.cli.console import FAILED, RefusalError, Refused, print_message, print_note

if TYPE_CHECKING:
    from actors.arm.arm_interface import Arm
    from actors.arm.arm_settings import ArmDiagnostics, ArmSettings, SafetyRecord
    from actors.arm_geometry import Pose
    from actors.interfaces import DeviceCheck
    from actors.laboratory_settings import LaboratorySettings
    from actors.places import PlaceSettings, RackSettings

_MARKS = {"ok": ("ok", "green"), "warn": ("warn", "yellow"), "fail": ("FAIL", "bold red")}


def check(
    laboratory: Laboratory,
    accept_safety: Annotated[
        bool,
        typer.Option(
            "--accept-safety",
            help="Record the controller's current safety settings, by their checksum, as read and accepted: "
            "NAME.safety.json next to the laboratory file. Without such a record nothing is poured.",
        ),
    ] = False,
    tare: Annotated[
        bool, typer.Option("--tare", help="Also tare the balance as a test: the load on it then reads zero.")
    ] = False,
    record_to: Annotated[
        Path | None,
        typer.Option(
            "--record",
            help="Also write what the controller sent into this new file (.json), for the key 'calibration_file'.",
        ),
    ] = None,
) -> None:
    """Check everything that a pour needs, and print advice: network, controller, safety settings, balance.

    Nothing moves, nothing flows, and no setting is changed. For a virtual laboratory, controller and balance are
    started for the check. Refill pump and spill sensor are connected where the laboratory has them. Exit code 1
    if a check fails.
    """
    from actors.interfaces import LaboratoryError
    from actors.laboratory import check_bench_packages
    from orchestrator.runs.bench_check import check_bench
    from orchestrator.runs.motion_approval import SafetyRecordError, read_record

    spec = read_laboratory(laboratory)
    if spec.arm is None:
        raise without_arm(
            laboratory,
            spec,
            "looked at are an arm (whether it answers, its safety settings, tool and payload) and a balance",
        )
    virtual = spec.mode != "hardware"
    print_message(
        f"laboratory {spec.name}, {spec.mode}"
        + (": no robot, no balance; both are started for this" if virtual else "")
    )
    try:
        record = None if virtual else read_record(laboratory)
    except SafetyRecordError:
        if not accept_safety:
            raise
        record = None
    with Refused(LaboratoryError):
        check_bench_packages(spec)

    def read(look: ArmDiagnostics) -> SafetyRecord | None:
        accepted = _accept(laboratory, look) if accept_safety and not virtual else record
        if record_to is not None:
            with Refused(OSError, at=f"--record {record_to}: "):
                _write_readout(record_to, laboratory, look, accepted, virtual=virtual)
        return accepted

    report = check_bench(spec, laboratory, record, tare=tare, read=read)
    print_table(report.checks)
    if report.failed:
        count = f"{len(report.failed)} of {len(report.checks)}"
        raise RefusalError(f"{count} checks fail; nothing should move before they are fixed", FAILED)
    print_message("ready" if all(check.state == "ok" for check in report.checks) else "ready, with warnings")


def _write_readout(
    path: Path, laboratory: Path, look: ArmDiagnostics, record: SafetyRecord | None, *, virtual: bool
) -> None:
    """Write the readout of a controller, with the laboratory's text, into a new file.

    Raises:
        RefusalError: this kind of arm offers no readout.
        OSError: a file can't be read or written.
    """
    if not (readout := look.recorded()):
        raise RefusalError("the driver of this arm has no readout that could be recorded")
    data = {
        "decant_robot_check": 1,
        "source": "virtual" if virtual else "hardware",
        "date": time.strftime("%Y-%m-%d"),
        "laboratory": laboratory.read_text(encoding="utf-8"),
        "accepted": None if record is None else dataclasses.asdict(record),
        "readout": readout,
    }
    with path.open("x", encoding="utf-8") as file:
        json.dump(data, file, indent=1, ensure_ascii=False)


def without_arm(path: Path, spec: LaboratorySettings, purpose: str) -> RefusalError:
    """Return the refusal for a laboratory without an arm, with a suggestion.

    Args:
        purpose: the command's purpose, as part of the message.
    """
    has = "its bench is simulated" if spec.bench is not None else "it has no bench"
    return RefusalError(
        f"{path}: laboratory {spec.name} has no 'arm', {has}: {purpose}. Name a laboratory that has one, for example "
        "laboratories/virtual.yaml"
    )


def read_laboratory(path: Path) -> LaboratorySettings:
    """Load a laboratory's file.

    Raises:
        ConfigError: the file is invalid; lists all problems.
    """
    from orchestrator.campaigns.file_loading import load_laboratory

    return load_laboratory(path)


def print_table(checks: Sequence[DeviceCheck]) -> None:
    """Print the checks on stdout, each followed by its advice."""
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    table = Table(box=None, pad_edge=False, show_header=False, padding=(0, 2, 0, 0))
    for check in checks:
        mark, style = _MARKS[check.state]
        text = Text(check.found)
        if check.advice:
            text.append(f"\n→ {check.advice}", style="bold" if check.state == "fail" else "")
        table.add_row(Text(mark, style=style), Text(check.name), text)
    console = Console(highlight=False)
    (console if console.is_terminal else Console(highlight=False, width=1000)).print(table)


def _accept(path: Path, look: ArmDiagnostics) -> SafetyRecord:
    """Record the current safety settings as accepted.

    Raises:
        RefusalError: the controller does not report them, or the record can't be written.
    """
    from actors.arm.arm_settings import SafetyRecord
    from orchestrator.runs.motion_approval import record_path, write_record

    if not look.checksum or not look.serial:
        raise RefusalError(
            "the controller does not report its safety checksum and serial number, so nothing can be accepted; run "
            f"'decant robot check {path}' without --accept-safety to see why",
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
        raise RefusalError(f"{record_path(path)}: can't be written: {error.strerror}") from None
    print_message(
        f"safety checksum {record.checksum} of robot {record.serial} is accepted by {record.accepted_by}: {written}\n"
        "Compare it with the teach pendant, have a second person read the safety settings, and commit the file."
    )
    return record


def jog(laboratory: Laboratory, enable_motion: EnableMotion = False) -> None:
    """Move the arm by small, slow steps that are typed one by one, or bring it home.

    'j5 +2' turns joint 5 by 2 deg, 'z -5' moves the tool by 5 mm, 'home' goes home. The first step along an axis is
    confirmed with Enter; Ctrl-C stops the arm.
    """
    from orchestrator.cli.motion_control import Jogging, typed_line

    with _session(
        laboratory, "jog", "one at a time, as typed: at most 10 deg at 5 deg/s, or 50 mm at 20 mm/s", enable_motion
    ) as (driver, _):
        Jogging(driver, typed_line).run()


def home(laboratory: Laboratory, enable_motion: EnableMotion = False) -> None:
    """Move the arm slowly to the home configuration of the laboratory file.

    All joints move by small steps of at most 10 deg at 5 deg/s, in nearly a straight line in joint space, after 'home'
    has been typed. Obstacles are not checked: watch the arm. Ctrl-C stops it. Exit code 2 if nothing was moved.
    """
    from orchestrator.cli.motion_control import JogError, Jogging, typed_line

    lines = "all joints to 'home': steps of at most 10 deg at 5 deg/s; obstacles are not checked"
    with _session(laboratory, "home", lines, enable_motion) as (driver, _):
        session = Jogging(driver, typed_line)
        session.where()
        with Refused(JogError, code=FAILED):
            confirmed = session.home()
        if not confirmed:
            raise RefusalError("not confirmed; nothing has moved")


PlaceName = Annotated[str, typer.Argument(metavar="NAME", help="Name of the place.")]

TRIED = 0.25
"""Fraction of its usual speed at which a way is tried."""


def teach(
    laboratory: Laboratory,
    name: PlaceName,
    position: Annotated[
        str | None, typer.Argument(metavar="POSITION", help="Of a rack: A1 first, then a corner in each direction.")
    ] = None,
    use: Annotated[
        Literal["stand", "balance", "source"] | None,
        typer.Option(help="'balance' under the receiver, 'source' under the outlet of the refill pump."),
    ] = None,
    rack: Annotated[
        str | None, typer.Option(help="A new rack: 'rows: 4, columns: 6, row_pitch: 120 mm, column_pitch: 100 mm'.")
    ] = None,
    labware: Annotated[
        Path | None, typer.Option(help="A new rack from this labware definition of Opentrons (JSON, schema 2 or 3).")
    ] = None,
) -> None:
    """Read where the arm stands and write it into the laboratory file as a place. Nothing moves.

    Guide the arm by hand (free drive) until the fingers are at a vessel that stands there, then run this. The place is
    checked: reach, limits, the way from home, distance from other places. Comments in the file are kept.

    Of a rack, teach A1, then the last positions of column 1 and of row A, such as D1 and A6. How far they are from a
    grid with its pitch is printed. Teach both again after A1.
    """
    from pydantic import ValidationError

    from actors.laboratory import reached
    from actors.places import PlaceSettings
    from orchestrator.campaigns.place_writing import LEAST_APPROACH, first_problem, write_place
    from orchestrator.cli.motion_control import connected
    from orchestrator.runs.motion_approval import accepted_checksum

    spec = read_laboratory(laboratory)
    if spec.arm is None or (tool := getattr(spec.arm, "tool", None)) is None:
        raise without_arm(laboratory, spec, "'decant robot teach' reads the pose of an arm's tool")
    before = next((place for place in spec.places if place.name == name), None)
    grid, lift = _rack(before, rack, labware)
    fresh = {} if grid is None else {"holds": ("receiver",), "approach": max(LEAST_APPROACH, lift)}
    try:
        PlaceSettings(name=name, pose=tool, tool=tool)
    except ValidationError as error:
        raise RefusalError(f"place {first_problem(error)}") from None
    if (position is None) != (grid is None) or (grid is not None and position not in grid.corners):
        raise RefusalError(_position_problem(name, position, grid))
    accepted = accepted_checksum(laboratory) if spec.mode == "hardware" else None
    with reached(spec) as ready, connected(ready, accepted) as (driver, facts):
        pose = driver.where().tool
        arm = (ready.arm or spec.arm).fitted_to(facts)
    if grid is not None and position != "A1":
        place = _taught_corner(before, name, grid, str(position), pose, tool)
    else:
        taught: dict[str, Any] = {"pose": pose, "tool": tool, **({} if use is None else {"use": use})}
        if grid is not None:
            taught["rack"] = grid.with_values(last_row=None, last_column=None)
        place = PlaceSettings(name=name, **{**fresh, **taught}) if before is None else before.with_values(**taught)
    if problems := _place_problems(place, spec, arm):
        raise RefusalError("nothing is written: " + "; ".join(problems))
    with Refused(OSError):
        write_place(laboratory, place)
    _print_taught(laboratory, place, position, pose)


def _taught_corner(
    before: PlaceSettings | None, name: str, grid: RackSettings, position: str, pose: Pose, tool: Pose
) -> PlaceSettings:
    """A rack with the pose of another corner than A1, which is taught first."""
    if before is None or before.tool != tool:
        raise RefusalError(f"teach A1 of '{name}' first, with the present tool of the arm")
    corner = "last_row" if grid.corners[position][0] else "last_column"
    return before.with_values(rack=grid.with_values(**{corner: pose}))


def _place_problems(place: PlaceSettings, spec: LaboratorySettings, arm: ArmSettings) -> list[str]:
    """Why an arm can't use a taught place among the others of its laboratory."""
    from actors.arm.arm_settings import arm_kind
    from actors.places import all_places, rack_problem

    if place.rack is not None and (problem := rack_problem(place)):
        return [problem]
    others = all_places([other for other in spec.places if other.name != place.name])
    problems = arm_kind(arm).place_problems([*others, *place.each], {})
    return [text for number, text in problems if number >= len(others)]


def _print_taught(laboratory: Path, place: PlaceSettings, position: str | None, pose: Pose) -> None:
    """Print where a place or a position of a rack is, and what is still to be taught of the rack."""
    from actors.places import rows_behind_others

    x, y, z = (1e3 * value for value in pose.as_list[:3])
    if place.rack is None:
        print_message(f"{laboratory}: place '{place.name}' is at x {x:.1f}, y {y:.1f}, z {z:.1f} mm ({place.use})")
        return
    print_message(f"{laboratory}: '{place.name}/{position}' is at x {x:.1f}, y {y:.1f}, z {z:.1f} mm")
    if text := rows_behind_others(place):
        print_note(text)
    corners = zip([*place.rack.corners][1:], place.rack.taught_corners, strict=True)
    missing = [name for name, pose in corners if pose is None]
    residual = f"residual of the taught positions: {1e3 * place.rack.positions(place.pose)[1]:.2f} mm"
    print_message(f"{residual}; still to be taught: {', '.join(missing)}" if missing else residual)


def _rack(before: PlaceSettings | None, text: str | None, labware: Path | None) -> tuple[RackSettings | None, float]:
    """The rack that is taught, and the height to which vessels are lifted out of it [m]; None for a place."""
    from pydantic import ValidationError
    from ruamel.yaml import YAML
    from ruamel.yaml.error import YAMLError

    from actors.places import RackSettings
    from orchestrator.campaigns.place_writing import first_problem, labware_rack

    rack = None if before is None else before.rack
    if text is None and labware is None:
        return rack, 0.0
    if before is not None or (text is not None and labware is not None):
        raise RefusalError("'--rack' or '--labware' begin a new place; remove it, or change 'rack' in the file")
    if labware is not None:
        with Refused(OSError):
            return labware_rack(labware)
    try:
        return RackSettings.model_validate(YAML(typ="safe").load(f"{{{text}}}")), 0.0
    except YAMLError:
        raise RefusalError(f"--rack: '{text}' should be keys and values, such as 'rows: 4, columns: 6'") from None
    except ValidationError as error:
        raise RefusalError(f"--rack: {first_problem(error)}") from None


def _position_problem(name: str, position: str | None, rack: RackSettings | None) -> str:
    if rack is None:
        return (
            f"'{name}' is no rack in the file, and has no position {position}. For a new rack add '--rack \"rows: 4, "
            "columns: 6, row_pitch: 120 mm, column_pitch: 100 mm\"', or '--labware FILE'"
        )
    given = "name one" if position is None else f"not {position}"
    return f"'{name}' is a rack, which is taught at {', '.join(rack.corners)}: {given}"


def try_place(laboratory: Laboratory, name: PlaceName, enable_motion: EnableMotion = False) -> None:
    """Move the arm slowly from home to a place and back, with an empty, open gripper, after confirmations.

    The way is the one on which vessels are carried later, at a quarter of its speed. Ctrl-C stops the arm; bring it
    home with 'decant robot home' then.
    """
    from actors.arm.arm_settings import arm_kind
    from actors.places import all_places
    from orchestrator.cli.motion_control import stoppable, typed_line

    spec = read_laboratory(laboratory)
    places = all_places(spec.places)
    place = next((p for p in places if p.name == name), None)
    if place is None:
        names = ", ".join(f"'{p.name}'" for p in spec.places) or "none"
        raise RefusalError(f"{laboratory}: there is no place '{name}'; there are {names}")
    lines = f"from home to the place '{name}' and back, at a quarter of the usual speed"
    with _session(laboratory, "try", lines, enable_motion) as (driver, arm):
        way = arm_kind(arm).way(place, places, {}).slowed(TRIED)
        print_message(f"{way.approach_time:.0f} s for each way. The fingers must be open, and hands out of the cell.")
        for homewards, text in ((False, f"down to '{name}'"), (True, "back home")):
            if typed_line(f"type 'yes' to move {text} > ").strip() != "yes":
                raise RefusalError("not confirmed; the arm stays where it is")
            driver.release()
            step = dataclasses.replace(way, homewards=homewards)
            stoppable(driver, lambda step=step: driver.carry(step))  # type: ignore[misc, attr-defined]
    print_message(f"place '{name}' was reached and left again")


@contextlib.contextmanager
def _session(laboratory: Path, command: str, steps: str, enabled: bool) -> Iterator[tuple[Arm, ArmSettings]]:
    """Connect the arm for motion, after the operator's approval. Yields its driver and settings.

    Args:
        laboratory: the laboratory's file.
        command: name of the command, for messages.
        steps: description of the steps, for the operator.
        enabled: whether `--enable-motion` was given.

    Raises:
        RefusalError: the laboratory has no arm, its motion is not enabled, or the arm can't be connected.
    """
    from actors.laboratory import reached
    from orchestrator.cli.motion_control import WARNING_TIME, confirm, connected, require_flag
    from orchestrator.runs.motion_approval import accepted_checksum

    spec = read_laboratory(laboratory)
    if spec.arm is None:
        raise without_arm(laboratory, spec, f"'decant robot {command}' moves an arm that a driver controls")
    require_flag(spec, enabled=enabled, again=f"decant robot {command} {laboratory} --enable-motion")
    if not sys.stdin.isatty():
        raise RefusalError(f"'decant robot {command}' asks for confirmation at a terminal, with nothing piped into it")
    accepted = accepted_checksum(laboratory) if spec.mode == "hardware" else None
    if spec.mode == "hardware":
        confirm(spec, [f"steps          {steps}"])
    else:
        print_message(f"laboratory {spec.name}, virtual: no hardware moves")
    with reached(spec) as ready:
        assert ready.arm is not None
        soon = ready.with_values(arm=ready.arm.with_values(warning_time=WARNING_TIME))
        with connected(soon, accepted) as (driver, facts):
            print_message(f"{facts.model} {facts.serial}, {spec.mode}; nothing moves before you confirm it")
            assert soon.arm is not None
            yield driver, soon.arm.fitted_to(facts)
