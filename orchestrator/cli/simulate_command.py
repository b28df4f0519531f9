"""Options and help text of `decant simulate`: one pour, or a table of weighed pours.

The work is done in `pour_prediction`.
"""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

import typer

from orchestrator.cli.command_options import (
    Assignments,
    Campaign,
    Json,
    Parameters,
    Quiet,
    Receiver,
    SceneName,
    Thetas,
    call,
    given,
)
from orchestrator.cli.console import BAD_INPUT, RefusalError


class BackendChoice(StrEnum):
    """Device that the solver runs on."""

    CPU = "cpu"
    CUDA = "cuda"


def simulate(
    campaign: Campaign,
    assignments: Assignments = None,
    source: Annotated[
        Path | None,
        typer.Option(
            "--from",
            help="CSV file of weighed pours, as for a calibration: predict all of them and score the predictions.",
            show_default=False,
        ),
    ] = None,
    parameters: Parameters = None,
    receiver: Receiver = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the initial positions; the first if several.")] = 0,
    seeds: Annotated[
        int, typer.Option(min=1, max=1000, help="Number of seeds per pour: SEED, SEED + 1, … Their spread is shown.")
    ] = 3,
    thetas: Thetas = None,
    scene: SceneName = None,
    as_json: Json = False,
    rrd: Annotated[Path | None, typer.Option(help="Write a Rerun recording.", show_default=False)] = None,
    png: Annotated[
        Path | None,
        typer.Option(help="Draw four moments of the pour; with --from: measured over predicted.", show_default=False),
    ] = None,
    csv: Annotated[
        Path | None, typer.Option(help="With --from: write a table of the predictions as CSV.", show_default=False)
    ] = None,
    backend: Annotated[BackendChoice, typer.Option(help="Device that the solver runs on.")] = BackendChoice.CPU,
    quiet: Quiet = False,
) -> None:
    """Simulate one pour of a campaign's scene with several seeds, and print the fate of the liquid.

    Values of `--set` without a unit are in deg, deg/s, deg/s^2, mm and s; values that the campaign fixes can be left
    out. With `--json`, fractions are of the load: received + spilled + retained + in_flight + escaped = 1. They are of
    the first seed, as are the recording and the picture. 'prediction' contains means and standard deviations of all
    seeds, and the interval that should contain nine pours in ten.

    With `--from`, every pour of a table is predicted, and the predictions are scored: mean |measured − predicted|
    spillage, Spearman's rank correlation, and the number of pours within their intervals. The scene is the one that
    refers to the file, else calibration's, unless `--scene` names another.
    """
    options = given(locals(), "campaign")
    call(_simulate, campaign, options)


def _simulate(campaign: Path, told: dict[str, Any]) -> None:
    """Simulate one pour, or a table of pours."""
    from orchestrator.cli.prediction_inputs import SimulateOptions

    options = SimulateOptions(**told)
    if options.source is None:
        from orchestrator.cli import pour_prediction as single

        if options.csv is not None:
            raise RefusalError(f"--csv {options.csv}: goes with --from, a table of weighed pours", BAD_INPUT)
        single.simulate(campaign, options)
        return
    from orchestrator.cli.pour_prediction import predict_table

    if options.assignments:
        raise RefusalError("--set: the table given with --from says what is poured; remove one of them", BAD_INPUT)
    if options.rrd is not None:
        raise RefusalError(f"--rrd {options.rrd}: records one pour; it does not go with --from", BAD_INPUT)
    predict_table(campaign, options, options.source)
