"""Pictures of the live view for `docs/live-view.md`, by a headless browser: `python docs/make_live_pictures.py`.

It runs the quickstart with `--live` in a folder of its own, looks at it once while it pours, and afterwards at the tabs
of its recording: a browser without a graphics card draws a minute behind what happens. Needs Playwright and a Chromium
(`--chromium`), no display; some five minutes on two cores.
"""

from __future__ import annotations

import argparse
import contextlib
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping
from pathlib import Path

from orchestrator.journal import JOURNAL_NAME, JournalError, JournalReader, Kind
from orchestrator.monitor.live import LiveView

ROOT = Path(__file__).parents[1]

FOLDER = ROOT / "docs" / "images" / "live"

SIZE = {"width": 1920, "height": 1080}

SETTLING = 35.0
"""A software rasteriser takes so long to draw what it was sent [s]."""


TABS = {"calibrating": (60.0, 50.0), "deploying": (146.0, 50.0), "replaying": (240.0, 50.0)}
"""Where the tabs stand [pixels]: the page is one canvas, and has no elements to be found by name."""


def main() -> None:
    """All pictures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--chromium", default=shutil.which("chromium") or shutil.which("chromium-browser"))
    parser.add_argument("--recording", type=Path, help="only look at this one")
    parser.add_argument("--to", type=Path, default=FOLDER)
    arguments = parser.parse_args()
    arguments.to.mkdir(parents=True, exist_ok=True)
    recording = arguments.recording
    if recording is None:
        recording = during_a_run(arguments.chromium, arguments.to)
    with LiveView(shown=(recording,)) as view:
        look(arguments.chromium, view.url, {arguments.to / f"{name}.png": at for name, at in TABS.items()})


def during_a_run(chromium: str, to: Path) -> Path:
    """Look at a running quickstart; returns its recording."""
    with tempfile.TemporaryDirectory() as name:
        shutil.copytree(ROOT / "configs", Path(name) / "configs")
        campaign = Path(name) / "configs" / "campaigns" / "quickstart.yaml"
        with running(campaign) as (process, url, run):
            wait(process, run, poured=2)
            look(chromium, url, {to / "live.png": None})
            process.wait(1800.0)
        kept = Path(tempfile.gettempdir()) / "quickstart.rrd"
        shutil.copy(run / "campaign.rrd", kept)
        return kept


@contextlib.contextmanager
def running(campaign: Path) -> Iterator[tuple[subprocess.Popen[str], str, Path]]:
    """`decant run --live`, with the address and the run's folder that it prints."""
    command = [sys.executable, "-c", "from orchestrator.cli import main; main()", "run", str(campaign), "--live"]
    process = subprocess.Popen(
        command,
        cwd=campaign.parents[2],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
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


def wait(process: subprocess.Popen[str], run: Path, poured: int) -> None:
    """Until so many pours are in a run's journal."""
    while process.poll() is None:
        time.sleep(1.0)
        with contextlib.suppress(JournalError), JournalReader(run / JOURNAL_NAME) as journal:
            if len(list(journal.entries(kinds=[Kind.POUR_FINISHED]))) >= poured:
                return
    raise SystemExit("the run ended before it could be looked at")


def look(chromium: str, url: str, pictures: Mapping[Path, tuple[float, float] | None]) -> None:
    """Open the viewer's page, and keep what it shows once it has drawn it, of each tab that is clicked at [pixels]."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(
            executable_path=chromium,
            args=["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"],
        )
        try:
            page = browser.new_page(viewport=SIZE)  # type: ignore[arg-type]
            page.goto(url)
            time.sleep(SETTLING)
            for picture, tab in pictures.items():
                if tab is not None:
                    page.mouse.click(*tab)
                    time.sleep(SETTLING / 2.0)
                page.screenshot(path=str(picture), timeout=180_000)
                print(picture)
        finally:
            browser.close()


if __name__ == "__main__":
    main()
