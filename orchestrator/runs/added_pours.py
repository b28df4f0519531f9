"""Entries of people in the journal of a run that nobody runs now: pours that were not asked for, and corrections.

`add_pour` adds a pour that was made and weighed without being asked, and `correct_pour` replaces an outcome that was
told wrongly. The strategy receives them when the run is resumed, at the same place of its history every time. Neither
resumes the run, and what was written stays in the journal.
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any, SupportsFloat

from orchestrator.campaigns.action_assignments import assigned_action
from orchestrator.campaigns.file_loading import load_campaign
from orchestrator.campaigns.prior_data import fitting
from orchestrator.learning.campaign_plan import CampaignPlan, RecordedPour
from orchestrator.learning.requests import ADDED, Outcome, Pour, Poured
from orchestrator.learning.stage_result import ENTERED
from orchestrator.learning.strategy import Strategy
from orchestrator.records.codec import Results, decode_outcome, encode_outcome
from orchestrator.records.events import PourCorrected, Requested, RequestFinished, Told
from orchestrator.records.journal import JOURNAL_NAME, Journal
from orchestrator.records.run_record import read_header, read_record
from orchestrator.runs.resume import (
    LOST,
    WEIGHED,
    StageHistory,
    correct,
    parse_answer,
    read_history,
    replay,
    weighed_pour,
)
from orchestrator.runs.run_folder import RESOLVED
from orchestrator.runs.stages import DEPLOYMENT, by_receiver, scenes_of, stages_of
from sim_engine.action import Action
from sim_engine.errors import InvalidArgumentError
from sim_engine.outcome import PourMeasurement
from sim_engine.scene import Scene
from sim_engine.settings.quantity import finite_number

SOURCE = "added by hand"
"""Note of the measurement of an added pour."""


def add_pour(
    directory: Path | str,
    action: Mapping[str, float | str],
    *,
    spilled_g: SupportsFloat,
    received_g: SupportsFloat | None = None,
    retained_g: SupportsFloat | None = None,
    loaded_g: SupportsFloat | None = None,
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
    folder, campaign = _opened(directory)
    name, scene = _named(campaign, receiver)
    pour = Pour(scene.name, _action(campaign, scene, action), number=0, seed=0, purpose=ADDED)
    measured, _ = weighed_by_hand(
        1e3 * scene.liquid.mass,
        spilled_g=spilled_g,
        received_g=received_g,
        retained_g=retained_g,
        loaded_g=loaded_g,
        notes={**(notes or {}), ENTERED: SOURCE},
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
        strategy = _replayed(campaign, stage, history, journal.stage_results())
        try:
            strategy.tell(pour, outcome)
        except ValueError:
            assert campaign.deployment is not None
            raise InvalidArgumentError(
                f"strategy {campaign.deployment.strategy} takes no pours that it has not asked for"
            ) from None
        key = journal.last_id() + 1
        journal.append(
            Requested(stage=stage, id=key, request=pour),
            RequestFinished(stage=stage, id=key, request=pour, outcome=outcome),
            Told(stage=stage, id=key),
        )


def correct_pour(
    directory: Path | str,
    number: int,
    *,
    stage: str | None = None,
    spilled_g: SupportsFloat | None = None,
    received_g: SupportsFloat | None = None,
    retained_g: SupportsFloat | None = None,
    loaded_g: SupportsFloat | None = None,
    answer: str | None = None,
    by: str = "",
) -> bool:
    """Correct the outcome of a pour that was told wrongly, in a run that nobody runs now.

    Both outcomes stay in the journal. The pours that were decided in between stay as they are.

    Args:
        directory: folder of the run.
        number: of the pour within its stage.
        stage: its stage; needed if several have a pour of this number.
        spilled_g, received_g, retained_g, loaded_g: as in `add_pour`.
        answer: instead of masses, the text that an operator types: 'weighed 3.2 0.4', or 'lost'.
        by: who corrects it; kept with it.

    Returns:
        Whether the run learns from the correction when it goes on. Otherwise its stage has ended: the result of the
        stage stays, and a campaign that learns from this run takes the corrected pour.

    Raises:
        InvalidArgumentError: there is no such pour with an outcome, the masses do not fit its load, or its stage can't
            replace an outcome.
        RunError: another process runs it, or its journal is damaged.
        ConfigError: a file of the campaign has changed or is missing.
    """
    folder, campaign = _opened(directory)
    same = [pour for pour in read_record(folder).pours if pour.request.number == number and pour.outcome is not None]
    if stage is not None:
        same = [pour for pour in same if pour.stage == stage]
    if len({pour.stage for pour in same}) != 1:
        stages = ", ".join(sorted({pour.stage for pour in same}))
        text = (
            f"several stages have a pour {number}; name one: {stages}" if same else f"no pour {number} has an outcome"
        )
        raise InvalidArgumentError(f"{folder}: {text}")
    pour = same[-1]
    load_g = 1e3 * scenes_of(campaign)[pour.request.scene].liquid.mass
    notes = {ENTERED: "corrected by hand"}
    if answer is None:
        masses = {"received_g": received_g, "retained_g": retained_g, "loaded_g": loaded_g}
        outcome: Outcome = Poured(weighed_by_hand(load_g, spilled_g=spilled_g, **masses, notes=notes)[0])
    else:
        try:
            parsed = parse_answer(answer, (LOST, WEIGHED), 1e-3 * load_g)
        except ValueError as error:
            raise InvalidArgumentError(str(error)) from None
        assert parsed is not None
        outcome = parsed
    with closing(Journal.resume(folder / JOURNAL_NAME, read_header(folder))) as journal:
        history = read_history(journal, pour.stage)
        outcome = decode_outcome(encode_outcome(outcome))
        if history.result is None:
            strategy = _replayed(campaign, pour.stage, history, journal.stage_results())
            try:
                correct(strategy, pour.request, outcome)
            except ValueError as error:
                raise InvalidArgumentError(f"pour {number} of stage {pour.stage}: {error}") from None
        journal.append(PourCorrected(stage=pour.stage, id=pour.id, outcome=outcome, by=by))
    return history.result is None


def _opened(directory: Path | str) -> tuple[Path, CampaignPlan]:
    folder = Path(directory).expanduser()
    return folder, load_campaign(folder / RESOLVED)


def _replayed(campaign: CampaignPlan, stage: str, history: StageHistory, results: Results) -> Strategy:
    """The strategy of a stage after its history: what it refuses must not be written, or no run could continue."""
    definition = next(each for each in stages_of(campaign) if each.name == stage)
    strategy = definition.build(results, history.seed or 0)
    replay(strategy, history, stage)
    return strategy


def weighed_by_hand(
    load_g: float,
    *,
    spilled_g: SupportsFloat | None,
    received_g: SupportsFloat | None,
    retained_g: SupportsFloat | None,
    loaded_g: SupportsFloat | None,
    notes: Mapping[str, Any],
) -> tuple[PourMeasurement, str]:
    """The measurement of weighed masses [g], and the same as the answer of an operator.

    Args:
        load_g: nominal load.
        spilled_g, received_g, retained_g, loaded_g: numbers of Python, numpy or pandas; None if not given.
        notes: of the measurement.

    Raises:
        InvalidArgumentError: a mass is not a finite number, or the masses do not fit the load.
    """
    if (received_g is None) == (retained_g is None):
        raise InvalidArgumentError("give either received_g or retained_g")
    try:
        spilled = finite_number(spilled_g, "spilled_g")
        loaded = load_g if loaded_g is None else finite_number(loaded_g, "loaded_g")
        if received_g is None:
            retained = finite_number(retained_g, "retained_g")
        else:
            received = finite_number(received_g, "received_g")
            _check_grams(spilled, received, loaded)
            retained = loaded - received - spilled
            # within the balance's noise, a pourer that was emptied may seem to hold less than nothing
            retained = 0.0 if -0.02 * loaded <= retained < 0.0 else retained
        weighed = weighed_pour(1e-3 * spilled, 1e-3 * retained, 1e-3 * loaded, nominal=1e-3 * load_g)
    except ValueError as error:
        raise InvalidArgumentError(str(error)) from None
    answer = f"weighed {spilled:.9f} {retained:.9f} {loaded:.9f}"
    return replace(weighed.measurement, notes=dict(notes)), answer


def _check_grams(spilled: float, received: float, loaded: float) -> None:
    """Raise ValueError for masses [g] that may as well be kilograms: as grams, next to nothing was poured."""
    heavy = 1e3 * received
    alone = heavy >= 0.5 * loaded and heavy + spilled <= 1.02 * loaded
    if alone or 0.5 * loaded <= heavy + 1e3 * spilled <= 1.02 * loaded:
        raise ValueError(
            f"of {loaded:g} g loaded, received_g={received:g} and spilled_g={spilled:g} may be grams, so that nearly "
            f"nothing was poured, or kilograms ({heavy:g} g received). Give grams; if it is grams, give "
            f"retained_g={loaded - received - spilled:g} instead of received_g"
        )


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
