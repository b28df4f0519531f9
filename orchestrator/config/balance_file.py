"""File section `balance` of a laboratory: placement, serial line, and the criteria for a settled weight.

- `BalanceDeviceSection`: base class of all kinds of balances; packages can register more kinds.
- `SerialSection`: a balance on a serial line, real or virtual.
- `NumbersSection`: a simulated balance without protocol.
- `resolve_balance` converts a section to the driver's settings.
"""

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
from sim_engine.settings.model import Choice, PositiveCount, Settings, Text, tagged
from sim_engine.settings.quantity import Quantity

_RULE = SettlingRule()
_SHEET = ScaleSettings()
_SERIAL = SerialBalanceSpec(port="")
_BALANCE = BalanceSpec(Placement.TRAY, None)

Error = Annotated[float, Quantity("kg", "0.1 g", 0.0, 0.01)]
"""Error of a weighing. A balance with an error of 10 g cannot measure a spill."""
PositiveMass = Annotated[float, Quantity("kg", "0.1 g", 0.0, 0.1, positive=True)]
Duration = Annotated[float, Quantity("s", "1.5 s", 0.0, 600.0)]
PositiveDuration = Annotated[float, Quantity("s", "20 s", 0.0, 600.0, positive=True)]

USUAL_BAUDS = (300, 600, 1200, 2400, 4800, 9600, 14_400, 19_200, 28_800, 38_400, 57_600, 115_200)
"""Usual speeds of balances [bits per second]."""


def dialect_names() -> list[str]:
    """Allowed values of `dialect`: all installed dialects, and automatic detection."""
    return [AUTO, *dialects()]


class SettlingSection(Settings):
    """Criteria for a settled weight."""

    readings: Annotated[int, Field(strict=True, ge=2, le=100)] = _RULE.readings
    """Number of consecutive stable readings."""

    span: Duration = _RULE.span
    """Time from the first to the last of these readings."""

    steps: Annotated[float, Quantity("1", "1", 0.0, 100.0)] = _RULE.steps
    """Largest difference between these readings, in steps of the display."""

    deadline: PositiveDuration = _RULE.deadline
    """Maximum time for a weight to settle; then the weighing fails."""


class VirtualScaleSection(Settings):
    """Data sheet of a virtual balance."""

    resolution: PositiveMass = _SHEET.resolution
    """Step of the display."""

    capacity: Annotated[float, Quantity("kg", "6.2 kg", 0.0, 1000.0, positive=True)] = _SHEET.capacity
    """Maximum load."""

    noise: Error = _SHEET.noise
    """Standard deviation of repeated weighings of the same load."""

    drift: Annotated[float, Quantity("kg/s", "0.01 g/s", -0.01, 0.01)] = _SHEET.drift
    """Drift of the zero."""

    settling_time: Duration = _SHEET.settling_time
    """Time until the display is within 1 % of a change."""


class BalanceDeviceSection(Settings):
    """The balance: its placement and its connection.

    A package adds a kind with a subclass, registered in the entry-point group `decant.balances` under its `kind`.
    """

    tag: ClassVar[str] = "kind"
    default_tag: ClassVar[str] = "serial"

    kind: str = ""
    """Kind of the balance; a literal in each subclass, equal to its registered name."""

    placement: Literal["tray", "receiver", "everything", "manual"] = "tray"
    """Load of the balance: 'tray' reads the spill, 'receiver' the received liquid, 'everything' the poured liquid; with 'manual' the operator types all weights."""  # noqa: E501

    pourer: Literal["here", "elsewhere"] = "here"
    """Where the pourer is weighed: on this balance, or on another one whose weight is typed."""

    load_tolerance: PositiveMass = _BALANCE.load_tolerance
    """Largest difference between a load and the load of the campaign."""

    @classmethod
    def unknown_tag(cls, word: str) -> str:
        """The plug-in that provides this kind, if it could not be loaded."""
        return next((str(broken) for broken in BALANCES.broken if broken.name == word), "")

    def check(self, place: Place, report: Report, *, mode: str) -> None:
        """Check for combinations of keys that are invalid.

        Args:
            place: place of the section.
            report: receives problems.
            mode: mode of the laboratory, 'virtual' or 'hardware'.
        """

    @abstractmethod
    def device(self) -> BalanceDevice:
        """The settings of the device, which select its driver."""


class SerialSection(BalanceDeviceSection):
    """A balance on a serial line."""

    kind: Literal["serial"] = "serial"
    """A balance on a serial line."""

    port: Text | None = None
    """Serial port; names under /dev/serial/by-id/ do not change when the balance is reconnected."""

    virtual: VirtualScaleSection | None = None
    """A virtual balance instead of a port."""

    dialect: Annotated[str, Choice(dialect_names)] = AUTO
    """Protocol of the balance; 'auto' detects it."""

    baud: PositiveCount | None = None
    """Bits per second; detected unless given."""

    format: Text | None = None
    """Bits, parity and stop bits, e.g. 8N1 (write '7E1' in quotes; it is a number in YAML); detected unless given."""

    handshake: Literal["none", "software", "hardware"] = _SERIAL.handshake
    """Flow control by the balance: characters (Xon/Xoff), wires (CTS), or none."""

    step: PositiveMass | None = None
    """Step of the display, if it is not one unit of the last digit."""

    repeatability: Error = _SERIAL.repeatability
    """Standard deviation of repeated weighings of the same load, from the data sheet."""

    settling: SettlingSection = SettlingSection()
    """Criteria for a settled weight."""

    interval: Annotated[float, Quantity("s", "0.15 s", 0.02, 5.0)] = _SERIAL.interval
    """Time between two requests for a reading."""

    answer_time: PositiveDuration = _SERIAL.answer_time
    """Maximum time to wait for a reply."""

    reconnect_time: Duration = _SERIAL.reconnect_time
    """Maximum time to wait for a port that has disappeared."""

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
    """A simulated balance without protocol: its driver receives the load directly."""

    kind: Literal["numbers"] = "numbers"
    """A simulated balance without protocol, on a virtual bench."""

    resolution: PositiveMass = 1e-4
    """Step of the display."""

    noise: Error = 1e-4
    """Standard deviation of a reading."""

    settling_time: Duration = 1.5
    """Time until the display is within 1 % of a change."""

    def check(self, place: Place, report: Report, *, mode: str) -> None:
        """See `BalanceDeviceSection.check`."""
        if mode == "hardware":
            report.add(place, "a laboratory of hardware weighs on a balance that is there; give its 'port'")
        _check_step(self.resolution, self.load_tolerance, place.at("resolution"), report)

    def device(self) -> NumbersBalanceSpec:
        """See `BalanceDeviceSection.device`."""
        return NumbersBalanceSpec(BalanceSettings(self.resolution, self.noise, 0.0, self.settling_time, 1.0))


_TYPED = ("kind", "placement", "load_tolerance", "step", "repeatability")
"""Keys that apply if the operator types all weights."""


def any_balance() -> Any:
    """The section type of any installed balance."""
    return tagged(kinds())


def resolve_balance(section: BalanceDeviceSection, place: Place, report: Report, *, mode: str) -> BalanceSpec | None:
    """The balance of a file; None after a problem, which is added to the report.

    Args:
        section: the section as written.
        place: place of the section.
        report: receives problems.
        mode: mode of the laboratory, 'virtual' or 'hardware'.
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
