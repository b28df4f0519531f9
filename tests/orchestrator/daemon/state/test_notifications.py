"""`notifications`: word to people who are elsewhere, through real receivers: a web server, a mail server, a port
that never answers.
"""

from __future__ import annotations

import json
import logging
import socket
import socketserver
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

import pytest

from orchestrator.daemon.state import notifications as notify
from orchestrator.daemon.state.notifications import QUEUE, Notifier, NotifyError
from tests.support.waiting import PATIENCE, wait_for


class WebReceiver:
    """A web server that takes what apprise posts as JSON; `refuse` so many times at first."""

    def __init__(self, refuse: int = 0) -> None:
        self.messages: list[dict[str, Any]] = []
        self.refuse = refuse
        outer = self

        class Handler(BaseHTTPRequestHandler):
            def do_POST(self) -> None:
                body = self.rfile.read(int(self.headers["content-length"]))
                outer.refuse -= 1
                if outer.refuse >= 0:
                    self.send_error(503)
                    return
                outer.messages.append(json.loads(body))
                self.send_response(200)
                self.end_headers()

            def log_message(self, *args: Any) -> None:
                pass

        self._server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self.url = f"json://127.0.0.1:{self._server.server_port}/hook"
        threading.Thread(target=self._server.serve_forever, daemon=True).start()

    def close(self) -> None:
        self._server.shutdown()
        self._server.server_close()


@pytest.fixture
def web() -> Iterator[WebReceiver]:
    receiver = WebReceiver()
    yield receiver
    receiver.close()


class MailReceiver(socketserver.StreamRequestHandler):
    """As much of SMTP (RFC 5321) as a client needs to hand over a mail."""

    letters: list[str]

    def handle(self) -> None:
        self.wfile.write(b"220 sink\r\n")
        while line := self.rfile.readline():
            verb = line.split()[0].upper()
            if verb == b"DATA":
                self.wfile.write(b"354 go on\r\n")
                text = b""
                while (part := self.rfile.readline()) != b".\r\n":
                    text += part
                type(self).letters.append(text.decode())
            self.wfile.write(b"221 bye\r\n" if verb == b"QUIT" else b"250 fine\r\n")
            if verb == b"QUIT":
                return


QUESTION = {"question": {"text": "Refill the beaker to 200 g", "problem": "", "options": []}}


def begun(notifier: Notifier, campaign: str = "narrow-1a2b", mode: str = "hardware") -> None:
    notifier.note("CampaignLeased", {"rig": "north"}, campaign)
    notifier.note("CampaignOpened", {"mode": mode}, campaign)


def test_people_are_told_of_questions_ends_failures_and_emergencies(web: WebReceiver) -> None:
    notifier = Notifier([web.url], page="https://lab.example/")
    begun(notifier)
    notifier.note("QuestionAsked", QUESTION, "narrow-1a2b")
    notifier.note("CampaignRests", {"state": "unknown", "reason": "nobody knows what came of pour 3"}, "narrow-1a2b")
    begun(notifier, "other-9", "virtual")
    notifier.note("CampaignRests", {"state": "finished", "reason": ""}, "other-9")
    notifier.note("AuditEntry", {"what": "emergency stop", "by": "anna", "detail": "smoke"})
    notifier.close()
    told = [(m["title"], m["message"]) for m in web.messages]
    assert [title for title, _ in told] == [
        "Decant, REAL narrow-1a2b at north: an answer is needed",
        "Decant, REAL narrow-1a2b at north: a pour is UNKNOWN",
        "Decant, VIRTUAL other-9 at north: is finished",
        "Decant: EMERGENCY STOP",
    ]
    assert "Refill the beaker to 200 g" in told[0][1]
    assert "https://lab.example/" in told[0][1]
    assert "smoke" in told[3][1]
    assert notifier.counts["json (1)"].sent == 4


def test_a_chart_out_of_control_is_a_message_with_what_to_check(web: WebReceiver) -> None:
    event = {"laboratory": "north", "mode": "hardware", "quantity": "film_g", "text": "film: 6 high; check: dry it"}
    notifier = Notifier([web.url])
    notifier.note("ChartViolated", event)
    notifier.close()
    others = Notifier([web.url], about=["question"])
    others.note("ChartViolated", event)
    others.close()
    assert [(m["title"], m["message"]) for m in web.messages] == [
        ("Decant: REAL north is not what it was", "film: 6 high; check: dry it")
    ]


def test_what_people_did_themselves_is_not_told_to_them(web: WebReceiver) -> None:
    notifier = Notifier([web.url], about=["failed", "ended"])
    begun(notifier)
    notifier.note("QuestionAsked", QUESTION, "narrow-1a2b")
    notifier.note("CampaignRests", {"state": "paused", "reason": "stopped on request"}, "narrow-1a2b")
    begun(notifier)
    notifier.note("CampaignRests", {"state": "paused", "reason": "3 MB are free"}, "narrow-1a2b")
    notifier.close()
    assert [m["title"] for m in web.messages] == ["Decant, REAL narrow-1a2b at north: can't go on"]


def test_a_mail_is_delivered(monkeypatch: pytest.MonkeyPatch) -> None:
    MailReceiver.letters = []
    with socketserver.ThreadingTCPServer(("127.0.0.1", 0), MailReceiver) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        port = server.server_address[1]
        url = f"mailto://127.0.0.1:{port}?from=decant@lab.example&to=anna@lab.example&smtp=127.0.0.1&mode=insecure"
        monkeypatch.setenv("DECANT_MAIL", url)
        notifier = Notifier(["env:DECANT_MAIL"])
        begun(notifier)
        notifier.note("QuestionAsked", QUESTION, "narrow-1a2b")
        notifier.close(PATIENCE)
        server.shutdown()
    (letter,) = MailReceiver.letters
    assert "anna@lab.example" in letter
    assert "Refill the beaker" in letter


def test_a_campaign_without_news_is_told_once_until_it_gives_some(web: WebReceiver) -> None:
    now = [0.0]
    notifier = Notifier([web.url], silence=600.0, clock=lambda: now[0])
    begun(notifier)
    for later in (599.0, 601.0, 900.0):
        now[0] = later
        notifier.listen_for_silence()
    notifier.note("RequestFinished", {}, "narrow-1a2b")
    now[0] = 1300.0
    notifier.listen_for_silence()
    notifier.note("QuestionAsked", QUESTION, "narrow-1a2b")
    now[0] = 2000.0
    notifier.listen_for_silence()
    notifier.note("CampaignRests", {"state": "finished"}, "narrow-1a2b")
    now[0] = 9000.0
    notifier.listen_for_silence()
    notifier.close()
    assert [m["title"].partition(": ")[2] for m in web.messages] == [
        "hangs: no news for 10 min",
        "an answer is needed",
        "has waited for an answer for 12 min",
        "is finished",
    ]


def test_of_a_night_the_first_thing_that_needs_a_person_is_told_once(web: WebReceiver) -> None:
    now = [0.0]
    notifier = Notifier([web.url], silence=600.0, clock=lambda: now[0])

    def asked(about: str, answer: str = "") -> None:
        question = {"text": about, "about": about}
        notifier.note("QuestionAsked", {"question": question}, "night")
        if answer:
            notifier.note("QuestionAnswered", {"question": {**question, "answer": answer}}, "night")

    begun(notifier, "night")
    asked("unattended", "yes")
    now[0] = 30.0
    asked("recover")
    now[0] = 700.0
    notifier.listen_for_silence()  # nobody has come
    asked("recover", "yes")
    now[0] = 710.0
    asked("home", "yes")  # the one who came is at the page
    asked("laid_out")
    now[0] = 2000.0
    asked("tray_full")  # and has left again
    notifier.note("CampaignRests", {"state": "paused", "reason": "no answer within 1800 s"}, "night")
    begun(notifier, "night")
    notifier.note("CampaignRests", {"state": "failed", "reason": "no balance"}, "night")  # of a run without a consent
    notifier.close()
    assert [m["message"].partition("\n")[0] for m in web.messages] == [
        "unattended",
        "recover",
        "tray_full",
        "no balance",
    ]


def test_silence_is_noticed_without_anybody_asking(web: WebReceiver) -> None:
    notifier = Notifier([web.url], silence=0.2)
    begun(notifier)
    wait_for(lambda: bool(web.messages))
    assert "hangs" in web.messages[0]["title"]
    notifier.close()


def test_a_dead_receiver_slows_nothing_and_is_counted(
    web: WebReceiver, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """It takes connections and does not answer; the other receiver gets everything meanwhile."""
    monkeypatch.setattr(notify, "PAUSES", (0.0, 0.0))
    with caplog.at_level(logging.WARNING):
        dead = socket.create_server(("127.0.0.1", 0))
        url = f"json://127.0.0.1:{dead.getsockname()[1]}/?rto=9999&cto=9999"
        notifier = Notifier([url, web.url], about=["question"])
        begun(notifier)
        for _ in range(QUEUE + 20):  # would never come to an end if a note waited for the receiver
            notifier.note("QuestionAsked", QUESTION, "narrow-1a2b")
        dead.close()  # ends the connections
        ours, theirs = notifier.counts["json (1)"], notifier.counts["json (2)"]
        wait_for(lambda: theirs.sent + theirs.dropped == QUEUE + 20)
        wait_for(lambda: ours.failed > 0)
        assert ours.sent == 0
        assert ours.dropped >= 10
        wait_for(lambda: any("json (1)" in record.getMessage() for record in caplog.records))
        notifier.close(0.0)


def test_a_receiver_that_fails_at_first_is_tried_again(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(notify, "PAUSES", (0.0, 0.0))
    receiver = WebReceiver(refuse=2)
    notifier = Notifier([receiver.url])
    begun(notifier)
    notifier.note("QuestionAsked", QUESTION, "narrow-1a2b")
    wait_for(lambda: notifier.counts["json (1)"].sent == 1)
    notifier.close()
    receiver.close()
    assert len(receiver.messages) == 1


@pytest.mark.parametrize("url", ["nonsense://user:secret@host", "env:NOT_SET_ANYWHERE", ""])
def test_a_receiver_that_nobody_knows_is_refused_without_its_secrets(url: str) -> None:
    with pytest.raises(NotifyError, match="is not a URL that apprise knows") as error:
        Notifier([url])
    assert "secret" not in str(error.value)


def test_whatever_is_noted_nothing_is_raised(web: WebReceiver) -> None:
    notifier = Notifier([web.url])
    notifier.note("QuestionAsked", {}, "narrow-1a2b")
    notifier.note("CampaignRests", {}, "")
    notifier.close()
