"""References to values in other files: vessels, liquids, laboratories. Each file is read once."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

from actors.arm.arm_settings import arm_kind
from actors.balance.balance_settings import SerialBalanceSettings
from actors.laboratory_settings import LaboratorySettings
from orchestrator.campaigns.vessel_file import MESH_SUFFIXES, VesselFile, resolve_vessel
from orchestrator.campaigns.yaml.file_access import missing_file, resolved
from orchestrator.campaigns.yaml.section_validation import validate
from orchestrator.campaigns.yaml.yaml_errors import ConfigError
from orchestrator.campaigns.yaml.yaml_source import Document, Place, Report, wrong_kind
from sim_engine.errors import shown_path
from sim_engine.liquids import Liquid, LiquidSettings
from sim_engine.settings.model import Settings
from sim_engine.vessel.shapes import VesselSpec

S = TypeVar("S", bound=Settings)

YAML_SUFFIXES = (".yaml", ".yml", ".json")

KINDS: dict[type[Settings], str] = {VesselFile: "vessel", LaboratorySettings: "laboratory"}
"""Kinds of whole files that their keys identify."""


@dataclass
class References:
    """Follows paths from files to files. Problems in any of them are added to the report with their own place."""

    report: Report
    _read: dict[tuple[Path, type[Settings]], tuple[Settings, Place] | None] = field(default_factory=dict)
    _vessels: dict[tuple[Path, Any], VesselSpec | None] = field(default_factory=dict)

    def section(self, value: Any, place: Place, model: type[S]) -> tuple[S, Place] | None:
        """The section behind a path, or the inline one, with its place; None if there is none."""
        if isinstance(value, model):
            return value, place
        if not isinstance(value, str):
            return None
        path = resolved(place.directory / value)
        if path.suffix.lower() in MESH_SUFFIXES and model is VesselFile:
            self.report.add(
                place, f"is a mesh; write {{name: {path.stem}, mesh: {value}, unit: mm}} with the unit that it is in"
            )
            return None
        if (missing := missing_file(path)) is not None:
            self.report.add(place, missing)
            return None
        if path.suffix.lower() not in YAML_SUFFIXES:
            self.report.add(place, f"{path.name} is not a YAML file; its name should end in .yaml")
            return None
        return self.file(path, model, place)

    def file(self, path: Path, model: type[S], named: Place | None = None) -> tuple[S, Place] | None:
        """The section of a whole file.

        Args:
            path: the file.
            model: class of the section.
            named: place of the reference; None for a file given directly.
        """
        key = (path, model)
        if key not in self._read:
            try:
                place = Place(Document.read(path))
            except ConfigError as error:
                self.report.problems.extend(error.problems)
                self._read[key] = None
            else:
                kind = KINDS.get(model)
                other = None if kind is None else wrong_kind(place.document, kind)
                if other is not None and named is not None:
                    self.report.add(named, f"{shown_path(path)} {other.message}")
                elif other is not None:
                    self.report.problems.append(other)
                read = None if other is not None else validate(model, place, self.report)
                self._read[key] = None if read is None else (read, place)
        entry = self._read[key]
        if entry is None:
            return None
        section, place = entry
        assert isinstance(section, model)
        return section, place

    def vessel(self, value: Any, place: Place) -> VesselSpec | None:
        """A vessel; None after a problem (which is reported)."""
        loaded = self.section(value, place, VesselFile)
        if loaded is None:
            return None
        key = (loaded[1].document.path, loaded[1].loc)
        if key not in self._vessels:
            self._vessels[key] = resolve_vessel(*loaded, self.report)
        return self._vessels[key]

    def liquid(self, value: Any, place: Place) -> Liquid | None:
        """A liquid; None after a problem."""
        loaded = self.section(value, place, LiquidSettings)
        return None if loaded is None or self.report.is_broken_within(loaded[1]) else loaded[0].load()

    def laboratory(self, value: Any, place: Place) -> LaboratorySettings | None:
        """A laboratory, ready for use; None after a problem."""
        loaded = self.section(value, place, LaboratorySettings)
        if loaded is None or self.report.is_broken_within(loaded[1]):
            return None
        laboratory, at = loaded[0].ready(), loaded[1]
        balance = laboratory.balance
        if isinstance(balance, SerialBalanceSettings) and balance.raw_lines is not None:
            folder = str(resolved(at.directory / balance.raw_lines))
            laboratory = laboratory.with_values(balance=balance.with_values(raw_lines=folder))
        if laboratory.arm is None:
            return laboratory
        try:
            return laboratory.with_values(arm=arm_kind(laboratory.arm).with_stored(at.directory))
        except ValueError as error:
            self.report.add(at.at("arm"), str(error))
            return None
