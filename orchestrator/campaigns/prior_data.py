"""Pours weighed before a campaign, read from the journal of a previous run.

`read_former_run` reads a `PreviousRun`. `pours_in` selects its pours in the same scene. `fitting` selects the pours
that the action space covers, and gives a reason for each pour that it leaves out.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from orchestrator.campaigns.fingerprint import scene_by_content
from orchestrator.learning.calibration.pour_design import DesignResult
from orchestrator.learning.campaign_plan import RecordedPour
from orchestrator.learning.strategy import is_sound
from orchestrator.records.codec import Results
from orchestrator.records.journal import JOURNAL_NAME
from sim_engine.action import ACTION_DIMENSIONS, Action, Dimension
from sim_engine.outcome import PourMeasurement
from sim_engine.scene import Scene
from sim_engine.search_space import Space

SAME = 1e-6
"""Largest difference [SI] between two values of a dimension that count as equal."""


@dataclass(frozen=True)
class PreviousRun:
    """Pours of a previous run.

    Attributes:
        path: path of its journal.
        mode: mode of its laboratory, 'virtual' or 'hardware'.
        scenes: scenes by name, as in the journal's header.
        pours: (scene, pour) in the order in which they were made; without failed pours.
    """

    path: Path
    mode: str
    scenes: dict[str, Mapping[str, Any]]
    pours: tuple[tuple[str, RecordedPour], ...]


def read_former_run(directory: Path) -> PreviousRun:
    """Read the weighed pours of a run, finished or not. Doses are left out: their motions were not those of an action.

    Pours made for calibration keep their split if the stage that made them was finished; all others are 'train'.

    Raises:
        JournalError: there is no run, or another version wrote it.
        CodecError: an entry can't be decoded.
    """
    from orchestrator.records.run_record import read_record  # most campaigns use no other run

    record = read_record(directory)
    header, splits = record.header.fingerprint, _splits(record.results)
    weighed = [
        pour
        for pour in record.pours
        if pour.request.dose is None and pour.measured is not None and is_sound(pour.measured.fractions)
    ]
    pours = tuple(
        (
            pour.request.scene,
            _recorded(pour.request.action, pour.measured, splits.get((pour.stage, pour.request.number), "train")),
        )
        for pour in sorted(weighed, key=lambda pour: pour.time or 0.0)
        if pour.measured is not None
    )
    mode = str(header.get("laboratory", {}).get("mode", "virtual"))
    return PreviousRun(directory / JOURNAL_NAME, mode, {scene["name"]: scene for scene in scenes_in(header)}, pours)


def _recorded(action: Action, measured: PourMeasurement, split: str) -> RecordedPour:
    return RecordedPour(action, measured.loaded - measured.retained, measured.spilled, measured.retained, split)


def _splits(results: Results) -> dict[tuple[str, int], str]:
    """(stage, pour number) of a designed pour → its split ('train' or 'test')."""
    return {
        (stage, pour.number): pour.split
        for stage, result in results.items()
        if isinstance(result, DesignResult)
        for pour in result.pours
    }


def scenes_in(header: Mapping[str, Any]) -> Iterator[Mapping[str, Any]]:
    """The scenes of a run, as in its journal's header (a fingerprint)."""
    calibration, deployment = header.get("calibration") or {}, header.get("deployment") or {}
    if calibration:
        yield calibration["scene"]
        yield from (*calibration.get("further", ()), *calibration.get("tested", ()))
    for records in (calibration.get("records"), calibration.get("transfer")):
        if records:
            yield records["scene"]
    yield from deployment.get("scenes", ())
    yield from filter(None, [header.get("pour")])


def pours_in(run: PreviousRun, scene: Scene) -> tuple[list[RecordedPour], str]:
    """The run's pours in the same scene (shapes of the vessels, liquid, pivot), and the reason if there are none."""
    ours = scene_by_content(scene)
    differences = {name: _difference(theirs, ours) for name, theirs in run.scenes.items()}
    same = {name for name, difference in differences.items() if not difference}
    pours = [pour for name, pour in run.pours if name in same]
    if pours:
        return pours, ""
    if same:
        return [], f"poured nothing in the scene '{', '.join(sorted(same))}'"
    nearest = min(differences.values(), key=len, default=["it has no scene"])
    return [], f"poured in another scene: {'; '.join(nearest)}"


def _difference(theirs: Mapping[str, Any], ours: Mapping[str, Any]) -> list[str]:
    differences = []
    for role in ("pourer", "receiver"):
        if theirs[role]["shape"] != ours[role]["shape"]:
            differences.append(f"its {role} '{theirs[role]['name']}' is not shaped as '{ours[role]['name']}'")
    for name, unit, factor in (("mass", "g", 1e3), ("density", "kg/m^3", 1.0)):
        their_value, our_value = theirs["liquid"][name], ours["liquid"][name]
        if not math.isclose(their_value, our_value, rel_tol=1e-6):
            differences.append(f"its liquid has {their_value * factor:g} {unit}, here {our_value * factor:g} {unit}")
    for name in ("pivot", "max_hold_time"):
        if theirs.get(name) != ours[name]:
            differences.append(f"its motion.{name} is another one")
    return differences


@dataclass(frozen=True)
class Fitting:
    """Pours that a strategy can use as data.

    Attributes:
        pours: pours inside the search space whose other dimensions agree with the scene.
        left_out: reasons why the others are excluded, one text per reason.
    """

    pours: tuple[RecordedPour, ...]
    left_out: tuple[str, ...]


def fitting(pours: Sequence[RecordedPour], scene: Scene, actions: Space) -> Fitting:
    """The pours that the action space could have requested."""
    reasons = [_unfit(pour.action, scene, actions) for pour in pours]
    counted = Counter(reason for reason in reasons if reason)
    return Fitting(
        tuple(pour for pour, reason in zip(pours, reasons, strict=True) if not reason),
        tuple(f"{count} pour{'s' * (count > 1)}: {reason}" for reason, count in counted.items()),
    )


def _unfit(action: Action, scene: Scene, actions: Space) -> str:
    usual = scene.action(actions.decode([0.5] * actions.dimension))
    axes = {axis.name: axis for axis in actions.axes}
    for name, dimension in ACTION_DIMENSIONS.items():
        value = getattr(action, name)
        if name in axes:
            axis = axes[name]
            slack = 1e-9 * (axis.upper - axis.lower)
            if value is None or not axis.lower - slack <= value <= axis.upper + slack:
                bounds = f"{_shown(axis.lower, dimension)} … {_shown(axis.upper, dimension)}"
                return f"{name} {'is switched off' if value is None else 'is outside ' + bounds}"
            continue
        our_value = getattr(usual, name)
        same = value is our_value if value is None or our_value is None else abs(value - our_value) <= SAME
        if not same:
            return f"{name} was {_shown(value, dimension)}, here it is {_shown(our_value, dimension)}"
    return ""


def _shown(value: float | None, dimension: Dimension) -> str:
    return dimension.switched_off if value is None else f"{value / dimension.factor:g} {dimension.display_unit}"
