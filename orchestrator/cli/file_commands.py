"""The commands `decant validate`, `decant migrate`, `decant init` and `decant plugins`.

- `validate` reads files, builds vessels and tries actions; it starts nothing.
- `migrate` rewrites files of earlier versions.
- `init` copies example files into a folder.
- `plugins` lists the plug-ins of installed packages, including those that can't be used.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path

from orchestrator.cli.console import BAD_INPUT, FAILED, RefusalError, WaitingIndicator, mention, print_json, say
from orchestrator.installed_plugins import broken, installed
from orchestrator.shipped import starting_set


def validate(paths: list[Path]) -> None:
    """Check files and print all their problems; exit code 2 if there is one. Implausible values are warnings."""
    from orchestrator.config.yaml.yaml_errors import ConfigError
    from sim_engine.vessel.shapes import VesselError

    bad = 0
    for path in paths:
        try:
            with WaitingIndicator() as doing:
                note, problems = _checked(path, doing)
        except ConfigError as error:
            problems = [str(error)]
        except VesselError as error:
            problems = [f"{path}: {error}"]
        if problems:
            bad += 1
            say("\n".join(problems))
        else:
            print(f"{path}: ok ({note})", flush=True)
    if bad:
        raise RefusalError(f"{bad} of {len(paths)} file(s) can't be used", BAD_INPUT)


def _checked(path: Path, doing: WaitingIndicator) -> tuple[str, list[str]]:
    """Return a short description of a file, and its problems.

    Raises:
        ConfigError, VesselError: the file can't be used.
    """
    from orchestrator.config.file_loading import load_campaign, load_laboratory, load_vessel
    from orchestrator.config.yaml.file_access import resolved
    from orchestrator.config.yaml.yaml_source import Document, kind_of

    doing(f"reading {path}")
    match kind_of(Document.read(resolved(path)).data):
        case "vessel":
            from sim_engine.vessel.vessel import build_vessel

            return f"vessel, holds {1e6 * build_vessel(load_vessel(path)).capacity:.4g} mL to the brim", []
        case "laboratory":
            return f"laboratory, {load_laboratory(path).mode}", []
        case "study":
            from orchestrator.study.study_file import load_study
            from orchestrator.study.study_plan import cells_of

            study = load_study(path)
            return f"study, {len(cells_of(study))} cells, seed {study.seed}", []
        case _:
            from orchestrator.config.campaign_checks import check_campaign

            plan = load_campaign(path)
            warned: list[str] = []
            problems = check_campaign(plan, warn=lambda problem: warned.append(f"warning: {problem}"), doing=doing)
            for text in dict.fromkeys(warned):
                mention(text)
            return f"campaign, seed {plan.seed}", [str(problem) for problem in problems]


def migrate(paths: list[Path]) -> None:
    """Rename retired keys and values in files, in place; comments and layout are kept.

    Raises:
        RefusalError: a file can't be read, or has problems that a person has to solve (exit code 2).
    """
    from orchestrator.config.file_loading import load_campaign, load_laboratory, load_vessel
    from orchestrator.config.migration import migrate_file
    from orchestrator.config.yaml.file_access import resolved
    from orchestrator.config.yaml.yaml_errors import ConfigError
    from orchestrator.config.yaml.yaml_source import Document, kind_of

    def load_study(path: Path) -> object:
        from orchestrator.study.study_file import load_study

        return load_study(path)

    def load_daemon(path: Path) -> object:
        from orchestrator.daemon.daemon_settings import load_settings

        return load_settings(path)

    kinds = {"vessel": load_vessel, "laboratory": load_laboratory, "study": load_study, "campaign": load_campaign}
    left = 0
    for path in paths:
        try:
            kind = kind_of(Document.read(resolved(path)).data)
            result = migrate_file(path, load_daemon if kind is None else kinds[kind])
        except (ConfigError, OSError) as error:
            say(str(error))
            left += 1
            continue
        for line, old, new in result.renamed:
            print(f"{path}:{line}: {old} -> {new}")
        if not result.renamed and not result.problems:
            print(f"{path}: nothing to rename")
        if result.problems:
            left += 1
            say("\n".join(map(str, result.problems)))
    if left:
        raise RefusalError(f"{left} of {len(paths)} file(s) have problems that can't be solved by renaming", BAD_INPUT)


def init(directory: Path) -> None:
    """Copy the example campaigns and the files they refer to.

    Raises:
        RefusalError: the folder is not empty, or can't be written (exit code 2).
    """
    try:
        campaigns = starting_set(directory)
    except FileExistsError as error:
        raise RefusalError(str(error), BAD_INPUT) from None
    except OSError as error:
        raise RefusalError(f"{directory}: can't be written: {error.strerror}", BAD_INPUT) from None
    for path in campaigns:
        print(path)


def plugins(*, as_json: bool) -> None:
    """List strategies, objectives, balances, arms and sources of vessels by the names that files use.

    Args:
        as_json: print one line of JSON instead of the table.

    Raises:
        RefusalError: a plug-in can't be used (exit code 1).
    """
    found, unusable = installed(), broken()
    if as_json:
        print_json(
            {
                "plugins": [dataclasses.asdict(plugin) for plugin in found],
                "broken": [dataclasses.asdict(one) for one in unusable],
            }
        )
    else:
        width = [max(len(row) for row in column) for column in zip(*((p.group, p.name) for p in found), strict=True)]
        for plugin in found:
            print(f"{plugin.group:<{width[0]}}  {plugin.name:<{width[1]}}  {plugin.package}")
    if unusable:
        raise RefusalError("\n".join(map(str, unusable)), FAILED)
