"""What a strategy finds wrong with its settings, put where it stands in the file."""

from __future__ import annotations

from orchestrator.config.yaml.yaml_source import Loc, Place, Report


class PlacedProblems:
    """Complaints about a section, by its keys; see `orchestrator.strategies.campaign_plan.Complaints`.

    Args:
        place: of the section.
        common: keys of the section that are not the strategy's.
    """

    def __init__(self, place: Place, report: Report, common: frozenset[str]) -> None:
        self._place, self._report, self._common = place, report, common
        self._before = len(report.problems)

    def add(self, text: str, *at: str | int, key: bool = False, of: str = "") -> None:
        """Note a problem, unless something is wrong there already."""
        where = self._place.at(*at)
        if (at and self._below(where.loc)) or (of and self._below(self._place.at(of).loc)):
            return
        self._report.add(where, text, key=key)

    @property
    def any(self) -> bool:
        """Whether something is wrong with the strategy's settings."""
        if len(self._report.problems) > self._before:
            return True
        start = len(self._place.loc)
        return any(loc[start] not in self._common for loc in self._below(self._place.loc) if len(loc) > start)

    def _below(self, loc: Loc) -> list[Loc]:
        path = self._place.document.path
        return [found for where, found in self._report.broken if where == path and found[: len(loc)] == loc]
