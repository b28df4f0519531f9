"""What commands return, as models that `--json` prints; the documentation and the schema are made from them.

Quantities are in SI units unless a name has a unit: `spilled_g`, `capacity_mL`. Models with parts of runs, of the
catalogue or of the daemon's API are in `json_output`, whose import takes longer.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict

from actors.arm.arm_interface import PathReport
from actors.interfaces import DeviceCheck
from sim_engine.liquids import SimulationParameters
from sim_engine.prediction_band import PredictionInterval, SampleStatistics


class CommandOutput(BaseModel):
    """Base of what commands print with `--json`. A model is built when the first one is printed."""

    model_config = ConfigDict(
        extra="forbid",
        use_attribute_docstrings=True,
        arbitrary_types_allowed=True,
        defer_build=True,
    )


class CalibrateOutput(BaseModel):
    """Result of a calibration. Further keys are `test_discrepancy_NAME` and `transfer_discrepancy_NAME` of other θ."""

    model_config = ConfigDict(extra="allow", use_attribute_docstrings=True, defer_build=True)

    theta: SimulationParameters
    """θ to simulate with: θ*, or the uncalibrated θ if the weighed pours do not justify θ*."""

    calibrated_theta: SimulationParameters
    """θ*."""

    calibration_gain: dict[str, Any] | None
    """Whether the weighed pours justify θ*; null if θ* was not compared with the uncalibrated θ."""

    train_discrepancy: float | None
    """Mean |r − c_s| of θ* on the pours of the calibration."""

    test_discrepancy: float | None
    """The same on pours that were kept for testing."""

    transfer_discrepancy: float | None
    """The same on pours into another receiver."""

    simulations: int
    calibration_simulations: int
    """Simulations without those of the evaluation."""

    cpu_s: float
    run: str
    """Folder of the run."""

    figures: dict[str, Path]
    recording: Path | None
    report: Path | None


class PredictionOutput(BaseModel):
    """Prediction over seeds: `SampleStatistics` by quantity, such as received, spilled, retained and spillage."""

    model_config = ConfigDict(extra="allow", use_attribute_docstrings=True, defer_build=True)

    band: PredictionInterval | None
    seeds: list[int]
    __pydantic_extra__: dict[str, SampleStatistics]


# More than 20 fields: a flat JSON object that programs read.
class SimulateOutput(CommandOutput):
    """A simulated pour. Fractions are of the load: received + spilled + retained + in_flight + escaped = 1."""

    received: float
    spilled: float
    retained: float
    in_flight: float
    """Fraction in the air at the end."""

    escaped: float
    """Fraction that left the simulated box."""

    dribbled: float
    """Fraction that ran down the outside of the pourer; part of received and spilled."""

    particles: int
    spacing_mm: float
    density_error: float
    simulated_time_s: float
    steps: int
    cpu_s: float
    seed: int
    curve: dict[str, list[float]]
    """Poured and spilled fractions over time: `time_s`, `poured`, `spilled`."""

    invalid: str | None
    """Why the outcome must not be used; null if it is valid."""

    action: dict[str, float | None]
    theta: SimulationParameters
    thetas: int
    """Number of posterior draws of θ."""

    scene: str
    delivered_g: float | None
    """Mean mass in the receiver."""

    delivered_ml: float | None
    prediction: PredictionOutput
    regimes: dict[str, Any] | None
    """Flow at the lip and in the stream: Reynolds, Weber and Bond numbers, thickness, velocity."""

    not_covered: list[dict[str, Any]]
    """Effects of this pour that are not simulated: `kind`, `share`, `text`."""


class DryRunOutput(CommandOutput):
    """A planned pour (`--dry-run`)."""

    mode: str
    action: dict[str, float | None]
    report: PathReport
    phases: list[dict[str, Any]]
    """Phases of the tilt: `name`, `start` and `end` [s]."""

    at_home: bool | None
    """Whether the arm stands at home; null without `--connect`."""


class EmptyPourOutput(CommandOutput):
    """A cycle with an empty pourer (`--empty`), as in pour.json."""

    run: str
    mode: str
    laboratory: str
    date: str
    robot: dict[str, str]
    action: dict[str, float | None]
    slow: float
    planned: PathReport
    tracking: dict[str, float]
    """Deviations of the executed motion from the planned one."""

    executed_s: float
    """Duration of the pour."""


class ReportOutput(CommandOutput):
    """A written report."""

    report: Path
    figures: list[Path]


class CheckOutput(CommandOutput):
    """Checks of a laboratory, of a balance, or of the recordings of a commissioning day."""

    laboratory: str
    """Name of the laboratory; the balance as it was named; the archive."""

    mode: str
    """'virtual' or 'hardware'; '' for a balance and an archive."""

    ready: bool
    """Whether no check fails."""

    checks: list[DeviceCheck]


class ValidateSolverOutput(CommandOutput):
    """Results of the solver's validation cases."""

    solver: str
    """Fingerprint of the solver's source."""

    full: bool
    cases: dict[str, dict[str, Any]]
    """By case: title, cpu_s, figure, and measurements with value, bounds and whether they passed."""


class VesselOutput(CommandOutput):
    """A vessel file that was made."""

    file: Path
    picture: Path
    capacity_mL: float  # noqa: N815
    capacity_deviation_mL: float  # noqa: N815
    radius_deviation_mm: float | None
    notes: list[str]
    doubts: list[str]
    """Checks that failed."""


class PluginsOutput(CommandOutput):
    """Plug-ins of installed packages."""

    plugins: list[dict[str, str]]
    """`group`, `name` and `package`."""

    broken: list[dict[str, str]]
    """Plug-ins that can't be used, with the reason."""


class StudyOutput(CommandOutput):
    """A study that was run or reported."""

    study: str
    folder: Path
    page: Path
    cells: int
    finished: int | None
    """Number of finished cells; null for a report."""


class StudyCostOutput(CommandOutput):
    """Unfinished work of a study (`--dry-run`)."""

    cells: list[str]
    left: int
    simulations: int
    pours: int
    cpu_hours: float


class PredictedDoseOutput(CommandOutput):
    """One dose, predicted."""

    number: int
    wanted_g: float
    position: str
    source: str
    filled: bool
    """Whether the source is filled before."""

    expected_g: float
    interval_g: tuple[float, float]
    """The expected amount lies in it with a probability of 90 %."""

    duration_s: float
    longest_s: float
    """Duration that 95 % of the doses do not exceed."""

    enough: float
    """Probability that the source holds the amount."""

    fine_flow_g_s: float
    """Flow at the end of the dose."""

    clean_flow_g_s: float
    """Smallest flow that leaves the lip cleanly; a slower one may run down the outside."""

    left_g: float
    """Expected content of the source after the dose."""

    reachable_tolerance_g: float
    """Half of the 90 % interval of the dose as weighed with this balance."""

    ends: dict[str, int]
    """Number of predicted doses by their end."""


class DosePredictionOutput(CommandOutput):
    """Doses that were predicted (`--dry-run`)."""

    doses: list[PredictedDoseOutput]
