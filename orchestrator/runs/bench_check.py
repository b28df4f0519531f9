"""The check of a laboratory before a pour: network, controller, safety settings, balance, packages, plug-ins.

`check_bench` reads everything and moves nothing. `BenchReport` is the result for the command `decant robot check` and
for `decant.doctor`; `BenchReport.document` is its JSON.
"""

from __future__ import annotations

import html
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

from actors.arm.arm_settings import ArmDiagnostics, SafetyRecord, arm_kind
from actors.balance.balance_settings import balance_diagnostics
from actors.interfaces import DeviceCheck, LaboratoryError
from actors.laboratory import check_laboratory, reached
from actors.laboratory_settings import LaboratorySettings
from actors.liquid_devices import device_checks
from orchestrator.campaigns.installed_plugins import broken


@dataclass(frozen=True)
class BenchReport:
    """The state of a laboratory.

    Attributes:
        laboratory: its name.
        mode: 'virtual' or 'hardware'.
        checks: one for each checked item, with its result and remedy.
    """

    laboratory: str
    mode: str
    checks: tuple[DeviceCheck, ...]

    @property
    def failed(self) -> tuple[DeviceCheck, ...]:
        """The checks that forbid pours."""
        return tuple(check for check in self.checks if check.state == "fail")

    @property
    def ready(self) -> bool:
        """Whether no check fails."""
        return not self.failed

    def __str__(self) -> str:
        """The checks in lines, each with its remedy."""
        return "\n".join(
            f"{check.state:4s} {check.name}: {check.found}" + (f" → {check.advice}" if check.advice else "")
            for check in self.checks
        )

    def _repr_html_(self) -> str:
        """The checks as a table, in notebooks."""
        cells = ((check.state, check.name, check.found, check.advice) for check in self.checks)
        rows = "".join("<tr>" + "".join(f"<td>{html.escape(cell)}</td>" for cell in row) + "</tr>" for row in cells)
        return f"<table>{rows}</table>"


def check_bench(
    spec: LaboratorySettings,
    path: Path,
    record: SafetyRecord | None,
    *,
    tare: bool = False,
    read: Callable[[ArmDiagnostics], SafetyRecord | None] | None = None,
) -> BenchReport:
    """Check everything that a pour needs. Nothing moves; for a virtual laboratory, its devices are started meanwhile.

    Args:
        spec: of the laboratory; with an arm.
        path: its file, for the advice.
        record: accepted safety settings; None: none, or the laboratory is virtual.
        tare: also tare the balance.
        read: called with what the controller sent; returns the safety settings that are accepted now.

    Raises:
        LaboratoryError: a package is missing, or a virtual device does not start.
    """
    checks: list[DeviceCheck] = []
    if spec.arm is not None:
        with reached(spec) as ready:
            assert ready.arm is not None
            diagnostics = arm_kind(ready.arm).diagnostics()
            if read is not None:
                record = read(diagnostics)
            accept = f"decant robot check {path} --accept-safety"
            checks += diagnostics.checks(record, accept=accept, virtual=spec.mode != "hardware")
            checks += balance_diagnostics(ready.balance, tare=tare)
            gripper = None if ready.gripper is None else ready.gripper.beside(ready.arm)
            checks += device_checks(gripper=gripper)
    else:
        checks += balance_diagnostics(spec.balance, tare=tare)
    if spec.mode == "hardware" and spec.source is not None and spec.source.balance is not None:
        under_source = balance_diagnostics(spec.source.balance, tare=False)
        checks += [replace(check, name=f"source {check.name}") for check in under_source]
    checks += device_checks(spec.source, spec.spill_sensor)
    try:
        check_laboratory(spec.with_values(ray=None), pours=True)
    except LaboratoryError as error:
        advice = "install them into the environment that Decant runs in"
        checks.append(DeviceCheck("packages", "fail", str(error), advice))
    checks += [DeviceCheck("plug-in", "warn", str(plugin), f"repair or remove {plugin.package}") for plugin in broken()]
    return BenchReport(spec.name, spec.mode, tuple(checks))
