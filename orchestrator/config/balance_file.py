"""A laboratory's balance as written in files: where it stands, its serial line, and when its weights count."""

from __future__ import annotations

from abc import abstractmethod
from typing import Annotated, Any, ClassVar, Literal

from pydantic import Field

from actors.balance.balance_settings import (
    AUTO,
    BalanceDevice,
    BalanceSpec,
    NumbersBalanceSpec,
    SerialBalanceSpec,
    SettlingRule,
    parse_format,
)
from actors.balance.dialect_registry import BALANCES, dialects, kinds
from actors.balance.simulated_balance import BalanceSettings, ScaleSettings
from actors.balance.weighing_plan import Placement
from orchestrator.config.yaml.yaml_source import Place, Report
from sim_engine.settings.model import Choice, PositiveCount, Section, Text, tagged
from sim_engine.settings.quantity import Quantity

_RULE = SettlingRule()
_SHEET = ScaleSettings()
_SERIAL = SerialBalanceSpec(port="")
_BALANCE = BalanceSpec(Placement.TRAY, None)

Error = Annotated[float, Quantity("kg", "0.1 g", 0.0, 0.01)]
"""Error of a weighing: a balance that is 10 g out tells nothing about a spill."""
PositiveMass = Annotated[float, Quantity("kg", "0.1 g", 0.0, 0.1, positive=True)]
Duration = Annotated[float, Quantity("s", "1.5 s", 0.0, 600.0)]
PositiveDuration = Annotated[float, Quantity("s", "20 s", 0.0, 600.0, positive=True)]

USUAL_BAUDS = (300, 600, 1200, 2400, 4800, 9600, 14_400, 19_200, 28_800, 38_400, 57_600, 115_200)
"""Speeds that balances can be set to [bits per second]."""


def dialect_names() -> list[str]:
    """What `dialect` may be: what is installed, ours as everybody's."""
    return [AUTO, *dialects()]


class SettlingSection(Section):
    """When a weight counts."""

    readings: Annotated[int, Field(strict=True, ge=2, le=100)] = _RULE.readings
    """Stable readings in a row that are needed."""

    span: Duration = _RULE.span
    """From the first to the last of them."""

    steps: Annotated[float, Quantity("1", "1", 0.0, 100.0)] = _RULE.steps
    """How far they may lie apart, in steps of the display."""

    deadline: PositiveDuration = _RULE.deadline
    """When a weight that has not settled is given up."""


class VirtualScaleSection(Section):
    """What the data sheet of a virtual balance says."""

    resolution: PositiveMass = _SHEET.resolution
    """Step of the display."""

    capacity: Annotated[float, Quantity("kg", "6.2 kg", 0.0, 1000.0, positive=True)] = _SHEET.capacity
    """Heaviest load."""

    noise: Error = _SHEET.noise
    """Standard deviation of weighing the same thing again."""

    drift: Annotated[float, Quantity("kg/s", "0.01 g/s", -0.01, 0.01)] = _SHEET.drift
    """Creep of the zero."""

    settling_time: Duration = _SHEET.settling_time
    """Until a change is shown to within a hundredth of it."""


class BalanceDeviceSection(Section):
    """The balance: where it stands, and how it is reached.

    A further kind is a class derived from this in a package, registered at the door `decant.balances` under its `kind`.
    """

    tag: ClassVar[str] = "kind"

    kind: str = ""
    """What is there; a literal in each class, and its name at the door."""

    placement: Literal["tray", "receiver", "everything", "manual"] = "tray"
    """What it stands under: 'tray' reads the spill, 'receiver' what was received, 'everything' what was poured; with 'manual' the operator types all weights."""  # noqa: E501

    pourer: Literal["here", "elsewhere"] = "here"
    """Where the pourer is weighed: on this balance, or on another one and typed."""

    load_tolerance: PositiveMass = _BALANCE.load_tolerance
    """How far a load may lie from the one that the campaign asks for."""

    @classmethod
    def unknown_tag(cls, word: str) -> str:
        """Which plug-in would have it, if it could be loaded."""
        return next((str(broken) for broken in BALANCES.broken if broken.name == word), "")

    def check(self, place: Place, report: Report, *, mode: str) -> None:
        """Complain of what makes no sense together.

        Args:
            place: where the section stands.
            report: takes problems.
            mode: of the laboratory, 'virtual' or 'hardware'.
        """

    @abstractmethod
    def device(self) -> BalanceDevice:
        """The settings as values, which know their driver."""


class SerialSection(BalanceDeviceSection):
    """A balance on a serial line."""

    kind: Literal["serial"] = "serial"
    """A balance on a serial line."""

    port: Text | None = None
    """Its serial port; names under /dev/serial/by-id/ stay when it is plugged in again."""

    virtual: VirtualScaleSection | None = None
    """A balance that is not there, in place of a port."""

    dialect: Annotated[str, Choice(dialect_names)] = AUTO
    """How it talks; 'auto' finds out."""

    baud: PositiveCount | None = None
    """Bits per second; found out unless given."""

    format: Text | None = None
    """Bits, parity and stop bits, e.g. 8N1 ('7E1' in quotes, or YAML takes it for a number); found out unless given."""

    handshake: Literal["none", "software", "hardware"] = _SERIAL.handshake
    """Whether the balance may stop the line: by characters (Xon/Xoff), by wires (CTS), or not."""

    step: PositiveMass | None = None
    """Step of its display, where that is not one of the last digit."""

    repeatability: Error = _SERIAL.repeatability
    """Standard deviation of weighing the same thing again, from its data sheet."""

    settling: SettlingSection = SettlingSection()
    """When a weight counts."""

    interval: Annotated[float, Quantity("s", "0.15 s", 0.02, 5.0)] = _SERIAL.interval
    """From one question to the next."""

    answer_time: PositiveDuration = _SERIAL.answer_time
    """Longest wait for an answer."""

    reconnect_time: Duration = _SERIAL.reconnect_time
    """How long a port that vanished is waited for."""

    def check(self, place: Place, report: Report, *, mode: str) -> None:
        """See `BalanceDeviceSection.check`."""
        if self.placement != "manual":
            _check_line(self, place, report, mode)
        if self.settling.deadline <= self.settling.span:
            report.add(place.at("settling"), "nothing can settle: 'deadline' should be longer than 'span'")

    def device(self) -> SerialBalanceSpec:
        """See `BalanceDeviceSection.device`."""
        return SerialBalanceSpec(
            port=self.port or "",
            dialect=self.dialect,
            baud=self.baud,
            format=self.format,
            handshake=self.handshake,
            settling=SettlingRule(**self.settling.model_dump()),
            step=self.step,
            repeatability=self.repeatability,
            interval=self.interval,
            answer_time=self.answer_time,
            reconnect_time=self.reconnect_time,
            virtual=None if self.virtual is None else ScaleSettings(**self.virtual.model_dump()),
        )


class NumbersSection(BalanceDeviceSection):
    """A balance of numbers: nothing is at its far end, and its driver is given what stands on it."""

    kind: Literal["numbers"] = "numbers"
    """A balance of numbers, on a virtual bench."""

    resolution: PositiveMass = 1e-4
    """Step of its display."""

    noise: Error = 1e-4
    """Standard deviation of a reading."""

    settling_time: Duration = 1.5
    """Until a change is shown to within a hundredth of it."""

    def check(self, place: Place, report: Report, *, mode: str) -> None:
        """See `BalanceDeviceSection.check`."""
        if mode == "hardware":
            report.add(place, "a laboratory of hardware weighs on a balance that is there; give its 'port'")
        _check_step(self.resolution, self.load_tolerance, place.at("resolution"), report)

    def device(self) -> NumbersBalanceSpec:
        """See `BalanceDeviceSection.device`."""
        return NumbersBalanceSpec(BalanceSettings(self.resolution, self.noise, 0.0, self.settling_time, 1.0))


_TYPED = ("kind", "placement", "load_tolerance", "step", "repeatability")
"""Keys that have a meaning where the operator types all weights."""


def any_balance() -> Any:
    """The section of whatever balance is installed."""
    return tagged(kinds(), default="serial")


def resolve_balance(section: BalanceDeviceSection, place: Place, report: Report, *, mode: str) -> BalanceSpec | None:
    """The balance of a file; what is wrong goes to the report, and then there is none.

    Args:
        section: as written.
        place: where it stands.
        report: takes problems.
        mode: of the laboratory, 'virtual' or 'hardware'.
    """
    before = len(report.problems)
    if section.placement == "manual":
        _check_manual(section, place, report)
    section.check(place, report, mode=mode)
    if len(report.problems) > before:
        return None
    return BalanceSpec(
        placement=Placement(section.placement),
        device=None if section.placement == "manual" else section.device(),
        pourer_elsewhere=section.pourer == "elsewhere",
        load_tolerance=section.load_tolerance,
    )


def _check_manual(section: BalanceDeviceSection, place: Place, report: Report) -> None:
    for key, name in section.written_keys().items():
        if name in section.model_fields_set and name not in _TYPED:
            report.add(place.at(key), "is not used with placement 'manual', where the operator types all weights")


def _check_line(section: SerialSection, place: Place, report: Report, mode: str) -> None:
    if section.port is not None and section.virtual is not None:
        report.add(place.at("virtual"), "a balance has a 'port' or is 'virtual', not both")
    elif mode == "hardware" and section.virtual is not None:
        report.add(place.at("virtual"), "a laboratory of hardware weighs on a balance that is there; give its 'port'")
    elif mode != "hardware" and section.port is not None:
        report.add(place.at("port"), "a virtual laboratory has no port; write 'virtual: {}', or 'mode: hardware'")
    elif section.port is None and section.virtual is None and not report.is_broken(place.at("port")):
        example = "port: /dev/serial/by-id/usb-…" if mode == "hardware" else "virtual: {resolution: 0.1 g}"
        report.add(place, f"placement '{section.placement}' reads the balance; add '{example}', or type: 'manual'")
    if section.baud is not None and section.baud not in USUAL_BAUDS:
        usual = ", ".join(str(baud) for baud in USUAL_BAUDS)
        report.add(place.at("baud"), f"no balance talks at {section.baud} baud; should be one of {usual}")
    if section.step is not None:
        _check_step(section.step, section.load_tolerance, place.at("step"), report)
    if section.virtual is not None:
        at = place.at("virtual", "resolution")
        _check_step(section.virtual.resolution, section.load_tolerance, at, report)
    if section.format is not None:
        try:
            parse_format(section.format)
        except ValueError as error:
            report.add(place.at("format"), str(error))


def _check_step(step: float, tolerance: float, place: Place, report: Report) -> None:
    if step > tolerance:
        report.add(
            place,
            f"a display in steps of {1e3 * step:g} g can't tell whether a load lies within load_tolerance, "
            f"{1e3 * tolerance:g} g; weigh on a finer balance, or raise load_tolerance",
        )
