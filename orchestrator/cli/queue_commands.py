"""The daemon's commands: `decant server start`, and the commands that call the daemon over HTTP.

The HTTP client is in `orchestrator.daemon.api.daemon_client`.
"""

from __future__ import annotations

import json
import re
import secrets
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from orchestrator.cli.command_options import Campaign, Json, OtherLaboratory, Parameters, Receiver, Seed
from orchestrator.cli.console import RefusalError, print_json, print_message, print_note

if TYPE_CHECKING:
    from orchestrator.daemon.api.daemon_client import Client

CampaignId = Annotated[
    str,
    typer.Argument(
        metavar="CAMPAIGN_ID",
        help="Id as shown by 'decant queue list', or a prefix of it.",
    ),
]
CampaignOrQueue = Annotated[
    str | None,
    typer.Argument(metavar="[CAMPAIGN_ID]", help="Default: the whole queue."),
]
CampaignOrAll = Annotated[
    str | None,
    typer.Argument(metavar="[CAMPAIGN_ID]", help="Show this campaign."),
]
Url = Annotated[
    str | None, typer.Option(help="URL of the daemon; default: $DECANT_URL, or the daemon on this machine.")
]
State = Annotated[Path | None, typer.Option(help="The daemon's state directory; default: $DECANT_STATE.")]


def start(
    settings: Annotated[
        Path | None,
        typer.Argument(help="Settings file (YAML); default: a virtual laboratory."),
    ] = None,
    state: State = None,
    port: Annotated[int | None, typer.Option(min=0, max=65535, help="TCP port; 0 selects a free one.")] = None,
    simulators: Annotated[int | None, typer.Option(min=0, help="Number of simulators; 0: one per core.")] = None,
    in_process: Annotated[
        bool, typer.Option("--in-process", help="Use one simulator without Ray, for trying it out.")
    ] = False,
) -> None:
    """Run a laboratory as a service: a queue of campaigns, an HTTP API, and questions that wait for answers.

    All data are stored in one state directory. If the daemon is killed and started again, it continues where it
    stopped, and asks the operator about a pour that had started. SIGTERM or Ctrl-C stops it at the next safe point, a
    second signal at once.
    """
    from orchestrator.campaigns.yaml.file_access import resolved

    _require_extra()
    from orchestrator.daemon import server_process
    from orchestrator.daemon.state.daemon_settings import load_settings

    try:
        chosen = load_settings(
            settings,
            state=None if state is None else resolved(state),
            port=port,
            simulators=simulators,
            in_process=in_process or None,
        )
        text = f"state in {chosen.state}. 'decant queue submit CAMPAIGN' queues one"
        with server_process.log_lines():
            server_process.serve(chosen, lambda url: print_message(f"serving {url}; {text}"))
    except OSError as error:
        where = error.filename or "state directory"
        cure = "--state or $DECANT_STATE names another folder"
        raise RefusalError(f"{where}: {error.strerror}; {cure}") from None


def _require_extra() -> None:
    from sim_engine.resources import require

    for module in ("fastapi", "uvicorn", "httpx", "prometheus_client", "pythonjsonlogger"):
        require(module, "the daemon")


@contextmanager
def connected_client(url: str | None, state: Path | None) -> Iterator[Client]:
    """Open a client of the daemon; its refusals end the command."""
    _require_extra()
    from orchestrator.daemon.api.daemon_client import Client

    with Client(url, state) as client:
        yield client


def submit(
    campaign: Campaign,
    task: Annotated[str, typer.Option(help="Task: run, calibrate or plan.")] = "run",
    rig: Annotated[str, typer.Option(help="Rig to run on, if several match.")] = "",
    priority: Annotated[int, typer.Option(help="Higher priorities run first.")] = 0,
    caller_id: Annotated[
        str,
        typer.Option(
            "--id", help="Id of your own: the same campaign with the same id is queued once. Default: a new one."
        ),
    ] = "",
    not_before: Annotated[
        str | None, typer.Option(metavar="TIME", help="Earliest start with its zone: 2026-11-27T08:00:00+01:00.")
    ] = None,
    after: Annotated[
        str | None,
        typer.Option(metavar="CAMPAIGN_ID", help="Start when this campaign has ended as complete."),
    ] = None,
    after_any: Annotated[
        str | None, typer.Option(metavar="CAMPAIGN_ID", help="Start when this campaign has ended with any verdict.")
    ] = None,
    laboratory: OtherLaboratory = None,
    seed: Seed = None,
    parameters: Parameters = None,
    receiver: Receiver = None,
    iterations: Annotated[
        int | None, typer.Option(min=1, help="With --task plan: simulations instead of the campaign's.")
    ] = None,
    url: Url = None,
    state: State = None,
    as_json: Json = False,
) -> None:
    """Add a campaign to the daemon's queue, with copies of all files that it refers to.

    The daemon checks it first, as `decant run` does, which takes minutes for a rack of cups; the command waits for the
    result. Ctrl-C ends the waiting only. A campaign without `laboratory` runs on the daemon's rig.
    """
    from orchestrator.cli.foreground_run import read_campaign
    from orchestrator.daemon.rigs.submissions import names_laboratory, pack, pack_unresolved

    if after and after_any:
        raise RefusalError("--after and --after-any exclude each other: a campaign waits for one other")
    changes = (laboratory, seed, parameters, receiver, iterations)
    try:
        if changes == (None,) * 5 and not names_laboratory(campaign):
            packed, files = pack_unresolved(campaign)
        else:
            plan = read_campaign(campaign, laboratory, seed)
            if (parameters, receiver, iterations) != (None, None, None):
                from orchestrator.cli.campaign_commands import planning_request

                if task != "plan":
                    raise RefusalError("--parameters, --receiver and --iterations go with --task plan")
                plan = planning_request(plan, parameters, receiver, iterations).campaign
            packed, files = pack(plan, parameters)
    except OSError as error:
        raise RefusalError(f"{error.filename}: {error.strerror}") from None
    caller_id = caller_id or f"{campaign.stem[:40]}-{secrets.token_hex(6)}"
    if not re.match("[A-Za-z0-9]", caller_id):
        caller_id = f"id-{caller_id}"
    with connected_client(url, state) as client:
        body = {"text": packed, "files": files, "task": task, "rig": rig, "priority": priority, "id": caller_id}
        if after or after_any:
            body["after"] = {"campaign": after or after_any, "verdict": "complete" if after else "any"}
        queued = client.submit({**body, "not_before": not_before})
        if queued["state"] == "checking":
            queued = _checked(client, queued)
    if queued["state"] == "refused":
        raise RefusalError(queued["reason"])
    if as_json:
        print_json(queued)
        return
    print(queued["id"])
    print_note(f"{queued['state']} for {queued['rig']}; follow it with: decant queue logs -f {queued['id']}")
    if queued["waits_for"]:
        print_message(f"it waits for: {queued['waits_for']}")


SHOWN_EVERY = 10.0
"""Interval at which a long check is reported [s]."""


def _checked(client: Client, item: dict[str, Any]) -> dict[str, Any]:
    """Wait until a campaign has been checked, and return it; Ctrl-C returns it as it is."""
    begun = shown = time.monotonic()
    try:
        while item["state"] == "checking":
            time.sleep(0.2)
            item = client.get(f"/campaigns/{item['id']}")
            if (now := time.monotonic()) - shown > SHOWN_EVERY:
                shown = now
                print_note(f"{item['id']} is being checked: vessels, motions, devices ({now - begun:.0f} s) …")
    except KeyboardInterrupt:
        print_message(f"the check of {item['id']} goes on: decant queue list {item['id']}")
    return item


def list_campaigns(key: CampaignOrAll = None, url: Url = None, state: State = None, as_json: Json = False) -> None:
    """List campaigns, rigs, open questions and problems; or show one campaign.

    With a campaign: its progress, its pours with predictions and weights, and the audit entries.
    """
    if key is not None:
        _show(key, url, state, as_json)
        return
    with connected_client(url, state) as client:
        status, campaigns = client.get("/status"), client.get("/campaigns", limit=50)
        questions = client.get("/questions")
    if as_json:
        print_json({"status": status, "campaigns": campaigns, "questions": questions})
        return
    stops = [("", status["emergency"]), *((f" of {rig['name']}", rig["emergency"]) for rig in status["rigs"])]
    for of, stop in stops:
        if stop:
            print_message(
                f"EMERGENCY STOP{of} by {stop['by']}, {local_time(stop['time'])}: {stop['reason'] or 'no reason given'}"
            )
    for problem in status["problems"]:
        print_message(f"problem: {problem}")
    for rig in status["rigs"]:
        if (arm := rig["arm"]) and arm["state"] != "ok":
            print_message(f"arm of {rig['name']}: {arm['text']}" + (f" → {arm['advice']}" if arm["advice"] else ""))
    if status["queue_paused"]:
        print_message("the queue is paused: decant queue resume")
    rows = [("CAMPAIGN", "STATE", "RIG", "SUBMITTED", "")]
    for item in campaigns:
        rows.append((item["id"], item["state"], item["rig"], local_time(item["created"]), _standing(item)))
    widths = [max(len(row[i]) for row in rows) for i in range(4)]
    for row in rows:
        print("  ".join([*(text.ljust(width) for text, width in zip(row[:4], widths, strict=True)), row[4]]).rstrip())
    for question in questions:
        _print_question(question)


def _standing(item: dict[str, Any]) -> str:
    from orchestrator.learning.strategy import plural

    progress = item["progress"]
    if progress is None:
        reason = str(item["reason"]).split("\n", maxsplit=1)[0][:100]
        verdict = item["verdict"]["text"] if item["verdict"] else ""
        waits_for = item["waits_for"]
        if item["not_before"] and waits_for.startswith(
            "its earliest start"
        ):  # in the zone of this machine, as the rest
            waits_for = f"its earliest start, {local_time(item['not_before'])}"
        return " · ".join(filter(None, (verdict, reason, waits_for and f"waits for: {waits_for}")))
    parts = [f"{progress['stage']} ({progress['stage_index']}/{progress['stage_count']})"] if progress["stage"] else []
    if progress["of_pours"]:
        parts.append(f"{progress['pours']}/{plural(progress['of_pours'], 'pour')}")
    if progress["of_simulations"]:
        parts.append(f"{progress['simulations']}/{plural(progress['of_simulations'], 'simulation')}")
    parts += [progress["checkpoint_words"]] if progress["checkpoint_words"] else []
    return " · ".join(parts)


def _show(key: str, url: str | None, state: Path | None, as_json: bool) -> None:
    with connected_client(url, state) as client:
        item = client.get(f"/campaigns/{key}")
    if as_json:
        print_json(item)
        return
    print(f"{item['id']}: {item['state']}  ({item['task']} on {item['rig']}, {item['mode']})")
    if item["verdict"] is not None:
        print(f"  verdict    {item['verdict']['text']}")
        for goal in item["verdict"]["unmet"]:
            print(f"             {', '.join(goal['of'])}: {goal['reason']}")
    for name in ("reason", "run", "live"):
        if item[name]:
            print(f"  {name:10s} {item[name]}")
    if item["progress"] is None and item["waits_for"]:
        print(f"  now        {_standing({**item, 'reason': ''})}")
    print(f"  submitted  {local_time(item['created'])} by {item['by']}")
    if item["progress"] is not None:
        print(f"  now        {_standing(item)}")
        print(f"             {item['progress']['line']}")
    for pour in item["pours_made"]:
        told = pour["measured"] or {"unknown": "UNKNOWN"}.get(pour["state"], pour["state"])
        told += f" ({pour['loss']})" if pour["state"] == "weighed" else ""
        predicted = f"  predicted {pour['predicted']}" if pour["predicted"] else ""
        print(f"  pour {pour['number']:<3d} into {pour['receiver']}  {pour['action']}{predicted}  → {told}")
    for entry in item["audit"]:
        print(f"  {local_time(entry['t'])}  {entry['by']}: {entry['what']} {entry['detail']}".rstrip())


def logs(
    key: Annotated[
        str | None,
        typer.Argument(
            metavar="[CAMPAIGN_ID]",
            help="Only events of this campaign; default: all events.",
        ),
    ] = None,
    kinds: Annotated[
        list[str] | None, typer.Option("--kind", help="Only events of this type, such as QuestionAsked; repeatable.")
    ] = None,
    follow: Annotated[bool, typer.Option("--follow", "-f", help="Wait for new events; Ctrl-C ends it.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print every event as one line of JSON.")] = False,
    url: Url = None,
    state: State = None,
) -> None:
    """Print past events, and with -f also new events as they happen."""
    with connected_client(url, state) as client:
        try:
            for told in client.events(0, key, kinds or (), follow=follow):
                line = json.dumps({"id": told.id, **told.data}, ensure_ascii=False) if as_json else _line(told.data)
                if line:
                    print(line, flush=True)
        except KeyboardInterrupt:
            return


_PASSING = ("PourProgressed", "StrategyProgressed", "SpeculationProgressed", "RequestStarted", "StageClosed")


def _line(event: dict[str, Any]) -> str | None:
    """Format an event for the user; None for events that are not shown."""
    kind = event["type"]
    match kind:
        case _ if kind in _PASSING:
            return None
        case "LogLine":
            text = f"{event['level']}: {event['text']}"
        case "CampaignStateChanged":
            text = f"{event['before']} → {event['after']}" + (f": {event['reason']}" if event["reason"] else "")
        case "CampaignRests":
            text = f"rests: {event['state']}" + (f": {event['reason']}" if event["reason"] else "")
            text += f"; {event['verdict']['text']}" if event.get("verdict") else ""
        case "StageOpened":
            text = f"stage {event['stage']} ({event['index']}/{event['count']})"
        case "RequestFinished":
            text = _finished(event)
        case "DecisionMade":
            text = event["decision"]["text"]
        case "QuestionAsked" | "QuestionAnswered" | "QuestionClosed":
            question = event["question"]
            answered = f" → {question['answer']} ({question['by']})" if question["answer"] else ""
            text = f"question {question['id']}: {question['text']}{answered}"
        case "AuditEntry":
            text = f"{event['by']}: {event['what']} {event['detail']}".rstrip()
        case _:
            text = " ".join([kind, *(str(event[k]) for k in ("text", "rig", "state") if event.get(k))])
    return f"{local_time(event['time'])}  {event['campaign'] or 'daemon'}  {text}"


def _finished(event: dict[str, Any]) -> str:
    request, outcome = event["request"], event["outcome"]
    request_name = f"pour {request['number']}" if request["type"] == "Pour" else request["type"].lower()
    match outcome["type"]:
        case "Poured":
            masses = outcome["measurement"]
            return f"{request_name}: {1e3 * masses['spilled']:.1f} g spilled of {1e3 * masses['loaded']:.1f} g"
        case "Simulated":
            return f"{request_name}: {100 * outcome['outcome']['spilled']:.2f} % spilled"
        case "Failed":
            return f"{request_name}: failed: {outcome['reason']}"
    return f"{request_name}: {outcome['type'].lower()}"


def pause(
    key: CampaignOrQueue = None,
    now: Annotated[
        bool, typer.Option("--now", help="Stop the campaign's motion at once; a pour that has started is UNKNOWN.")
    ] = False,
    url: Url = None,
    state: State = None,
) -> None:
    """Pause a campaign at its next checkpoint: a pour that has started is finished and weighed.

    Without a campaign, the queue is paused: no campaign starts, and running ones continue. With --now, a tilted vessel
    is brought upright after the operator has agreed. A software stop is not a safety function: keep the robot's own
    emergency stop within reach.
    """
    if now and key is None:
        raise RefusalError("--now stops the motion of one campaign: name it. 'decant estop' stops every arm")
    _change(key, "abort" if now else "pause", url, state)


def resume(key: CampaignOrQueue = None, url: Url = None, state: State = None) -> None:
    """Resume a paused campaign, or the queue."""
    _change(key, "resume", url, state)


def stop(key: CampaignId, url: Url = None, state: State = None) -> None:
    """Stop a campaign, or remove it from the queue. A started pour is finished; the results are published."""
    _change(key, "stop", url, state)


def _change(key: str | None, change: str, url: str | None, state: Path | None) -> None:
    """Pause, resume, stop or abort a campaign, or pause or resume the queue if none is given."""
    with connected_client(url, state) as client:
        changed = client.post(f"/queue/{change}" if key is None else f"/campaigns/{key}/{change}")
    if key is None:
        print("queue paused" if changed["queue_paused"] else "queue resumed")
    else:
        print(f"{changed['id']}: {changed['state']}, wanted: {changed['desired_state']}")


def estop(
    words: Annotated[list[str] | None, typer.Argument(metavar="WORDS", hidden=True)] = None,
    clear: Annotated[bool, typer.Option("--clear", help="Clear the emergency stop, after the cell is safe.")] = False,
    rig: Annotated[
        str, typer.Option("--rig", help="This rig alone; without it all rigs. An unknown rig stops all.")
    ] = "",
    reason: Annotated[str, typer.Option("--reason", help="Reason for the records, of any length.")] = "",
    url: Url = None,
    state: State = None,
) -> None:
    """Emergency stop: stop every arm of the server, and give up all work until --clear.

    Further words are added to the reason: they never prevent the stop.
    A software stop is not a safety function: keep the robot's own emergency stop within reach.
    """
    reason = " ".join(filter(None, (reason, *(words or ()))))
    if clear and reason:
        raise RefusalError("--clear takes only --rig, --url and --state: nothing was cleared")
    with connected_client(url, state) as client:
        if clear:
            client.post("/emergency-stop/clear", {"rig": rig})
            print(
                f"emergency stop{f' of {rig}' if rig else ''} cleared: abandoned campaigns wait until they are resumed"
            )
            return
        stopped = client.emergency_stop(reason, rig)
    known_rig = any(each["name"] == rig and each["mode"] != "none" for each in stopped.get("rigs", ()))
    of, option = (f" of {rig}", f" --rig {rig}") if known_rig else ("", "")
    print(f"EMERGENCY STOP{of}: the work is abandoned; nothing starts there before 'decant estop --clear{option}'")
    for note in stopped["notes"]:
        print_message(f"note: {note}")


def answer(
    question: Annotated[int | None, typer.Argument(help="Number of the question.")] = None,
    text: Annotated[list[str] | None, typer.Argument(help="The answer.")] = None,
    url: Url = None,
    state: State = None,
) -> None:
    """Answer a question, or list the open questions if none is given."""
    from orchestrator.records.states import State

    with connected_client(url, state) as client:
        if question is None:
            questions = client.get("/questions")
            for q in questions:
                _print_question(q)
            if not questions:
                asking = [
                    c["id"] for c in client.get("/campaigns", limit=50) if c["state"] == State.WAITING_FOR_OPERATOR
                ]
                print_message(
                    f"the question of {asking[0]} is being prepared: the arm and the balance are read. Try again in a "
                    "moment"
                    if asking
                    else "no question is open"
                )
            return
        if not text:
            raise RefusalError(f"question {question}: what is the answer? 'decant queue answer' lists the questions")
        closed = client.post(f"/questions/{question}/answer", {"answer": " ".join(text)})
    print(f"question {closed['id']}: {closed['answer']}")


def _print_question(question: dict[str, Any]) -> None:
    print(f"\nquestion {question['id']} ({question['campaign']}, {question['rig']}), {local_time(question['asked'])}")
    if question["problem"]:
        print(f"  {question['problem']}")
    print(f"  {question['text']}")
    for name, value in question["details"].items():
        print(f"    {name}: {value}")
    wanted = " | ".join(question["options"]) or {"done": "done", "yes or no": "yes | no"}.get(
        question["wants"], "a weight, such as '203.4 g'"
    )
    print(f"  decant queue answer {question['id']} …   ({wanted})")


def enable(key: CampaignId, url: Url = None, state: State = None) -> None:
    """Enable motion for the coming part of a run: shows what will move, and requires the laboratory's name."""
    from orchestrator.cli.motion_control import announce

    if not sys.stdin.isatty():
        raise RefusalError(
            "motion of hardware is enabled by an operator, who reads what it will do and types its name: that needs "
            "a terminal"
        )
    with connected_client(url, state) as client:
        print_message("planning paths from all over the actions …")
        moves = client.get(f"/campaigns/{key}/motion")
        announce(moves["laboratory"], moves["arm"], moves["lines"])
        print("> ", end="", file=sys.stderr, flush=True)
        enabled = client.post(f"/campaigns/{key}/enable", {"laboratory": sys.stdin.readline().strip()})
    print_message(f"motion is enabled for the coming part of the run: {enabled['id']}")


def shutdown(url: Url = None, state: State = None) -> None:
    """Shut the daemon down at the next safe point; a second time: at once. The queue is kept."""
    with connected_client(url, state) as client:
        ending = client.post("/shutdown")
    if ending["at_once"] or not ending["waits_for"]:
        print("ending now; its queue is kept")
        return
    print("ending, and its queue is kept; it waits for:")
    for line in ending["waits_for"]:
        print(f"  {line}")
    print_message("a second 'decant server stop' does not wait: a pour that has begun is then UNKNOWN")


def local_time(t: float) -> str:
    """A time in the zone of this machine, with the zone; without the date if it is today's."""
    same_day = time.strftime("%Y%m%d", time.localtime(t)) == time.strftime("%Y%m%d")
    return time.strftime("%H:%M:%S %Z" if same_day else "%Y-%m-%d %H:%M %Z", time.localtime(t))
