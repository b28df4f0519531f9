"""What commands return, as models that `--json` prints; the documentation and the schema are made from them.

Quantities are in SI units unless a name has a unit: `spilled_g`, `capacity_mL`. Models with parts of runs, of the
catalogue or of the daemon's API are in `json_output`, whose import takes longer.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict

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

    mirrored: bool
    """Whether half of the particles were simulated, and the others are their mirror images."""

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


class PluginsOutput(CommandOutput):
    """Plug-ins of installed packages."""

    plugins: list[dict[str, str]]
    """`group`, `name` and `package`."""

    broken: list[dict[str, str]]
    """Plug-ins that can't be used, with the reason."""
