"""Picture of the live view for `docs/laboratory/live-view.md`, by a headless browser.

It runs the deployment of the quickstart with `--live` in a folder of its own, and takes a screenshot while it pours.
The simulator has the parameters of the bench instead of calibrated ones, and all six pours are made: the shipped
campaign ends after the first good pour, often before a software rasteriser has drawn anything.
Needs Playwright and a Chromium (`--chromium`), no display; some three minutes on two cores.
"""

from __future__ import annotations

import argparse
import contextlib
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from actors.runtime.child_process import child_environment
from orchestrator.records.journal import JOURNAL_NAME, JournalError, JournalReader, Kind

ROOT = Path(__file__).parents[1]

FOLDER = ROOT / "docs" / "images" / "live"

SIZE = {"width": 1920, "height": 1080}

SMALL = {"width": 320, "height": 180}
"""While it catches up: a software rasteriser takes in more between two pictures if these are small."""

BENCH = {"friction": "0.35", "receiver_x": "14 mm"}
"""Ground truth of configs/laboratories/virtual.yaml."""

SETTLING = 30.0
"""So long it takes to draw a large picture well [s]."""


def main() -> None:
    """Draw the picture."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--chromium", default=shutil.which("chromium") or shutil.which("chromium-browser"))
    parser.add_argument("--to", type=Path, default=FOLDER)
    arguments = parser.parse_args()
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # what was started is ended
    arguments.to.mkdir(parents=True, exist_ok=True)
    during_a_run(arguments.chromium, arguments.to)


def during_a_run(chromium: str, to: Path) -> None:
    """Take the screenshot of a running quickstart after its third pour into the narrow cup."""
    with tempfile.TemporaryDirectory() as name:
        shutil.copytree(ROOT / "configs", Path(name) / "configs")
        campaign = Path(name) / "configs" / "campaigns" / "quickstart.yaml"
        campaign.write_text(deployment_only(campaign.read_text(encoding="utf-8")), encoding="utf-8")
        with running(campaign) as (process, url, run), looking(chromium, url) as page:
            wait(process, run, stage="deployment", kind=Kind.POUR_FINISHED, count=3)
            picture(page, to / "deploying.png")


def deployment_only(text: str) -> str:
    """Remove calibration and early ends from the quickstart, and insert the friction and the place of its bench."""
    text = re.sub(r"(?ms)^calibration:\n.*?(?=^deployment:)", "", text)
    text = re.sub(r"(?m)^  (stop|good_enough):.*\n", "", text)
    return re.sub(r"(friction|receiver_x): \[.*?\]", lambda found: f"{found[1]}: {BENCH[found[1]]}", text)


@contextlib.contextmanager
def running(campaign: Path) -> Iterator[tuple[subprocess.Popen[str], str, Path]]:
    """`decant run --live`, with the address and the run's folder that it prints."""
    command = [sys.executable, "-c", "from orchestrator.cli.app import main; main()", "run", str(campaign), "--live"]
    process = subprocess.Popen(
        command,
        cwd=campaign.parents[2],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        env=child_environment(),
    )
    try:
        assert process.stdout is not None
        said, url, run = "", None, None
        while url is None or run is None:
            line = process.stdout.readline()
            said += line
            if not line:
                raise SystemExit(f"the run ended before it could be looked at:\n{said}")
            url = url or re.search(r"http://\S+", line)
            run = run or re.search(r"^run (\S+)", line)
        import threading

        threading.Thread(target=process.stdout.read, daemon=True).start()
        yield process, url[0], campaign.parents[2] / run[1]
    finally:
        if process.poll() is None:
            process.terminate()
            process.wait(120.0)


def wait(process: subprocess.Popen[str], run: Path, *, stage: str, kind: Kind, count: int) -> None:
    """Until so many entries of a kind are in a run's journal."""
    while process.poll() is None:
        time.sleep(1.0)
        with contextlib.suppress(JournalError), JournalReader(run / JOURNAL_NAME) as journal:
            if len([entry for entry in journal.entries(kinds=[kind]) if entry.stage.startswith(stage)]) >= count:
                return
    raise SystemExit("the run ended before it could be looked at")


@contextlib.contextmanager
def looking(chromium: str, url: str) -> Iterator[Any]:
    """The viewer's page in a browser without a screen."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(
            executable_path=chromium,
            args=["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"],
        )
        try:
            page = browser.new_page(viewport=SMALL)  # type: ignore[arg-type]
            page.goto(url)
            yield page
        finally:
            browser.close()


def picture(page: Any, to: Path) -> None:
    """Take a large screenshot of a page."""
    page.set_viewport_size(SIZE)
    time.sleep(SETTLING)
    page.screenshot(path=str(to), timeout=180_000)
    page.set_viewport_size(SMALL)
    print(to, flush=True)


if __name__ == "__main__":
    main()
