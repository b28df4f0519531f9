"""The commands for files: `decant validate`, `init`, `schema` and `plugins`.

- `validate` reads files, builds vessels and tries actions; it starts nothing.
- `init` copies example files into a folder.
- `schema` prints JSON schemas.
- `plugins` lists the plug-ins of installed packages, including those that can't be used.
"""

from __future__ import annotations

import dataclasses
import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from orchestrator.cli.command_options import Json, OtherLaboratory
from orchestrator.cli.console import (
    FAILED,
    RefusalError,
    WaitingIndicator,
    print_json,
    print_message,
    print_note,
    print_warning,
)


def validate(
    files: Annotated[
        list[Path], typer.Argument(help="Campaign, study, vessel, laboratory, daemon or recording files.")
    ],
    laboratory: OtherLaboratory = None,
) -> None:
    """Check files without starting anything: keys, units, bounds, vessels, and whether some action can be poured.

    With --laboratory, campaigns are checked as 'decant run' would run them there.
    """
    from orchestrator.campaigns.yaml.yaml_errors import ConfigError
    from sim_engine.vessel.shapes import VesselError

    bad = 0
    for path in files:
        try:
            with WaitingIndicator() as doing:
                note, problems = _checked(path, laboratory, doing)
        except ConfigError as error:
            problems = [str(error)]
        except VesselError as error:
            problems = [f"{path}: {error}"]
        if problems:
            bad += 1
            print_message("\n".join(problems))
        else:
            print(f"{path}: ok ({note})", flush=True)
    if bad:
        raise RefusalError(f"{bad} of {len(files)} file(s) can't be used")


def _checked(path: Path, laboratory: Path | None, doing: WaitingIndicator) -> tuple[str, list[str]]:
    """Return a short description of a file, and its problems.

    Raises:
        ConfigError, VesselError: the file can't be used.
    """
    from orchestrator.campaigns.file_loading import load_campaign, load_laboratory, load_vessel
    from orchestrator.campaigns.yaml.file_access import resolved
    from orchestrator.campaigns.yaml.yaml_source import Document, kind_of
    from sim_engine.settings.plugin_registry import file_kind

    doing(f"reading {path}")
    match kind_of(Document.read(resolved(path)).data):
        case "vessel":
            from sim_engine.scene import MIRRORED_FROM
            from sim_engine.simulator import why_whole
            from sim_engine.vessel.vessel import build_vessel

            built = build_vessel(load_vessel(path))
            for text in filter(None, (*built.warnings, why_whole(built, built.capacity, MIRRORED_FROM))):
                print_warning(f"{path}: {text}")
            return f"vessel, holds {1e6 * built.capacity:.4g} mL to the brim", []
        case "laboratory":
            return f"laboratory, {load_laboratory(path).mode}", []
        case "recording" | "study" as kind:
            return file_kind(kind).check(path)
        case "daemon":
            from orchestrator.daemon.state.daemon_settings import load_settings

            return f"daemon, rigs: {', '.join(rig.name for rig in load_settings(path).rigs)}", []
        case _:
            from orchestrator.campaigns.campaign_checks import check_campaign
            from orchestrator.cli.dose_command import show_flows

            plan = load_campaign(path, laboratory, posteriors=_posteriors)
            for line in () if plan.memory is None else plan.memory.lines:
                print_note(line)
            warned: list[str] = []
            problems = check_campaign(
                plan, warn=lambda problem: warned.append(str(problem)), doing=doing, tell=print_note
            )
            for text in dict.fromkeys(warned):
                print_warning(text)
            if not problems:
                show_flows(plan)
            return f"campaign, seed {plan.seed}", [str(problem) for problem in problems]


def _posteriors() -> Any:
    from orchestrator.catalogue.catalogue import posterior_source  # most campaigns have no prior

    return posterior_source()


def init(directory: Annotated[Path, typer.Argument(help="An empty folder, or one that does not exist yet.")]) -> None:
    """Copy example files into a folder: campaigns, laboratories, studies, vessels and recorded pours."""
    from orchestrator.campaigns.shipped import starting_set

    try:
        campaigns = starting_set(directory)
    except FileExistsError as error:
        raise RefusalError(str(error)) from None
    except OSError as error:
        raise RefusalError(f"{directory}: can't be written: {error.strerror}") from None
    for path in campaigns:
        print(path)


def plugins(as_json: Json = False) -> None:
    """List the plug-ins of installed packages: strategies, objectives, balances, arms and sources of vessels.

    Exit code 1 if a plug-in can't be used; the output gives its package and the reason.
    """
    from orchestrator.campaigns.installed_plugins import broken, installed

    usable, unusable = installed(), broken()
    if as_json:
        from orchestrator.cli.command_results import PluginsOutput

        print_json(
            PluginsOutput(plugins=[*map(dataclasses.asdict, usable)], broken=[*map(dataclasses.asdict, unusable)])
        )
    else:
        width = [max(len(row) for row in column) for column in zip(*((p.group, p.name) for p in usable), strict=True)]
        for plugin in usable:
            print(f"{plugin.group:<{width[0]}}  {plugin.name:<{width[1]}}  {plugin.package}")
    if unusable:
        raise RefusalError("\n".join(map(str, unusable)), FAILED)


def schema(
    which: Annotated[
        str, typer.Argument(help="campaign, study, vessel, laboratory, daemon, result, or output.")
    ] = "campaign",
) -> None:
    """Print a JSON schema: of campaign or other files, for editors; of summary.json; of the output of `--json`."""
    from orchestrator.cli.json_schema import SCHEMAS, schema_text

    if which not in SCHEMAS:
        raise RefusalError(f"no schema '{which}'; there are {', '.join(SCHEMAS)}")
    sys.stdout.write(schema_text(SCHEMAS[which]()))
