"""Run by `test_generated_client` with the interpreter of openapi-python-client: a program that knows the generated
client only. Arguments: URL, token, campaign's file, and its files as JSON.
"""

from __future__ import annotations

import base64
import json
import sys
import time
from datetime import UTC, datetime, timedelta
from pathlib import Path

from decant_client import AuthenticatedClient
from decant_client.api.default import answer, campaign, events, metrics, questions, report, submit
from decant_client.models import AnswerIn, SubmissionIn, SubmissionInFiles

url, token, path, names = sys.argv[1:]
client = AuthenticatedClient(url, token, timeout=60.0)
folder = Path(path).parent
files = SubmissionInFiles()
for name, other in json.loads(names).items():
    files[name] = base64.b64encode((folder / other).read_bytes()).decode()
soon = datetime.now(UTC) - timedelta(minutes=1)
body = SubmissionIn(id="generated-1", text=Path(path).read_text(encoding="utf-8"), files=files, not_before=soon)
first, again = [submit.sync(client=client, body=body) for _ in range(2)]
assert first.id == again.id, (first, again)
answered = 0
while True:
    item = campaign.sync(first.id, client=client)
    for question in questions.sync(client=client):
        print("question:", question.text)
        answer.sync(question.id, client=client, body=AnswerIn(answer="done"))
        answered += 1
    if item.state in ("finished", "failed", "refused", "paused", "unknown"):
        break
    time.sleep(0.2)
stream = events.sync_detailed(client=client, campaign=first.id, after=0, until=True, kind=["QuestionAnswered"])
assert stream.parsed.count("event: QuestionAnswered") == answered
assert "decant_pours_total" in metrics.sync(client=client)
assert report.sync(first.id, client=client).lstrip().startswith("<!")
print(json.dumps({"state": item.state, "reason": item.reason, "verdict": item.verdict.word, "answered": answered}))
