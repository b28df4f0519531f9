"""Notifications by mail, webhook or chat when a campaign needs an operator.

Occasions are open questions, ended and failed campaigns, campaigns without news, emergency stops, and control charts
that leave their limits. Messages are sent through apprise, which supports many services by URL. Each receiver has its
own thread and a short queue, so that a slow receiver delays neither the daemon nor other receivers. `Notifier` is the
main class; `pass_on` connects it to the daemon's event feed.
"""

from __future__ import annotations

import json
import logging
import math
import os
import queue
import threading
import time
from collections.abc import AsyncIterator, Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, get_args

from actors.laboratory_settings import MODE_LABELS
from orchestrator.records.verdict import UnmetGoal
from sim_engine.settings.model import Settings, Text
from sim_engine.settings.quantity import Quantity

if TYPE_CHECKING:
    from orchestrator.daemon.state.event_feed import SentEvent

QUEUE = 50
"""Largest number of waiting messages per receiver; further messages are dropped and counted."""

TRIES, PAUSES = 3, (2.0, 10.0)
"""Number of attempts for a message, and the pauses between them [s]."""

ENVIRONMENT = "env:"

Occasion = Literal["question", "ended", "failed", "silence", "emergency", "chart"]

OCCASIONS: tuple[Occasion, ...] = get_args(Occasion)

_FOR_PERSON = ("question", "failed", "silence")
"""Occasions that need a person."""

MOST_LINES = 12
"""Largest number of lines of a message about a campaign that ended."""

_BY_PEOPLE = ("", "stopped on request")
"""Reasons of a campaign that an operator paused."""

PRESENT = 600.0
"""Time after an answer in which a person is expected to see further questions on the page [s]."""

_EVENTS_WITH_DATA = (
    "CampaignChecked",
    "CampaignLeased",
    "CampaignOpened",
    "CampaignRests",
    "QuestionAsked",
    "QuestionAnswered",
    "QuestionClosed",
    "AuditEntry",
    "ChartViolated",
)
"""Events whose data are read; of all other events only the arrival counts."""

_log = logging.getLogger(__name__)


class NotifySettings(Settings):
    """Notifications by mail, webhook or chat."""

    required: ClassVar[dict[str, str]] = {"to": "['mailtos://user:password@smtp.example.org?to=me@example.org']"}

    to: list[Text] | None = None
    """Receivers, as URLs that apprise supports ([its list](https://appriseit.com/services/)); `env:NAME` reads one from
    the environment, for URLs with secrets in them.
    """

    about: list[Occasion] | None = None
    """Occasions for a message; all by default. `question`: an operator must answer; `ended`: a campaign is finished or
    was stopped, with its verdict; `failed`: it can't continue, or a pour is UNKNOWN; `silence`: no news; `emergency`:
    an emergency stop; `chart`: a quantity of the laboratory has left its limits.
    """

    silence: Annotated[float, Quantity("s", "15 min", 1.0, 86_400.0, positive=True)] = 900.0
    """Time after which a running campaign without news, or an open question, is reported."""

    page: Text | None = None
    """Public address of the operator page; the link in messages."""


@dataclass(frozen=True)
class Notification:
    """One message."""

    occasion: Occasion
    title: str
    body: str
    type: Literal["info", "warning"] = "info"
    """As apprise has it: 'warning' for a campaign at rest whose verdict is not 'complete'."""


@dataclass
class Counts:
    """Numbers of messages of one receiver."""

    sent: int = 0
    failed: int = 0
    dropped: int = 0


class NotifyError(ValueError):
    """apprise does not support a receiver; the message names it without its secrets."""


class Notifier:
    """Sends notifications to all receivers. `note` takes every event; it returns at once and never raises.

    Args:
        receivers: URLs.
        about: occasions for a message.
        silence: time without news from a running campaign before a message is sent [s].
        page: link to the operator page.
        clock: monotonic time [s].

    Raises:
        NotifyError: a URL can't be used.
    """

    def __init__(
        self,
        receivers: Sequence[str],
        *,
        about: Sequence[Occasion] = OCCASIONS,
        silence: float = 900.0,
        page: str = "",
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._about, self._silence, self._page, self._clock = frozenset(about), silence, page, clock
        self._receivers = [_Receiver(number, url) for number, url in enumerate(receivers, start=1)]
        self._news: dict[str, _CampaignNews] = {}
        self._lock = threading.Lock()
        self._ended = threading.Event()
        self._threads = [threading.Thread(target=r.work, name=f"word to {r}", daemon=True) for r in self._receivers]
        self._threads.append(threading.Thread(target=self._watch_for_silence, name="silence", daemon=True))
        for thread in self._threads:
            thread.start()

    @property
    def counts(self) -> dict[str, Counts]:
        """Numbers of messages by receiver; receivers' names contain no secrets."""
        return {str(receiver): receiver.counts for receiver in self._receivers}

    def note(self, kind: str, data: Mapping[str, Any], campaign: str = "") -> None:
        """Process an event: its type in the daemon's feed, and its data."""
        try:
            with self._lock:
                message = self._message(kind, data, campaign)
            if message is not None:
                self._send(message)
        except Exception:  # a failed notification must never end anything else
            _log.exception("no word could be made of %s", kind)

    def close(self, timeout: float = 5.0) -> None:
        """Send waiting messages for at most this long [s], and end."""
        self._ended.set()
        for receiver in self._receivers:
            receiver.end()
        deadline = time.monotonic() + timeout
        for thread in self._threads:
            thread.join(max(deadline - time.monotonic(), 0.0))

    # ---- from events to messages

    def _message(self, kind: str, data: Mapping[str, Any], campaign: str) -> Notification | None:
        news = self._news.get(campaign)
        if news is not None:
            news.at, news.reported = self._clock(), False
        match kind:
            case "CampaignLeased":
                self._news[campaign] = _CampaignNews(self._clock(), rig=str(data.get("rig", "")))
            case "CampaignOpened" if news is not None:
                news.mode = str(data.get("mode", ""))
            case "QuestionAsked":
                question = data["question"]
                if question.get("kind") == "mixtures":
                    return None  # a program answers
                if news is not None:
                    news.question = str(question["text"])
                lines = [str(question["text"]), str(question.get("problem") or "")]
                if options := question.get("options"):
                    lines.append("Answer with one of: " + ", ".join(map(str, options)))
                return self._made("question", campaign, "an answer is needed", lines)
            case "QuestionAnswered" | "QuestionClosed" if news is not None:
                news.question, question = "", data.get("question", {})
                if kind == "QuestionAnswered":
                    news.told, news.answered = False, self._clock()
                    if question.get("about") == "unattended" and question.get("answer") == "yes":
                        news.unattended, news.answered = True, -math.inf
            case "CampaignChecked" if data["state"] == "refused":
                return self._made("failed", campaign, "is refused", [str(data["reason"])])
            case "CampaignRests":
                message = self._rests(data, campaign)
                self._news.pop(campaign, None)
                return message
            case "AuditEntry" if data.get("what") == "emergency stop":
                lines = [f"By {data.get('by')}.", str(data.get("detail") or ""), "Nothing begins before it is cleared."]
                return self._made("emergency", "", "EMERGENCY STOP", lines)
            case "ChartViolated":
                name = f"{MODE_LABELS.get(str(data.get('mode')), '')} {data['laboratory']}".strip()
                return self._made("chart", "", f"{name} is not what it was", [str(data["text"])])
        return None

    def _first(self, news: _CampaignNews | None) -> bool:
        """Whether to tell that a person is needed: in a run that had a consent for a night only the first time.

        That is once until somebody answers, and not while the one who answered is expected to be at the page.
        """
        if news is None or not news.unattended:
            return True
        if news.told or self._clock() - news.answered < PRESENT:
            return False
        news.told = True
        return True

    def _rests(self, data: Mapping[str, Any], campaign: str) -> Notification | None:
        state, reason = str(data["state"]), str(data.get("reason") or "")
        match state:
            case "unknown":
                return self._made("failed", campaign, "a pour is UNKNOWN", [reason], warn=True)
            case "failed":
                return self._made("failed", campaign, "failed", [reason], warn=True)
            case "paused":
                if reason in _BY_PEOPLE:
                    return None
                return self._made("failed", campaign, "can't go on", [reason], warn=True)
        verdict = data.get("verdict") or {"word": state, "text": "", "unmet": []}
        lines = [str(verdict["text"]), reason, *(UnmetGoal.model_validate(goal).line for goal in verdict["unmet"])]
        return self._made(
            "ended", campaign, f"is {verdict['word']}", lines[:MOST_LINES], warn=verdict["word"] != "complete"
        )

    def _made(
        self, occasion: Occasion, campaign: str, headline: str, lines: Sequence[str], *, warn: bool = False
    ) -> Notification | None:
        news = self._news.get(campaign)
        if occasion not in self._about or (occasion in _FOR_PERSON and not self._first(news)):
            return None
        mode = f"{MODE_LABELS[news.mode]} " if news is not None and news.mode in MODE_LABELS else ""
        rig = "" if news is None or not news.rig else f" at {news.rig}"
        title = f"Decant: {headline}" if not campaign else f"Decant, {mode}{campaign}{rig}: {headline}"
        body = "\n".join(filter(None, (*lines, self._page))) or title
        return Notification(occasion, title, body, "warning" if warn else "info")

    def _watch_for_silence(self) -> None:
        while not self._ended.wait(min(max(self._silence / 10.0, 0.05), 30.0)):
            self.listen_for_silence()

    def listen_for_silence(self) -> None:
        """Report campaigns without news for too long; once, until the next event."""
        messages = []
        with self._lock:
            for campaign, news in self._news.items():
                quiet = self._clock() - news.at
                if news.reported or quiet < self._silence:
                    continue
                news.reported = True
                lasts = f"{quiet / 60:.0f} min" if quiet >= 120.0 else f"{quiet:.0f} s"
                if news.question:
                    messages.append(
                        self._made("silence", campaign, f"has waited for an answer for {lasts}", [news.question])
                    )
                else:
                    lines = ["Nothing has happened in it since then: look after the bench."]
                    messages.append(self._made("silence", campaign, f"hangs: no news for {lasts}", lines))
        for message in filter(None, messages):
            self._send(message)

    def _send(self, message: Notification) -> None:
        for receiver in self._receivers:
            receiver.put(message)


async def pass_on(events: AsyncIterator[SentEvent | None], notifier: Notifier) -> None:
    """Pass the events of a feed to a notifier until the feed is closed: `pass_on(feed.read(), notifier)`."""
    async for sent in events:
        if sent is not None:
            notifier.note(sent.type, json.loads(sent.data) if sent.type in _EVENTS_WITH_DATA else {}, sent.campaign)


@dataclass
class _CampaignNews:
    """Time of a campaign's last event (monotonic), and its state as far as it is known."""

    at: float
    rig: str = ""
    mode: str = ""
    question: str = ""
    reported: bool = False
    unattended: bool = False
    """A consent for a night was given in this run."""
    told: bool = False
    """Since then, somebody was told that a person is needed, and nobody has answered."""
    answered: float = -math.inf
    """Time of the last answer since then."""


@dataclass
class _Receiver:
    """One URL with its queue and the work of its thread."""

    number: int
    url: str
    counts: Counts = field(default_factory=Counts)

    def __post_init__(self) -> None:
        from apprise import Apprise

        url = os.environ.get(self.url.removeprefix(ENVIRONMENT), "") if self.url.startswith(ENVIRONMENT) else self.url
        self._scheme = url.partition(":")[0]
        service = Apprise()
        if not url or not service.add(url):
            where = self.url if self.url.startswith(ENVIRONMENT) else f"the {self.number}. one ({self._scheme}:…)"
            raise NotifyError(f"{where}: is not a URL that apprise knows; see https://appriseit.com/services/")
        self._apprise = service
        self._messages: queue.Queue[Notification | None] = queue.Queue(QUEUE)
        self._ending = threading.Event()

    def __str__(self) -> str:
        return f"{self._scheme} ({self.number})"

    def put(self, message: Notification) -> None:
        """Queue a message, or drop it if too many are waiting."""
        try:
            self._messages.put_nowait(message)
        except queue.Full:
            self.counts.dropped += 1

    def end(self) -> None:
        """Send waiting messages with one attempt each, and end."""
        self._ending.set()
        try:
            self._messages.put_nowait(None)
        except queue.Full:
            self._messages.get_nowait()
            self.counts.dropped += 1
            self._messages.put_nowait(None)

    def work(self) -> None:
        """Send messages until the end."""
        while (message := self._messages.get()) is not None:
            if self._delivered(message):
                self.counts.sent += 1
            else:
                self.counts.failed += 1
                _log.warning("no word to %s: '%s' could not be delivered", self, message.title)

    def _delivered(self, message: Notification) -> bool:
        for attempt in range(TRIES):
            if attempt and self._ending.wait(PAUSES[attempt - 1]):
                return False
            try:
                if self._apprise.notify(title=message.title, body=message.body, notify_type=message.type):
                    return True
            except Exception:  # apprise's plug-ins may raise anything
                _log.debug("word to %s", self, exc_info=True)
        return False


def problem_of(url: str) -> str | None:
    """Describe the problem with a receiver, without its secrets; None if apprise supports it."""
    try:
        _Receiver(1, url)
    except NotifyError as error:
        return str(error).partition(": ")[2]
    return None
