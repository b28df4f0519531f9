"""An arm of numbers in a laboratory's file: with a balance on a wire, for trying that out without a robot."""

from __future__ import annotations

from typing import ClassVar, Literal

from actors.arm.numbers import NumbersSpec
from orchestrator.config.laboratory.arms import ArmSettings
from orchestrator.config.laboratory.cell import CellSection
from orchestrator.config.yaml.source import Place, Report


class NumbersArmSection(ArmSettings):
    """An arm of numbers: it makes every motion, and stands nowhere."""

    required: ClassVar[dict[str, str]] = {"kind": "numbers"}

    kind: Literal["numbers"] = "numbers"
    """An arm of numbers."""

    def resolve(self, cell: CellSection | None, place: Place, report: Report, *, mode: str) -> NumbersSpec | None:
        """See `ArmSettings.resolve`."""
        before = len(report.problems)
        if mode == "hardware":
            report.add(place.at("arm"), "an arm of numbers moves nothing; write 'mode: virtual'")
        if cell is not None:
            report.add(place.at("cell"), "an arm of numbers stands nowhere; remove the section")
        return NumbersSpec() if len(report.problems) == before else None
