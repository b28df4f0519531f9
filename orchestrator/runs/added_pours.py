"""Pours that somebody made and weighed without being asked, added to a run that goes on learning.

`add_pour` writes one to the journal of a run that nobody runs now. The strategy receives it when the run is resumed,
at the same place of its history every time. It does not resume the run, and it changes no pour of the run.
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

from orchestrator.campaigns.action_assignments import assigned_action
from orchestrator.campaigns.file_loading import load_campaign
from orchestrator.campaigns.prior_data import fitting
from orchestrator.learning.campaign_plan import CampaignPlan, RecordedPour
from orchestrator.learning.requests import ADDED, Outcome, Pour, Poured
from orchestrator.records.codec import Results, decode_outcome, encode_outcome
from orchestrator.records.events import Requested, RequestFinished, Told
from orchestrator.records.journal import JOURNAL_NAME, Journal
from orchestrator.records.run_record import read_header
from orchestrator.runs.resume import StageHistory, parse_answer, read_history, replay
from orchestrator.runs.run_folder import RESOLVED
from orchestrator.runs.stages import DEPLOYMENT, by_receiver, stages_of
from sim_engine.action import Action
from sim_engine.errors import InvalidArgumentError
from sim_engine.outcome import PourMeasurement
from sim_engine.scene import Scene

SOURCE = "added by hand"
"""Note of the measurement of an added pour."""


def add_pour(
    directory: Path | str,
    action: Mapping[str, float | str],
    *,
    spilled_g: float,
    received_g: float | None = None,
    retained_g: float | None = None,
    loaded_g: float | None = None,
    receiver: str | None = None,
    notes: Mapping[str, Any] | None = None,
) -> None:
    """Add a weighed pour to a run that has not finished and that nobody runs now.

    It enters the data of the deployment into its receiver as pours from before the campaign do: it is learned from, and
    does not count as one of the campaign's pours.

    Args:
        directory: folder of the run.
        action: the searched dimensions, as texts with units ('60 deg/s') or numbers in display units.
        spilled_g: mass next to the receiver [g].
        received_g: mass in the receiver [g].
        retained_g: mass left in the pourer [g]. Give it, or `received_g`.
        loaded_g: mass in the pourer before [g]; the campaign's unless given.
        receiver: name of the receiver; needed if the campaign has several.
        notes: kept with the pour; JSON-ready.

    Raises:
        InvalidArgumentError: the action, the masses or the receiver do not fit the campaign, its strategy does not
            learn from pours, or its deployment has not begun or has ended.
        RunError: another process runs it, or its journal is damaged.
        ConfigError: a file of the campaign has changed or is missing.
    """
    folder = Path(directory).expanduser()
    campaign = load_campaign(folder / RESOLVED)
    name, scene = _named(campaign, receiver)
    pour = Pour(scene.name, _action(campaign, scene, action), number=0, seed=0, purpose=ADDED)
    measured, _ = weighed_by_hand(
        1e3 * scene.liquid.mass,
        spilled_g=spilled_g,
        received_g=received_g,
        retained_g=retained_g,
        loaded_g=loaded_g,
        notes={**(notes or {}), "source": SOURCE},
    )
    _check_covered(campaign, scene, pour.action, measured)
    stage = DEPLOYMENT + name
    with closing(Journal.resume(folder / JOURNAL_NAME, read_header(folder))) as journal:
        history = read_history(journal, stage)
        if history.seed is None or history.result is not None:
            when = "has not begun" if history.seed is None else "has ended"
            raise InvalidArgumentError(
                f"the deployment into {name} {when} in {folder}; begin a run with "
                "'deployment: {data: {run: …}}' to learn from pours that were made before it"
            )
        outcome = decode_outcome(encode_outcome(Poured(measured)))
        _try(campaign, stage, history, journal.stage_results(), pour, outcome)
        key = journal.last_id() + 1
        journal.append(
            Requested(stage=stage, id=key, request=pour),
            RequestFinished(stage=stage, id=key, request=pour, outcome=outcome),
            Told(stage=stage, id=key),
        )


def _try(
    campaign: CampaignPlan, stage: str, history: StageHistory, results: Results, pour: Pour, outcome: Outcome
) -> None:
    """Replay the run with the pour: what a strategy refuses must not be written, or no run could continue."""
    definition = next(one for one in stages_of(campaign) if one.name == stage)
    strategy = definition.build(results, history.seed or 0)
    replay(strategy, history, stage)
    try:
        strategy.tell(pour, outcome)
    except ValueError:
        assert campaign.deployment is not None
        raise InvalidArgumentError(
            f"strategy {campaign.deployment.strategy} takes no pours that it has not asked for"
        ) from None


def weighed_by_hand(
    load_g: float,
    *,
    spilled_g: float,
    received_g: float | None,
    retained_g: float | None,
    loaded_g: float | None,
    notes: Mapping[str, Any],
) -> tuple[PourMeasurement, str]:
    """The measurement of weighed masses [g], and the same as the answer of an operator.

    Args:
        load_g: nominal load.
        notes: of the measurement.

    Raises:
        InvalidArgumentError: the masses do not fit the load.
    """
    loaded = load_g if loaded_g is None else loaded_g
    if (received_g is None) == (retained_g is None):
        raise InvalidArgumentError("give either received_g or retained_g")
    retained = loaded - float(received_g or 0.0) - spilled_g if retained_g is None else retained_g
    # within the balance's noise, a pourer that was emptied may seem to hold less than nothing
    retained = 0.0 if -0.02 * loaded <= retained < 0.0 and retained_g is None else retained
    answer = f"weighed {spilled_g!r} {retained!r} {loaded!r}"
    try:
        outcome = parse_answer(answer, (), 1e-3 * load_g)
    except ValueError as error:
        raise InvalidArgumentError(str(error).removeprefix(f"'{answer}': ")) from None
    assert isinstance(outcome, Poured)
    return replace(outcome.measurement, notes=dict(notes)), answer


def _named(campaign: CampaignPlan, receiver: str | None) -> tuple[str, Scene]:
    """The scene of a receiver, with its name in the campaign's stages."""
    deployment = campaign.deployment
    if deployment is None or not deployment.settings.learns_on_pours:
        raise InvalidArgumentError(
            f"campaign '{campaign.name}' learns from no pours of a deployment; 'calibration: {{pours: …}}' reads "
            "weighed pours from a table"
        )
    scenes = by_receiver(deployment)
    if receiver is None and len(scenes) == 1:
        return next(iter(scenes.items()))
    if receiver not in scenes:
        raise InvalidArgumentError(f"receiver {receiver!r} is not one of the campaign's: {', '.join(scenes)}")
    return receiver, scenes[receiver]


def _action(campaign: CampaignPlan, scene: Scene, action: Mapping[str, float | str]) -> Action:
    assert campaign.deployment is not None
    space = campaign.deployment.actions
    if missing := [name for name in space.names if name not in action]:
        raise InvalidArgumentError(f"the action lacks {', '.join(missing)}")
    return assigned_action([f"{name}={value}" for name, value in action.items()], fixed=scene.fixed, space=space)


def _check_covered(campaign: CampaignPlan, scene: Scene, action: Action, measured: PourMeasurement) -> None:
    assert campaign.deployment is not None
    pour = RecordedPour(action, measured.loaded - measured.retained, measured.spilled, measured.retained, "train")
    if left_out := fitting([pour], scene, campaign.deployment.actions).left_out:
        raise InvalidArgumentError(f"the campaign could not have asked for this action: {'; '.join(left_out)}")
