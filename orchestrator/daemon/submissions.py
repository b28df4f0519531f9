"""Converts a submission to a queued campaign: unpacked, confined, checked as by `decant run`, and stored.

`prepare` does all steps and selects the rig; it does not start anything. The format of a bundle is defined in
`submission_bundle`.
"""

from __future__ import annotations

import re
import shutil
from dataclasses import dataclass, replace
from pathlib import Path

from actors.interfaces import LaboratoryError
from orchestrator.config.yaml.file_access import resolved
from orchestrator.config.yaml.yaml_errors import ConfigError
from orchestrator.daemon.daemon_settings import ANY_RIG, DESK, DaemonSettings, Rig
from orchestrator.daemon.daemon_store import DesiredState, QueueItem
from orchestrator.daemon.rig_worker import job_of
from orchestrator.daemon.submission_bundle import Files, SubmissionBundleError, load_confined, pack, unpack
from orchestrator.run_errors import RunError
from orchestrator.run_service import RunRequest, RunResources, RunService, RunTaskError


class SubmissionError(RunError):
    """The submission can't be queued; the message gives the problem and a remedy."""

    exit_code = 2


@dataclass(frozen=True)
class Submission:
    """A submission: a campaign's text with its files, or the path of a file on the daemon's machine.

    Attributes:
        rig: name of the rig; '' selects the matching one.
    """

    text: str = ""
    files: Files | None = None
    path: str = ""
    verb: str = "run"
    rig: str = ""
    priority: int = 0


def prepare(settings: DaemonSettings, submission: Submission, key: str, by: str) -> QueueItem:
    """Unpack and check a submission. Takes seconds; don't call it in an event loop.

    Args:
        settings: settings of the daemon.
        submission: the submission.
        key: letters at the end of the campaign's id.
        by: user who submits it.

    Raises:
        SubmissionError: the submission can't be used; its files are removed.
    """
    folder = settings.snapshots / key
    try:
        return _prepared(settings, submission, key, by)
    except (ConfigError, SubmissionBundleError, RunTaskError, LaboratoryError, RunError, OSError) as error:
        shutil.rmtree(folder, ignore_errors=True)
        raise SubmissionError(_without_places(str(error), settings, folder)) from None
    except BaseException:
        shutil.rmtree(folder, ignore_errors=True)
        raise


_PATH = re.compile(r"(?<![\w./~])/(?:[^\s/'\":;,()\[\]]+/)+([^\s/'\":;,()\[\]]+)")
"""An absolute path with two or more parts; the group is its last part."""


def _without_places(text: str, settings: DaemonSettings, folder: Path) -> str:
    """Remove this machine's paths from a message, since remote users must not learn its directory structure.

    The campaign's files keep the names that the campaign uses; other paths are reduced to their last part.
    """
    named = {folder, folder.resolve(), *settings.roots}
    for place in sorted(map(str, named), key=len, reverse=True):
        text = text.replace(f"{place}/", "").replace(place, "the campaign")
    for state in {settings.state, settings.state.resolve()}:  # may contain spaces, which end a match of _PATH
        text = text.replace(f"{state}/", "/-/")
    return _PATH.sub(r"\1", text)


def _prepared(settings: DaemonSettings, submission: Submission, key: str, by: str) -> QueueItem:
    folder = settings.snapshots / key
    text, files = submission.text, submission.files or {}
    if submission.path:
        text, files = _from_path(settings, submission.path)
    campaign = unpack(text, files, folder)
    plan = load_confined(campaign, [folder.resolve()])
    draft = QueueItem(
        key,
        plan.name,
        submission.verb,
        "",
        "none",
        submission.priority,
        0.0,
        "queued",
        str(DesiredState.RUN),
        "",
        by,
        0.0,
    )
    anywhere = job_of(settings, draft, Rig(ANY_RIG))
    rig = _rig(settings, submission.rig, anywhere)
    work = anywhere if rig.source is None else job_of(settings, draft, rig)
    service = RunService()
    service.check(work).require()
    service.check_laboratory(work, RunResources())
    mode = "none" if rig.name == DESK else work.campaign.laboratory.mode
    item = replace(draft, id=f"{plan.name[:40]}-{key}", rig=rig.name, mode=mode)
    folder.rename(settings.snapshots / item.id)
    return item


def _from_path(settings: DaemonSettings, text: str) -> tuple[str, Files]:
    """Pack a campaign on this machine from one of the allowed folders."""
    if not settings.roots:
        raise SubmissionError("no campaign may be submitted by its path: the daemon's settings name no 'roots'")
    from orchestrator.config.yaml.file_access import confined

    found = [resolved(root / text) for root in settings.roots]
    with confined(settings.roots):
        path = next((one for one in found if one.is_file() and _inside(one, settings)), None)
        if path is None:
            raise SubmissionError(f"{text}: there is no such campaign in the folders that may be read (roots)")
        return pack(load_confined(path, settings.roots))


def _inside(path: Path, settings: DaemonSettings) -> bool:
    return any(root in path.parents for root in settings.roots)


def _rig(settings: DaemonSettings, wanted: str, work: RunRequest) -> Rig:
    """Return the requested rig, or the one that matches the campaign's laboratory."""
    names = [rig.name for rig in settings.rigs]
    spec = work.campaign.laboratory
    if wanted:
        if wanted not in (*names, DESK):
            raise SubmissionError(f"there is no rig '{wanted}'; there are {', '.join(names)}")
        if wanted == DESK and work.pours:
            raise SubmissionError(f"'{DESK}' is for campaigns that pour nothing; name one of {', '.join(names)}")
        return settings.rig(wanted)
    if not work.pours:
        return Rig(DESK)
    if settings.rigs[0].source is None:
        if spec.mode != "virtual":
            raise SubmissionError(
                f"laboratory {spec.name} is {spec.mode}; the daemon runs campaigns on hardware only on a rig that its "
                f"settings name: 'rigs: {{{spec.name}: LABORATORY.yaml}}'"
            )
        if not spec.pours:
            raise SubmissionError(f"laboratory {spec.name} has no bench, but the campaign pours")
        return settings.rigs[0]
    fitting = [rig for rig in settings.rigs if rig.spec is not None and spec.name in (rig.name, rig.spec.name)]
    if len(fitting) != 1:
        raise SubmissionError(
            f"no rig is called '{spec.name}', as the campaign's laboratory is; say which it is for, with --rig: "
            f"{', '.join(names)}"
        )
    return fitting[0]
