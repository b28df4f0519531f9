"""`decant simulate` as the command line has it: one pour, or a table of weighed ones."""

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
    """Where the solver runs."""

    CPU = "cpu"
    CUDA = "cuda"


def simulate(
    campaign: Campaign,
    assignments: Assignments = None,
    source: Annotated[
        Path | None,
        typer.Option(
            "--from",
            help="CSV of weighed pours, as calibration reads it: predict them all and score the predictions.",
            show_default=False,
        ),
    ] = None,
    parameters: Parameters = None,
    receiver: Receiver = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the initial positions; the first of several.")] = 0,
    seeds: Annotated[
        int, typer.Option(min=1, max=1000, help="How many seeds of a pour: SEED, SEED + 1, … Their spread is shown.")
    ] = 3,
    thetas: Thetas = None,
    scene: SceneName = None,
    as_json: Json = False,
    rrd: Annotated[Path | None, typer.Option(help="Write a Rerun recording.", show_default=False)] = None,
    png: Annotated[
        Path | None,
        typer.Option(help="Draw four moments of the pour; with --from measured over predicted.", show_default=False),
    ] = None,
    csv: Annotated[
        Path | None, typer.Option(help="With --from: write a table of the predictions.", show_default=False)
    ] = None,
    backend: Annotated[BackendChoice, typer.Option(help="Where the solver runs.")] = BackendChoice.CPU,
    quiet: Quiet = False,
) -> None:
    """Simulate one pour of a campaign's scene, with several seeds, and say where the liquid went.

    Actions without a unit are in deg, deg/s, deg/s^2, mm and s; what the campaign fixes needs no `--set`. With `--json`
    fractions are of the load: received + spilled + retained + in_flight + escaped = 1; they, the recording and the
    picture are the first seed's, means and standard deviations of all seeds stand under 'prediction', with the band
    that nine pours in ten should lie in.

    With `--from` every pour of a table is predicted, and the predictions are scored: mean |measured − predicted|
    spillage, Spearman's rank correlation, and how many pours lie inside their band. The scene is the one whose file it
    is, else calibration's, unless `--scene` names another.
    """
    options = given(locals(), "campaign")
    call(_simulate, campaign, options)


def _simulate(campaign: Path, told: dict[str, Any]) -> None:
    """One pour, or a table of them."""
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
