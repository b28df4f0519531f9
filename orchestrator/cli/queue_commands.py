"""Options and help texts of the daemon's commands: `serve`, `submit`, `list`, `show` and others.

Their work is done in `queue_actions`.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import typer

from orchestrator.cli.command_options import (
    Campaign,
    Json,
    OtherLaboratory,
    Parameters,
    Receiver,
    Seed,
    call,
    examples,
    given,
)

Key = Annotated[
    str,
    typer.Argument(metavar="CAMPAIGN_ID", help="Id as shown by 'decant list', or a prefix of it.", show_default=False),
]
Url = Annotated[
    str | None,
    typer.Option(help="URL of the daemon; default: $DECANT_URL, or the daemon on this machine.", show_default=False),
]
State = Annotated[
    Path | None, typer.Option(help="The daemon's state directory; default: $DECANT_STATE.", show_default=False)
]


def serve(
    settings: Annotated[
        Path | None, typer.Argument(help="Settings file (YAML); default: a virtual laboratory.", show_default=False)
    ] = None,
    state: State = None,
    port: Annotated[
        int | None, typer.Option(min=0, max=65535, help="TCP port; 0 selects a free one.", show_default=False)
    ] = None,
    simulators: Annotated[
        int | None, typer.Option(min=0, help="Number of simulators; 0: one per core.", show_default=False)
    ] = None,
    in_process: Annotated[
        bool, typer.Option("--in-process", help="Use one simulator without Ray, for trying it out.")
    ] = False,
) -> None:
    """Run a laboratory as a service: a queue of campaigns, an HTTP API, and questions that wait for answers.

    All data are stored in one state directory. If the daemon is killed and started again, it continues where it
    stopped, and asks the operator about a pour that had started. SIGTERM or Ctrl-C stops it at the next safe point, a
    second signal at once.
    """
    from orchestrator.cli import queue_actions as verb

    call(verb.serve, settings, state=state, port=port, simulators=simulators, in_process=in_process)


def submit(
    campaign: Campaign,
    verb: Annotated[str, typer.Option("--verb", help="Task: run, calibrate or plan.")] = "run",
    rig: Annotated[str, typer.Option(help="Rig to run on, if several match.", show_default=False)] = "",
    priority: Annotated[int, typer.Option(help="Higher priorities run first.")] = 0,
    laboratory: OtherLaboratory = None,
    seed: Seed = None,
    parameters: Parameters = None,
    receiver: Receiver = None,
    iterations: Annotated[
        int | None,
        typer.Option(min=1, help="With --verb plan: simulations instead of the campaign's.", show_default=False),
    ] = None,
    url: Url = None,
    state: State = None,
    as_json: Json = False,
) -> None:
    """Add a campaign to the daemon's queue, with copies of all files that it refers to."""
    options = given(locals(), "campaign", "verb", "url", "state")
    from orchestrator.cli import queue_actions as module

    call(module.submit, campaign, wanted=verb, at=(url, state), **options)


def list_campaigns(url: Url = None, state: State = None, as_json: Json = False) -> None:
    """List campaigns, rigs, open questions and problems."""
    from orchestrator.cli import queue_actions as verb

    call(verb.list_campaigns, at=(url, state), as_json=as_json)


def show(key: Key, url: Url = None, state: State = None, as_json: Json = False) -> None:
    """Show one campaign: its progress, its pours with predictions and weights, and the audit entries."""
    from orchestrator.cli import queue_actions as verb

    call(verb.show, key, at=(url, state), as_json=as_json)


def logs(
    key: Annotated[
        str | None, typer.Argument(metavar="[CAMPAIGN_ID]", help="Only events of this campaign; default: all events.")
    ] = None,
    follow: Annotated[bool, typer.Option("--follow", "-f", help="Wait for new events; Ctrl-C ends it.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print every event as one line of JSON.")] = False,
    url: Url = None,
    state: State = None,
) -> None:
    """Print past events, and with -f also new events as they happen."""
    from orchestrator.cli import queue_actions as verb

    call(verb.logs, key, follow=follow, as_json=as_json, at=(url, state))


def pause(
    key: Annotated[str | None, typer.Argument(metavar="[CAMPAIGN_ID]", help="Default: the whole queue.")] = None,
    url: Url = None,
    state: State = None,
) -> None:
    """Pause a campaign at its next checkpoint: a pour that has started is finished and weighed.

    Without a campaign, the queue is paused: no campaign starts, and running ones continue.
    """
    from orchestrator.cli import queue_actions as verb

    call(verb.act, key, "pause", at=(url, state))


def resume(
    key: Annotated[str | None, typer.Argument(metavar="[CAMPAIGN_ID]", help="Default: the whole queue.")] = None,
    url: Url = None,
    state: State = None,
) -> None:
    """Resume a paused campaign, or the queue."""
    from orchestrator.cli import queue_actions as verb

    call(verb.act, key, "resume", at=(url, state))


def stop(key: Key, url: Url = None, state: State = None) -> None:
    """Stop a campaign, or remove it from the queue. A started pour is finished; the results are published."""
    from orchestrator.cli import queue_actions as verb

    call(verb.act, key, "stop", at=(url, state))


def abort(
    key: Annotated[str | None, typer.Argument(metavar="[CAMPAIGN_ID]", help="Campaign to abort; or use --all.")] = None,
    everything: Annotated[
        bool, typer.Option("--all", help="Emergency stop: stop every arm and give up all work until --clear.")
    ] = False,
    clear: Annotated[bool, typer.Option("--clear", help="Clear the emergency stop, after the cell is safe.")] = False,
    rig: Annotated[
        str | None, typer.Option("--rig", help="Emergency stop of this rig alone; with --clear: clear it.")
    ] = None,
    url: Url = None,
    state: State = None,
) -> None:
    """Stop the motion at once. A tilted vessel is brought upright after the operator has agreed.

    A software stop is not a safety function: keep the robot's own emergency stop within reach.
    """
    from orchestrator.cli import queue_actions as verb

    call(verb.abort, key, everything=everything, clear=clear, rig=rig, at=(url, state))


def answer(
    question: Annotated[int | None, typer.Argument(help="Number of the question.", show_default=False)] = None,
    text: Annotated[list[str] | None, typer.Argument(help="The answer.", show_default=False)] = None,
    url: Url = None,
    state: State = None,
) -> None:
    """Answer a question, or list the open questions if none is given."""
    from orchestrator.cli import queue_actions as verb

    call(verb.answer, question, " ".join(text or ()), at=(url, state))


def arm(key: Key, url: Url = None, state: State = None) -> None:
    """Enable motion for the coming part of a run: shows what will move, and requires the laboratory's name."""
    from orchestrator.cli import queue_actions as verb

    call(verb.arm, key, at=(url, state))


def move(
    key: Key,
    before: Annotated[str | None, typer.Option(help="Move in front of this campaign.", show_default=False)] = None,
    first: Annotated[bool, typer.Option("--first", help="Move to the head of the queue.")] = False,
    priority: Annotated[int | None, typer.Option(help="Higher priorities run first.", show_default=False)] = None,
    url: Url = None,
    state: State = None,
) -> None:
    """Move a queued campaign to another place."""
    from orchestrator.cli import queue_actions as verb

    call(verb.move, key, before="" if first else before, priority=priority, at=(url, state))


def shutdown(url: Url = None, state: State = None) -> None:
    """Shut the daemon down at the next safe point; a second time: at once. The queue is kept."""
    from orchestrator.cli import queue_actions as verb

    call(verb.shutdown, at=(url, state))


_VERBS: dict[str, tuple[Callable[..., None], tuple[str, ...]]] = {
    "serve": (serve, ("decant serve", "decant serve lab.yaml --port 0", "decant serve --state /tmp/try --in-process")),
    "submit": (
        submit,
        (
            "decant submit configs/campaigns/quickstart.yaml",
            "decant submit my.yaml --rig left --priority 5",
            "decant submit my.yaml --verb plan --parameters theta.json --receiver configs/vessels/bowl.yaml",
        ),
    ),
    "list": (list_campaigns, ("decant list", "decant list --json")),
    "show": (show, ("decant show quickstart-3f2a1c",)),
    "logs": (logs, ("decant logs -f", "decant logs quickstart-3f2a1c --json")),
    "pause": (pause, ("decant pause quickstart-3f2a1c", "decant pause   # the queue")),
    "resume": (resume, ("decant resume quickstart-3f2a1c", "decant resume   # the queue")),
    "stop": (stop, ("decant stop quickstart-3f2a1c",)),
    "abort": (
        abort,
        ("decant abort quickstart-3f2a1c", "decant abort --all", "decant abort --rig left", "decant abort --clear"),
    ),
    "answer": (answer, ("decant answer", "decant answer 7 done", "decant answer 8 weighed 3.2 0.4")),
    "arm": (arm, ("decant arm narrow-1b2c3d",)),
    "move": (move, ("decant move narrow-1b2c3d --first",)),
    "shutdown": (shutdown, ("decant shutdown",)),
}


def register(app: typer.Typer) -> None:
    """Add the commands to the application."""
    for name, (verb, shown) in _VERBS.items():
        app.command(name, epilog=examples(*shown), rich_help_panel="Daemon")(verb)
