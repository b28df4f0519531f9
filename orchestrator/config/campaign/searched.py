"""Which parameters a campaign searches, and what is known of them beforehand: what only makes sense together."""

from __future__ import annotations

from orchestrator.config.campaign.sections import CampaignFile
from orchestrator.config.parameters import ParameterRangeSection, ParametersBase
from orchestrator.config.ranges import EXAMPLES
from orchestrator.config.yaml.source import Place, Report
from orchestrator.strategies.doors import calibrations


def check_ranges(file: CampaignFile, root: Place, report: Report) -> None:
    """Complain of ranges that nothing searches, calibrations without any, and measured values that are incomplete."""
    parameters: ParametersBase | None = file.simulator.parameters
    place = root.at("simulator", "parameters")
    sections = {} if parameters is None else parameters.ranges()
    for name, section in sections.items():
        _check(section, place.at(name), report)
    if file.calibration is None and not report.is_broken(root.at("calibration")):
        for name in sections:
            if not report.is_broken(place.at(name)):
                report.add(
                    place.at(name),
                    "is a range, and nothing searches it; write one value, or add a 'calibration' section",
                )
    in_parameters = any(loc[:2] == place.loc for _, loc in report.broken)
    if file.calibration is not None and not sections and not in_parameters:
        report.add(
            root.at("calibration"),
            "has nothing to search; give a range to at least one of simulator.parameters, "
            "for example 'cohesion: [0 N/m, 0.1 N/m]'",
            key=True,
        )
    if file.calibration is not None and not file.calibration.settings.has_prior:
        owners = " and ".join(name for name, settings in calibrations().items() if settings.has_prior)
        for name, section in sections.items():
            if section.measured is not None:
                strategy = file.calibration.settings.strategy
                text = f"belongs to {owners}; {strategy} takes all values for alike. Write a range"
                report.add(place.at(name, "measured"), text, key=True)


def _check(section: ParameterRangeSection, at: Place, report: Report) -> None:
    """A measured value has a tolerance, and lies in the range beside it."""
    if any(loc[: len(at.loc)] == at.loc for _, loc in report.broken):
        return
    info, value, tolerance = section.info, section.measured, section.tolerance
    unit = "" if info.shown == "1" else f" {info.shown}"
    if section.range is None and value is None and tolerance is None:
        report.add(at, "names nothing to search; add a 'range', or what was 'measured' with its 'tolerance'", key=True)
    elif value is None and tolerance is not None:
        report.add(at, f"has a tolerance of nothing; add for example 'measured: {EXAMPLES[info.name]}'", key=True)
    elif value is not None and tolerance is None:
        usual = f"{(info.tolerance or (info.upper - info.lower) / 20.0) / info.factor:.2g}{unit}"
        text = f"has no 'tolerance'; add for example 'tolerance: {usual}', or write the value alone to fix it"
        report.add(at, text, key=True)
    elif section.scale == "log" and tolerance is not None:
        report.add(at.at("scale"), "a tolerance is the same to both sides, and needs the scale 'linear'")
    elif value is not None and section.range is not None and not section.range[0] <= value <= section.range[1]:
        low, high = (f"{end / info.factor:g}" for end in section.range)
        report.add(
            at.at("measured"), f"{value / info.factor:g}{unit} is outside the range beside it, {low} … {high}{unit}"
        )
