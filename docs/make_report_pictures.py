"""Reports of the docs and their pictures: `python docs/make_report_pictures.py RUN STUDY`.

RUN and STUDY are folders of a quickstart and of the quick study that have ended. Copies both pages to docs/reports and
draws what docs/tutorials/first-pour.md shows of them. Needs Playwright and a Chromium (`--chromium`).
"""

from __future__ import annotations

import argparse
import shutil
from pathlib import Path
from typing import Any

from orchestrator.reports.html_report import REPORT_NAME
from orchestrator.study.study_page import PAGE, REPORT

DOCS = Path(__file__).parent

WIDTH = 900
"""Of a page on the screen [pixels]."""


def main() -> None:
    """Both pages and all pictures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("run", type=Path, help="folder of a quickstart")
    parser.add_argument("study", type=Path, nargs="?", help="folder of the quick study; without one its page stays")
    parser.add_argument("--chromium", default=shutil.which("chromium") or shutil.which("chromium-browser"))
    arguments = parser.parse_args()
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=arguments.chromium, args=["--no-sandbox"])
        page = browser.new_page(viewport={"width": WIDTH, "height": 1000}, color_scheme="light")
        for made, name, picture in (
            (arguments.run / REPORT_NAME, "quickstart", "report"),
            (arguments.study and arguments.study / REPORT / PAGE, "study-quick", "report-study"),
        ):
            if made is not None:
                kept = DOCS / "reports" / f"{name}.html"
                shutil.copyfile(made, kept)
                page.goto(kept.absolute().as_uri())
                first(page, DOCS / "images" / f"{picture}.png")
        browser.close()


def first(page: Any, to: Path) -> None:
    """Keep a page down to the end of its first section."""
    below = page.locator("section").first.bounding_box()
    page.screenshot(
        path=str(to),
        clip={"x": 0, "y": 0, "width": WIDTH, "height": below["y"] + below["height"] + 8},
        full_page=True,
    )


if __name__ == "__main__":
    main()
