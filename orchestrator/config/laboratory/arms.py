"""What an arm of any kind is in a laboratory's file: one section, derived from `ArmSettings`, found at the door."""

from __future__ import annotations

from abc import abstractmethod
from typing import TYPE_CHECKING, ClassVar

from orchestrator.config.laboratory.cell import CellSection
from orchestrator.config.yaml.sections import Section
from orchestrator.config.yaml.source import Place, Report
from sim_engine.doors import Door

if TYPE_CHECKING:
    from actors.arm.spec import ArmSpec


class ArmSettings(Section):
    """What may be written under `arm` for one kind; its field `kind` has the name that it is registered under."""

    tag: ClassVar[str] = "kind"

    @classmethod
    def unknown_tag(cls, word: str) -> str:
        """Which plug-in would have it, if it could be loaded."""
        return next((str(broken) for broken in ARMS.broken if broken.name == word), "")

    @abstractmethod
    def resolve(self, cell: CellSection | None, place: Place, report: Report, *, mode: str) -> ArmSpec | None:
        """The arm's settings; what is wrong goes to the report, and then there are none.

        Args:
            cell: as written under `cell`; None where there is no such key.
            place: of the mapping in which `arm` and `cell` stand.
            report: takes problems.
            mode: of the laboratory, 'virtual' or 'hardware'.
        """


def _arm(loaded: object, name: str) -> type[ArmSettings]:
    if not (isinstance(loaded, type) and issubclass(loaded, ArmSettings)):
        raise TypeError("should be a class derived from orchestrator.config.laboratory.arms.ArmSettings")
    kind = loaded.model_fields.get("kind")
    if kind is None or kind.default != name:
        raise TypeError(f"its field 'kind' should be Literal['{name}'] = '{name}', as it is registered")
    return loaded


ARMS: Door[type[ArmSettings]] = Door("decant.arms", "arm", _arm)
"""Sections of all kinds of arms that are installed."""
