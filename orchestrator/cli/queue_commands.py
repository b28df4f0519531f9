"""The daemon and those who talk to it, as the command line has them: `serve`, `submit`, `list`, `show`, …"""

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
    typer.Argument(metavar="CAMPAIGN_ID", help="As 'decant list' shows it; its beginning will do.", show_default=False),
]
Url = Annotated[
    str | None,
    typer.Option(help="The daemon's address; else $DECANT_URL, or this machine's.", show_default=False),
]
State = Annotated[
    Path | None, typer.Option(help="The daemon's state directory; else $DECANT_STATE.", show_default=False)
]


def serve(
    settings: Annotated[
        Path | None, typer.Argument(help="Settings (YAML); without, a virtual laboratory.", show_default=False)
    ] = None,
    state: State = None,
    port: Annotated[int | None, typer.Option(min=0, max=65535, help="0 takes a free one.", show_default=False)] = None,
    simulators: Annotated[int | None, typer.Option(min=0, help="0: one per core.", show_default=False)] = None,
    in_process: Annotated[
        bool, typer.Option("--in-process", help="One simulator, without Ray: to try it out.")
    ] = False,
) -> None:
    """Run a laboratory as a service: a queue of campaigns, an API on this machine, questions that wait for answers.

    Everything it keeps is under one state directory; killed at any moment and started again, it goes on where it was,
    and asks about a pour that had begun. SIGTERM or Ctrl-C ends it at the next safe point, a second one at once.
    """
    from orchestrator.cli import queue_actions as verb

    call(verb.serve, settings, state=state, port=port, simulators=simulators, in_process=in_process)


def submit(
    campaign: Campaign,
    verb: Annotated[str, typer.Option("--verb", help="run, calibrate or plan.")] = "run",
    rig: Annotated[str, typer.Option(help="Which rig it is for, where several fit.", show_default=False)] = "",
    priority: Annotated[int, typer.Option(help="Higher ones come first.")] = 0,
    laboratory: OtherLaboratory = None,
    seed: Seed = None,
    parameters: Parameters = None,
    receiver: Receiver = None,
    iterations: Annotated[
        int | None,
        typer.Option(min=1, help="With --verb plan: simulations in place of the campaign's.", show_default=False),
    ] = None,
    url: Url = None,
    state: State = None,
    as_json: Json = False,
) -> None:
    """Put a campaign into the daemon's queue, with copies of everything that it refers to."""
    options = given(locals(), "campaign", "verb", "url", "state")
    from orchestrator.cli import queue_actions as module

    call(module.submit, campaign, wanted=verb, at=(url, state), **options)


def list_campaigns(url: Url = None, state: State = None, as_json: Json = False) -> None:
    """What runs, what waits, what is done; rigs, questions and problems."""
    from orchestrator.cli import queue_actions as verb

    call(verb.list_campaigns, at=(url, state), as_json=as_json)


def show(key: Key, url: Url = None, state: State = None, as_json: Json = False) -> None:
    """One campaign: where it stands, its pours with what was predicted and weighed, and who did what."""
    from orchestrator.cli import queue_actions as verb

    call(verb.show, key, at=(url, state), as_json=as_json)


def logs(
    key: Annotated[
        str | None, typer.Argument(metavar="[CAMPAIGN_ID]", help="Whose events; all of them unless given.")
    ] = None,
    follow: Annotated[bool, typer.Option("--follow", "-f", help="Go on with what comes; Ctrl-C ends it.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Every event as one line of JSON.")] = False,
    url: Url = None,
    state: State = None,
) -> None:
    """What happened, and with -f what happens."""
    from orchestrator.cli import queue_actions as verb

    call(verb.logs, key, follow=follow, as_json=as_json, at=(url, state))


def pause(
    key: Annotated[str | None, typer.Argument(metavar="[CAMPAIGN_ID]", help="Without: the queue.")] = None,
    url: Url = None,
    state: State = None,
) -> None:
    """Bring a campaign to rest at its next checkpoint: a pour that has begun is finished and weighed.

    Without a campaign the queue is paused: none is begun, what runs goes on.
    """
    from orchestrator.cli import queue_actions as verb

    call(verb.act, key, "pause", at=(url, state))


def resume(
    key: Annotated[str | None, typer.Argument(metavar="[CAMPAIGN_ID]", help="Without: the queue.")] = None,
    url: Url = None,
    state: State = None,
) -> None:
    """Go on with a campaign that rests, or with the queue."""
    from orchestrator.cli import queue_actions as verb

    call(verb.act, key, "resume", at=(url, state))


def stop(key: Key, url: Url = None, state: State = None) -> None:
    """End a campaign, or take it out of the queue. A pour is finished and weighed; what came of it is published."""
    from orchestrator.cli import queue_actions as verb

    call(verb.act, key, "stop", at=(url, state))


def abort(
    key: Annotated[str | None, typer.Argument(metavar="[CAMPAIGN_ID]", help="Without: see --all.")] = None,
    everything: Annotated[
        bool, typer.Option("--all", help="Emergency stop: every arm, everything given up, latched until --clear.")
    ] = False,
    clear: Annotated[bool, typer.Option("--clear", help="Clear the emergency stop, once all is safe.")] = False,
    rig: Annotated[
        str | None, typer.Option("--rig", help="Emergency stop of this rig alone; with --clear: clear that one.")
    ] = None,
    url: Url = None,
    state: State = None,
) -> None:
    """Stop the motion at once. What is tilted is brought upright once somebody has agreed to it.

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
    """Answer a question; without one, list those that are open."""
    from orchestrator.cli import queue_actions as verb

    call(verb.answer, question, " ".join(text or ()), at=(url, state))


def arm(key: Key, url: Url = None, state: State = None) -> None:
    """Let hardware move in the coming part of a campaign's run: shows what will move, asks for its name."""
    from orchestrator.cli import queue_actions as verb

    call(verb.arm, key, at=(url, state))


def move(
    key: Key,
    before: Annotated[str | None, typer.Option(help="In front of that campaign.", show_default=False)] = None,
    first: Annotated[bool, typer.Option("--first", help="To the head of the queue.")] = False,
    priority: Annotated[int | None, typer.Option(help="Higher ones come first.", show_default=False)] = None,
    url: Url = None,
    state: State = None,
) -> None:
    """Give a queued campaign another place."""
    from orchestrator.cli import queue_actions as verb

    call(verb.move, key, before="" if first else before, priority=priority, at=(url, state))


def shutdown(url: Url = None, state: State = None) -> None:
    """End the daemon at the next safe point; a second time: at once. Its queue is kept."""
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
    """Add the verbs to the command."""
    for name, (verb, shown) in _VERBS.items():
        app.command(name, epilog=examples(*shown), rich_help_panel="Daemon")(verb)
