"""Submissions: a campaign with all files that it refers to becomes a queued campaign.

- A bundle is one self-contained unit. `pack` makes it from a loaded campaign; `unpack` writes it to a folder;
  `load_confined` loads a campaign that may read only given folders. Later changes of the original files do not affect
  a bundle.
- `prepare` unpacks and checks a submission as `decant run` does, selects the rig and stores a snapshot. It does not
  start anything. `run_request` makes the run of a snapshot.
"""

from __future__ import annotations

import base64
import binascii
import json
import re
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from actors.interfaces import LaboratoryError
from orchestrator.campaigns.file_loading import load_campaign
from orchestrator.campaigns.yaml.file_access import confined, out_of_bounds, resolved
from orchestrator.campaigns.yaml.yaml_errors import ConfigError, Problem
from orchestrator.catalogue.catalogue import posterior_source
from orchestrator.daemon.rigs.pour_orders import PlannedOrder, PourOrder
from orchestrator.daemon.state.daemon_settings import ANY_RIG, NO_RIG, DaemonSettings, Rig
from orchestrator.daemon.state.daemon_store import DesiredState, QueueItem
from orchestrator.learning.campaign_plan import CampaignPlan
from orchestrator.learning.run_errors import RunError
from orchestrator.records.journal import JOURNAL_NAME
from orchestrator.records.journal_file import whole_copy
from orchestrator.runs.run_service import RunRequest, RunResources, RunService, RunTaskError
from orchestrator.runs.run_tasks import TASKS, plan_task, read_theta
from orchestrator.runs.stages import POUR

CAMPAIGN, THETA = "campaign.yaml", "theta.yaml"
"""Names of the campaign's file, and of the file with the θ for planning (`orchestrator.runs.run_tasks.read_theta`)."""

_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,79}(/[A-Za-z0-9][A-Za-z0-9._-]{0,79}){0,3}")
_FILES = 100

Files = dict[str, str]
"""Name → content in base64. Names are relative paths of letters, digits, '.', '_' and '-'."""


class SubmissionBundleError(ValueError):
    """The bundle can't be unpacked; the message gives the reason."""


def pack(plan: CampaignPlan, theta: Path | None = None) -> tuple[str, Files]:
    """Convert a loaded campaign to text and files.

    Args:
        plan: campaign as loaded from its files.
        theta: file with the θ for planning, such as a calibration's `theta.json`; None: the campaign's θ.

    Returns:
        The campaign's text (JSON, which is YAML) with paths of the returned files, and these files.

    Raises:
        OSError: a file can't be read.
        ConfigError: a file is outside the folders that this campaign may read.
    """
    files: Files = {}
    resolved = dict(plan.resolved)
    resolved["outputs"] = {k: v for k, v in resolved.get("outputs", {}).items() if k != "directory"}
    table = _packed(resolved, files)
    if theta is not None:
        files[THETA] = _coded(theta.read_bytes())
    return json.dumps(table, indent=1, ensure_ascii=False) + "\n", files


def _packed(value: Any, files: Files) -> Any:
    if isinstance(value, Mapping):
        return {key: _packed(entry, files) for key, entry in value.items()}
    if isinstance(value, list):
        return [_packed(entry, files) for entry in value]
    if isinstance(value, str) and value.startswith("/"):  # only absolute paths begin with '/' in a record
        return _taken(Path(value), files)
    return value


def _taken(path: Path, files: Files) -> str:
    if (outside := out_of_bounds(path)) is not None:
        raise ConfigError([Problem(path, 0, 0, "", outside)])
    stem = re.sub(r"[^A-Za-z0-9._-]", "_", path.name).lstrip("._-")[-60:] or "file"
    name = f"files/{len(files) + 1}-{stem}"
    if (path / JOURNAL_NAME).is_file():  # a previous run: only its journal is read
        files[f"{name}/{JOURNAL_NAME}"] = _coded(whole_copy(path / JOURNAL_NAME))
    elif path.is_file():
        files[name] = _coded(path.read_bytes())
    else:
        return str(path)
    return name


def _coded(content: bytes) -> str:
    return base64.b64encode(content).decode("ascii")


def unpack(text: str, files: Mapping[str, str], folder: Path) -> Path:
    """Write a bundle to a new folder.

    Args:
        text: text of the campaign.
        files: files that it refers to.
        folder: is created; must not exist.

    Returns:
        Path of the campaign's file.

    Raises:
        SubmissionBundleError: a name is not allowed, or a file is not in base64.
    """
    if len(files) > _FILES:
        raise SubmissionBundleError(f"{len(files)} files; a campaign refers to some, and {_FILES} are taken at most")
    contents: dict[str, bytes] = {}
    for name, coded in files.items():
        if not _NAME.fullmatch(name) or ".." in name or name == CAMPAIGN:
            raise SubmissionBundleError(
                f"files: {name[:80]!r} is not a name for one; names are words of letters, digits, '.', '_' and '-' "
                "with '/' between them"
            )
        try:
            contents[name] = base64.b64decode(coded, validate=True)
        except (binascii.Error, ValueError):
            raise SubmissionBundleError(f"files: {name}: is not in base64") from None
    folder.mkdir(parents=True, mode=0o700)
    for name, content in contents.items():
        path = folder / name
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(content)
        except (FileExistsError, NotADirectoryError, IsADirectoryError):
            raise SubmissionBundleError(f"files: {name}: is a file and a folder at once") from None
    campaign = folder / CAMPAIGN
    campaign.write_text(text, encoding="utf-8")
    return campaign


def load_confined(campaign: Path, roots: Sequence[Path], laboratory: Path | None = None) -> CampaignPlan:
    """Load a campaign that may read only given folders.

    Args:
        campaign: its file.
        roots: folders that it may read.
        laboratory: laboratory file instead of its own.

    Raises:
        ConfigError: the campaign is invalid, or it refers to a file elsewhere.
    """
    with confined([*roots, *([] if laboratory is None else [laboratory])]):
        return load_campaign(campaign, laboratory, posteriors=posterior_source)


def run_request(
    settings: DaemonSettings, item: QueueItem, rig: Rig, vessels: Mapping[str, str] | None = None
) -> RunRequest:
    """Make the run of a submitted campaign or an order from its snapshot. Reads files; don't call it in an event loop.

    Args:
        settings: of the daemon.
        item: the campaign.
        rig: that it leases.
        vessels: ids of the station's vessels at the rig, by the names that a series may give its sources.

    Raises:
        ConfigError, RunTaskError, OrderError: it can't be used.
    """
    folder = settings.snapshots / item.id
    if item.task == POUR:
        request = planned_order(settings, item, rig).request()
    else:
        plan = load_confined(folder / CAMPAIGN, [folder.resolve()], rig.source)
        theta = read_theta(folder / THETA, plan) if (folder / THETA).is_file() else None
        if plan.dispense is not None and vessels:
            named = {name: vessels[name] for name in plan.dispense.sources if name in vessels}
            plan = replace(plan, dispense=replace(plan.dispense, vessels=named))
        plan = _of_daemon(plan, settings)
        request = plan_task(plan, theta) if item.task == "plan" else TASKS[item.task](plan)  # type: ignore[index]
    if item.run is None:
        return request
    return replace(request, folder=settings.runs / item.run)


def planned_order(settings: DaemonSettings, item: QueueItem, rig: Rig) -> PlannedOrder:
    """Plan an order from its snapshot; see `run_request`."""
    folder = settings.snapshots / item.id
    planned = PlannedOrder.of(PourOrder.read(folder), rig, folder)
    return replace(planned, plan=_of_daemon(planned.plan, settings))


def _of_daemon(plan: CampaignPlan, settings: DaemonSettings) -> CampaignPlan:
    """The plan as a daemon runs it."""
    return replace(
        plan,
        # A daemon never repeats a pour by itself: it asks the operator, whatever the campaign says.
        on_unknown="ask",
        outputs=plan.outputs.model_copy(update={"directory": str(settings.runs)}),
        # All campaigns use the daemon's simulators. A submission must not make the daemon connect to another machine.
        laboratory=plan.laboratory.with_values(ray=None),
    )


class SubmissionError(RunError):
    """The submission can't be queued; the message gives the problem and a remedy."""

    exit_code = 2


@dataclass(frozen=True)
class Submission:
    """A submission: a campaign's text with its files, or the path of a file on the daemon's machine.

    Attributes:
        rig: name of the rig; '' selects the matching one.
        order: an ordered pour instead of a campaign.
        not_before: see `QueueItem`.
    """

    text: str = ""
    files: Files | None = None
    path: str = ""
    task: str = "run"
    rig: str = ""
    priority: int = 0
    order: PourOrder | None = None
    not_before: float | None = None


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
    if submission.order is not None:
        folder.mkdir(parents=True, mode=0o700)
        submission.order.write(folder)
        name = POUR
    else:
        text, files = submission.text, submission.files or {}
        if submission.path:
            text, files = _from_path(settings, submission.path)
        name = load_confined(unpack(text, files, folder), [folder.resolve()]).name
    draft = QueueItem(
        key,
        name,
        submission.task,
        "",
        "none",
        submission.priority,
        0.0,
        "queued",
        str(DesiredState.RUN),
        "",
        by,
        0.0,
        not_before=submission.not_before,
    )
    anywhere = run_request(settings, draft, Rig(ANY_RIG))
    rig = _rig(settings, submission.rig, anywhere)
    work = anywhere if rig.source is None else run_request(settings, draft, rig)
    service = RunService()
    service.check(work).require()
    service.check_laboratory(work, RunResources())
    mode = "none" if rig.name == NO_RIG else work.campaign.laboratory.mode
    item = replace(draft, id=f"{name[:40]}-{key}", rig=rig.name, mode=mode)
    folder.rename(settings.snapshots / item.id)
    return item


def _from_path(settings: DaemonSettings, text: str) -> tuple[str, Files]:
    """Pack a campaign on this machine from one of the allowed folders."""
    if not settings.roots:
        raise SubmissionError("no campaign may be submitted by its path: the daemon's settings name no 'roots'")
    candidates = [resolved(root / text) for root in settings.roots]
    with confined(settings.roots):
        path = next((file for file in candidates if file.is_file() and _inside(file, settings)), None)
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
        if wanted not in (*names, NO_RIG):
            raise SubmissionError(f"there is no rig '{wanted}'; there are {', '.join(names)}")
        if wanted == NO_RIG and work.pours:
            raise SubmissionError(f"'{NO_RIG}' is for campaigns that pour nothing; name one of {', '.join(names)}")
        return settings.rig(wanted)
    if not work.pours:
        return Rig(NO_RIG)
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
