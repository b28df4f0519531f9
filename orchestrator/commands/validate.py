"""`decant validate`: files are read, vessels built and actions tried; nothing is started."""

from __future__ import annotations

from pathlib import Path

from orchestrator.commands.speaking import BAD_INPUT, RefusalError, mention, say
from orchestrator.commands.waiting import Waiting


def validate(paths: list[Path]) -> None:
    """Check files; every problem of every file, exit code 2 if there is one. What makes little sense is a warning."""
    from orchestrator.config.yaml.errors import ConfigError
    from sim_engine.vessel.errors import VesselError

    bad = 0
    for path in paths:
        try:
            with Waiting() as doing:
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


def _checked(path: Path, doing: Waiting) -> tuple[str, list[str]]:
    """What a good file is, in a few words; and what is wrong with it.

    Raises:
        ConfigError, VesselError: it can't be used.
    """
    from orchestrator.config.load import load_campaign, load_laboratory, load_vessel
    from orchestrator.config.yaml.files import resolved
    from orchestrator.config.yaml.kinds import kind_of
    from orchestrator.config.yaml.source import Document

    doing(f"reading {path}")
    match kind_of(Document.read(resolved(path)).data):
        case "vessel":
            from sim_engine.vessel.build import build_vessel

            return f"vessel, holds {1e6 * build_vessel(load_vessel(path)).capacity:.4g} mL to the brim", []
        case "laboratory":
            return f"laboratory, {load_laboratory(path).mode}", []
        case "study":
            from orchestrator.config.study.sections import load_study
            from orchestrator.study.cells import cells_of

            study = load_study(path)
            return f"study, {len(cells_of(study))} cells, seed {study.seed}", []
        case _:
            from orchestrator.config.campaign.check import check_campaign

            plan = load_campaign(path)
            warned: list[str] = []
            problems = check_campaign(plan, warn=lambda problem: warned.append(f"warning: {problem}"), doing=doing)
            for text in dict.fromkeys(warned):
                mention(text)
            return f"campaign, seed {plan.seed}", [str(problem) for problem in problems]
