"""Recorded pours: one YAML file for each, with the vessels, the liquid, the placement and the origin, and a CSV file.

- `RecordingFile` declares the YAML file, `orchestrator.recordings.time_series` the table next to it.
- `load_recording` checks both and returns a `PourRecording`; `load_recordings` reads files and folders.
- `write_recording` writes both files.

Readings before the first tilt belong to the placing of the receiver; its step shows the lag of the balance.
"""

from __future__ import annotations

import math
import shutil
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from ruamel.yaml import YAML

from actors.dosing.dose_estimator import DoseReading
from orchestrator.campaigns.file_references import References, VesselFile
from orchestrator.campaigns.yaml.file_access import resolved
from orchestrator.campaigns.yaml.section_validation import validate
from orchestrator.campaigns.yaml.yaml_errors import ConfigError, Problem
from orchestrator.campaigns.yaml.yaml_source import Document, Place, Report, wrong_kind
from orchestrator.recordings.recording_checks import impossible
from orchestrator.recordings.time_series import TimeSeries, gaps, read_series, write_series
from sim_engine.action import ACTION_DIMENSIONS, Dimension
from sim_engine.liquids import Liquid, LiquidSettings
from sim_engine.scene import Pivot, Scene
from sim_engine.settings.model import Example, FilePath, PathOr, Settings, Text
from sim_engine.settings.quantity import Quantity
from sim_engine.vessel.mesh_shape import MeshShape
from sim_engine.vessel.shapes import ProfileShape, VesselSpec

Floats = NDArray[np.float64]

LONGEST_GAP = 1.0
"""Time without a value above which a warning is given [s]."""

LONGEST_INTERVAL = 20.0
"""Largest median interval of tilts that a recording may have [s]."""

UPRIGHT = math.radians(5.0)
"""Rise of the tilt from which the cup counts as pouring [rad]."""

REST = 4
"""Number of readings before the pour whose mean is the zero."""


def _length(name: str, example: str) -> Any:
    dimension: Dimension = ACTION_DIMENSIONS[name]
    return Annotated[float, Quantity("m", example, dimension.lower, dimension.upper)]


class RecordedPlacement(Settings):
    """Poses of the vessels while the pourer is upright, as in an action."""

    x_offset: _length("x_offset", "90 mm") = 0.0  # type: ignore[valid-type]
    """Distance of the vessels' axes along the direction of the pour."""

    y_offset: _length("y_offset", "0 mm") = 0.0  # type: ignore[valid-type]
    """Sideways distance of the vessels' axes."""

    height: _length("height", "100 mm") = 0.1  # type: ignore[valid-type]
    """The pourer's lip above the receiver's rim."""

    grip: Annotated[float, Quantity("rad", "0 deg", -math.radians(10.0), math.radians(10.0))] = 0.0
    """Tilt of the vessel beyond the recorded tilt: the angle of the grip."""


class RecordedBalance(Settings):
    """The balance below the receiver."""

    model: Text = "unknown"
    """Make and model."""

    step: Annotated[float, Quantity("kg", "0.1 g", 1e-8, 0.1)] | None = None
    """Step of the display; the smallest difference of two readings unless given."""

    noise: Annotated[float, Quantity("kg", "0.02 g", 0.0, 0.1)] = 0.0
    """Standard deviation of a reading, besides the step."""

    zero: Annotated[float, Quantity("kg", "0 g", -100.0, 100.0)] | None = None
    """Reading of the empty receiver; the mean of the last readings before the pour unless given."""


class RecordedOrigin(Settings):
    """Origin of the data."""

    how: Annotated[Text, Example("robot log and serial line of the balance")]
    """How tilt and mass were recorded."""

    by: Text | None = None
    """The author, or the laboratory."""

    date: Text | None = None
    """Day of the recording."""

    source: Text | None = None
    """Publication or address that the data is from."""

    licence: Text | None = None
    """Licence of the data; 'unknown' must not be redistributed."""

    run: Text | None = None
    """Decant's run that poured, and the number of the pour in it."""

    raw_lines: FilePath | None = None
    """Recording of the balance's raw lines (`decant balance record`)."""


class RecordingFile(Settings):
    """A recorded pour. Its time series are in a CSV file."""

    recorded: Annotated[RecordedOrigin, Example("{how: robot log and serial line}")]
    """Origin and licence of the data."""

    series: FilePath | None = None
    """Table of times, tilts and readings; the CSV file of the same name unless given."""

    columns: dict[str, Text] | None = None
    """Columns that have other names in that table: `{mass_g: grams}`."""

    pourer: Annotated[PathOr[VesselFile], Example("beaker.yaml")]
    """The tilted vessel."""

    receiver: Annotated[PathOr[VesselFile], Example("bowl.yaml")]
    """The vessel on the balance."""

    liquid: Annotated[PathOr[LiquidSettings], Example("{name: water, mass: 200 g}")]
    """The liquid, and its mass in the pourer before the pour."""

    fill_deviation: Annotated[float, Quantity("kg", "0.5 g", 0.0, 1.0)] = 0.5e-3
    """Standard deviation of that mass."""

    placement: RecordedPlacement = RecordedPlacement()
    """Poses of the vessels."""

    balance: RecordedBalance = RecordedBalance()
    """The balance below the receiver."""


@dataclass(frozen=True, eq=False)
class PourRecording:
    """A recorded pour in SI units.

    Attributes:
        path: the YAML file.
        scene: pourer, receiver, liquid with the mass before the pour.
        fill_deviation: standard deviation of that mass [kg].
        placement: poses.
        balance: the balance; its step is known.
        origin: of the data.
        tilt_times, tilts: as recorded (T,) [s], [rad].
        placed: readings before the first tilt, while the receiver was put on; as displayed.
        read_times, readings: from the first tilt on (R,) [s], [kg]; as displayed.
        zero: reading of the empty receiver [kg].
        warnings: what is unusual, with file and line.
    """

    path: Path
    scene: Scene
    fill_deviation: float
    placement: RecordedPlacement
    balance: RecordedBalance
    origin: RecordedOrigin
    tilt_times: Floats
    tilts: Floats
    placed: tuple[DoseReading, ...]
    read_times: Floats
    readings: Floats
    zero: float
    warnings: tuple[Problem, ...] = ()

    @property
    def name(self) -> str:
        """Its name: the file's."""
        return self.path.stem

    @property
    def step(self) -> float:
        """Step of the display [kg]."""
        return self.balance.step or 1e-4

    @property
    def net(self) -> Floats:
        """Readings without the receiver (R,) [kg]."""
        net: Floats = self.readings - self.zero
        return net

    @property
    def gain(self) -> float:
        """Mass at the end: the mean of the last readings that agree within three steps [kg]."""
        net = self.net
        last = net[-1]
        start = len(net) - next((i for i, mass in enumerate(net[::-1]) if abs(mass - last) > 3.0 * self.step), len(net))
        return float(net[max(start, len(net) - REST) :].mean())

    def tilt_at(self, times: Floats) -> Floats:
        """Recorded tilt, linear between two records (N,) [rad]."""
        return np.interp(times, self.tilt_times, self.tilts)


def load_recording(path: Path | str) -> PourRecording:
    """The recorded pour of a file.

    Args:
        path: the YAML file.

    Raises:
        ConfigError: the file, its CSV file, or a vessel's file is invalid.
    """
    path = resolved(Path(path))
    report = Report()
    place = Place(Document.read(path))
    if (other := wrong_kind(place.document, "recording")) is not None:
        raise ConfigError([other])
    section = validate(RecordingFile, place, report)
    report.raise_if_any()
    assert section is not None, "a recording without problems has settings"
    references = References(report)
    pourer = references.vessel(section.pourer, place.at("pourer"))
    receiver = references.vessel(section.receiver, place.at("receiver"))
    liquid = references.liquid(section.liquid, place.at("liquid"))
    report.raise_if_any()
    assert pourer is not None
    assert receiver is not None
    assert liquid is not None
    series = read_series(resolved(place.directory / (section.series or f"{path.stem}.csv")), section.columns)
    return _checked(path, section, Scene(path.stem, pourer, receiver, liquid, Pivot()), series)


def load_recordings(paths: Iterable[Path]) -> list[PourRecording]:
    """The recorded pours of files and folders; a folder's are read in the order of their names.

    Raises:
        ConfigError: see `load_recording`; or a folder has none.
    """
    recordings: list[PourRecording] = []
    problems: list[Problem] = []
    for path in paths:
        files = sorted(path.glob("*.yaml")) if path.is_dir() else [path]
        if not files:
            problems.append(Problem(path, 0, 0, "", "has no recorded pour (.yaml with a .csv of the same name)"))
        for file in files:
            try:
                recordings.append(load_recording(file))
            except ConfigError as error:
                problems += error.problems
    if problems:
        raise ConfigError(problems)
    return recordings


def _checked(path: Path, section: RecordingFile, scene: Scene, series: TimeSeries) -> PourRecording:
    """The recording, or every reason why it can't be one.

    Raises:
        ConfigError: it is no recorded pour.
    """
    if "tilt" not in series.columns:
        text = "has no tilt; a recorded pour needs the column tilt_deg with at least two values"
        raise ConfigError([series.problem(1, text)])
    tilt, mass = series.columns["tilt"], series.columns["mass"]
    problems: list[Problem] = []
    warnings = list(series.warnings)
    if len(tilt) < 2:
        problems.append(series.problem(int(tilt.lines[0]), "is the only tilt; a pour needs at least two"))
    far = np.flatnonzero(np.abs(tilt.values) > math.pi)
    if len(far):
        text = (
            f"the tilt is {math.degrees(tilt.values[far[0]]):.4g}°, beyond 180°; is it in another unit than its name?"
        )
        problems.append(series.problem(int(tilt.lines[far[0]]), text, "tilt"))
    first = int(np.searchsorted(mass.times, tilt.times[0]))
    placed, poured = mass[:first], mass[first:]
    if len(poured) < 2:
        text = "has fewer than two readings of the mass after the first tilt; do both columns use the same clock?"
        problems.append(series.problem(int(mass.lines[-1]), text, "mass"))
    elif len(tilt) > 1 and (interval := float(np.median(np.diff(tilt.times)))) > LONGEST_INTERVAL:
        text = f"the tilts are {interval:.3g} s apart, too far for a pour; if that is in milliseconds, name the column "
        text += "time_ms"
        problems.append(series.problem(int(tilt.lines[1]), text, "time"))
    if problems:
        raise ConfigError(problems)
    end = float(tilt.times[-1])
    late = int(np.searchsorted(poured.times, end + LONGEST_GAP + 1e-9))
    if late < len(poured):
        text = (
            f"the tilt ends at {end:g} s, the readings at {poured.times[-1]:g} s; those after {end + LONGEST_GAP:g} s "
            "are left out. Record the tilt until the end, also while the cup rests"
        )
        warnings.append(series.problem(int(poured.lines[late]), text, "tilt"))
        poured = poured[:late]
        if len(poured) < 2:
            raise ConfigError([series.problem(int(mass.lines[first]), text, "tilt")])
    for name, column, effect in (
        ("tilt", tilt, "the tilt is taken as a straight line there"),
        ("mass", poured, "nothing is filled in, and the estimate runs on without a reading"),
    ):
        missing = gaps(column, LONGEST_GAP)
        if missing and len(column) > 2:  # two readings are those before and after a pour
            i = max(missing, key=lambda i: float(column.times[i] - column.times[i - 1]))
            width = column.times[i] - column.times[i - 1]
            others = "" if len(missing) == 1 else f"; there are {len(missing)} gaps above {LONGEST_GAP:g} s"
            text = f"no {name} for {width:.3g} s before this line: {effect}{others}. Record at 10 Hz or faster"
            warnings.append(series.problem(int(column.lines[i]), text, name))
    balance = section.balance
    if balance.step is None:
        balance = balance.with_values(step=_smallest_step(mass.values))
    zero = balance.zero
    if zero is None:
        upright = poured.times <= _begin(tilt.times, tilt.values)
        settled = [*placed.values, *poured.values[upright]][-REST:] or [poured.values[0]]
        zero = float(np.mean(settled))
    recording = PourRecording(
        path,
        scene,
        section.fill_deviation,
        section.placement,
        balance,
        section.recorded,
        tilt.times,
        tilt.values,
        tuple(DoseReading(float(t), float(m)) for t, m in zip(placed.times, placed.values, strict=True)),
        poured.times,
        poured.values,
        zero,
    )
    errors, unusual = _masses(recording, series, poured.lines)
    grip = section.placement.grip
    errors = errors or impossible(scene, series, tilt, poured, zero, grip=grip, step=section.balance.step)
    if errors:
        raise ConfigError(errors)
    return replace(recording, warnings=(*warnings, *unusual))


TENFOLD = (5.0, 20.0)
"""Ratios of a reading to both of its neighbours that a digit or a point more or less explains, and no pour."""


def _tenfold(readings: NDArray[np.float64], step: float) -> int | None:
    """Position of a single reading that is about ten or a tenth times each of its neighbours, which agree.

    Near an empty balance's zero, readings of a few steps [kg] do that by themselves.
    """
    before, middle, after = (np.abs(readings[i : len(readings) - 2 + i]) for i in range(3))
    low, high = np.minimum(before, after), np.maximum(before, after)
    larger = (middle > TENFOLD[0] * high) & (middle < TENFOLD[1] * low)
    smaller = (middle < low / TENFOLD[0]) & (middle > high / TENFOLD[1])
    far = np.abs(middle - high) > max(20.0 * step, 0.02 * float(np.abs(readings).max()))
    places = np.flatnonzero((larger | smaller) & (high < 1.5 * low) & far)
    return 1 + int(places[0]) if len(places) else None


def _masses(
    recording: PourRecording, series: TimeSeries, lines: NDArray[np.int64]
) -> tuple[list[Problem], list[Problem]]:
    """Errors and warnings about the readings of a pour."""
    net, step, load = recording.net, float(recording.step), recording.scene.liquid.mass
    if (alone := _tenfold(recording.readings, step)) is not None:
        before, reading, after = 1e3 * recording.readings[alone - 1 : alone + 2]
        text = (
            f"this reading is {reading:.6g} g, and those next to it are {before:.6g} and {after:.6g} g: it was damaged "
            "on the way, or mistyped; leave its cell empty"
        )
        return [series.problem(int(lines[alone]), text, "mass")], []
    above = np.flatnonzero(net > 1.05 * load + 10.0 * step)
    if len(above):
        text = (
            f"the readings have risen by {1e3 * net[above[0]]:.4g} g, and the pourer held {1e3 * load:.4g} g; is the "
            "mass in another unit than its name, or 'liquid' wrong?"
        )
        return [series.problem(int(lines[above[0]]), text, "mass")], []
    warnings: list[Problem] = []
    peak = np.maximum.accumulate(net)
    fallen = np.flatnonzero(peak - net > max(6.0 * step, 0.5e-3, 0.01 * float(peak[-1])))
    if len(fallen):
        i = int(fallen[0])
        text = (
            f"the mass falls by {1e3 * (peak[i] - net[i]):.3g} g while pouring; was the balance tared or the receiver "
            "touched? End the recording before it"
        )
        warnings.append(series.problem(int(lines[i]), text, "mass"))
    return [], warnings


def _begin(times: Floats, tilts: Floats) -> float:
    """Time at which the cup has begun to tilt [s]."""
    tilted = np.flatnonzero(np.abs(tilts - tilts[0]) > UPRIGHT)
    return float(times[tilted[0]]) if len(tilted) else float(times[0])


def _smallest_step(values: Floats) -> float:
    """The smallest difference of readings that differ [kg]; 0.1 g for two weights, whose difference is the pour."""
    differences = np.abs(np.diff(np.unique(np.round(values, 9))))
    return float(differences.min()) if len(differences) > 1 else 1e-4


def write_recording(
    path: Path,
    scene: Scene,
    columns: Mapping[str, Sequence[tuple[float, float]]],
    *,
    recorded: Mapping[str, str],
    placement: Mapping[str, str] | None = None,
    balance: Mapping[str, str] | None = None,
    fill_deviation: float | None = None,
) -> Path:
    """Write a recorded pour: the YAML file and its CSV file. Meshes of vessels are copied next to them.

    Args:
        path: of the new YAML file.
        scene: pourer, receiver, and liquid with its mass before the pour.
        columns: see `orchestrator.recordings.time_series.write_series`.
        recorded, placement, balance: these sections as they are written.
        fill_deviation: standard deviation of the mass in the pourer [kg].

    Returns:
        The YAML file.

    Raises:
        ValueError: a vessel's shape is from a plug-in that has no outline, and can't be written.
        OSError: a file can't be written, or exists.
    """
    content: dict[str, Any] = {
        "recorded": dict(recorded),
        "pourer": vessel_section(scene.pourer, path.parent),
        "receiver": vessel_section(scene.receiver, path.parent),
        "liquid": liquid_section(scene.liquid),
    }
    if fill_deviation is not None:
        content["fill_deviation"] = f"{1e3 * fill_deviation:.4g} g"
    content |= {name: dict(section) for name, section in (("placement", placement), ("balance", balance)) if section}
    yaml = YAML()
    yaml.default_flow_style = None
    yaml.width = 116
    with path.open("x", encoding="utf-8") as file:
        file.write("# A recorded pour; the time series is in the CSV file of the same name.\n")
        yaml.dump(content, file)
    write_series(path.with_suffix(".csv"), columns)
    return path


def vessel_section(spec: VesselSpec, folder: Path) -> dict[str, Any]:
    """A vessel as its file has it; a mesh is copied into a folder.

    Raises:
        ValueError: see `write_recording`.
        OSError: the mesh can't be copied.
    """
    shape = spec.shape
    if isinstance(shape, MeshShape):
        copy = folder / shape.path.name
        if not copy.exists():
            shutil.copyfile(shape.path, copy)
        unit = {} if shape.unit is None else {"unit": shape.unit}
        return {"name": spec.name, "mesh": copy.name, **unit, "up": shape.up}
    outline: ProfileShape | None = shape.outline()
    if outline is None:
        raise ValueError(f"{spec.name}: its shape is from a plug-in ('{shape.kind}'), which can't be written to a file")
    points = [[round(1e3 * r, 4), round(1e3 * z, 4)] for r, z in outline.inner]
    walls = {"wall": f"{1e3 * outline.wall:.6g} mm", "floor": f"{1e3 * outline.floor:.6g} mm"}
    return {"name": spec.name, "profile": {"unit": "mm", "inner": points, **walls}}


def liquid_section(liquid: Liquid) -> dict[str, str]:
    """A liquid as a file has it, with all its properties."""
    return {
        "name": liquid.name,
        "mass": f"{1e3 * liquid.mass:.7g} g",
        "density": f"{liquid.density:.7g} kg/m^3",
        "viscosity": f"{1e3 * liquid.dynamic_viscosity:.7g} mPa*s",
        "surface_tension": f"{1e3 * liquid.surface_tension:.7g} mN/m",
    }
