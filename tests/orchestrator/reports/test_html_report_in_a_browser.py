"""`html_report`: report pages in a real Chromium: they open from a file, ask nobody for anything, and show all
their figures.
"""

from __future__ import annotations

import asyncio
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from orchestrator.campaigns.file_loading import load_campaign
from orchestrator.reports.publishing import publish
from orchestrator.runs.run_engine import run_campaign
from orchestrator.runs.run_folder import create_run
from tests.orchestrator.reports.test_html_report import laboratory
from tests.support.browser import browser
from tests.support.small_campaign import write_campaign

pytest.importorskip("playwright")

SHIPPED = sorted((Path(__file__).parents[3] / "docs" / "reports").glob("*.html"))

WIDTHS = (390, 1280)


@pytest.fixture(scope="module")
def chrome() -> Iterator[Any]:
    with browser() as found:
        yield found


@pytest.fixture(scope="module")
def fresh(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The page of a run that was made just now."""
    plan = load_campaign(write_campaign(tmp_path_factory.mktemp("report")))
    page = publish(plan, asyncio.run(run_campaign(plan, laboratory(), create_run(plan)))).report
    assert page is not None
    return page


@pytest.mark.slow
def test_a_report_opens_from_its_file_alone(fresh: Path, chrome: Any) -> None:
    assert len(SHIPPED) == 2
    for path in (fresh, *SHIPPED):
        for width in WIDTHS:
            opened(chrome, path, width)


def opened(chrome: Any, path: Path, width: int) -> None:
    """Look at a page as somebody does who was mailed it, without a network."""
    context = chrome.new_context(viewport={"width": width, "height": 900}, offline=True)
    page, asked, problems = context.new_page(), [], []
    page.on("request", lambda request: asked.append(request.url))
    page.on("pageerror", lambda error: problems.append(str(error)))
    page.on("console", lambda line: problems.append(line.text) if line.type in ("error", "warning") else None)
    try:
        page.goto(path.resolve().as_uri())
        page.wait_for_function("[...document.images].every(image => image.complete)")
        widths = page.evaluate("[...document.images].map(image => image.naturalWidth)")
        assert len(widths) > 3, path
        assert min(widths) > 100, f"{path}: a figure does not load"
        assert problems == [], path
        assert [url for url in asked if not url.startswith(("data:", path.resolve().as_uri()))] == [], path
        beyond = page.evaluate("document.documentElement.scrollWidth - document.documentElement.clientWidth")
        assert beyond <= 0, f"{path}: {beyond} pixels wider than a window of {width}"
    finally:
        context.close()
