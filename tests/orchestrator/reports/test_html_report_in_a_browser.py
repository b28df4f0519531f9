"""`html_report`: report pages in a real Chromium: they open from a file, ask nobody for anything, and show all
their figures.
"""

from __future__ import annotations

import asyncio
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from actors.interfaces import PourFailedError
from orchestrator.campaigns.file_loading import load_campaign
from orchestrator.reports.publishing import publish
from orchestrator.runs.run_engine import run_campaign
from orchestrator.runs.run_folder import create_run
from tests.orchestrator.reports.test_html_report import laboratory
from tests.support.browser import browser
from tests.support.small_campaign import write_campaign
from tests.support.toy_campaign import ToyBench

pytest.importorskip("playwright")

SHIPPED = sorted((Path(__file__).parents[3] / "docs" / "reports").glob("*.html"))

WIDTHS = (390, 1280)

HIDDEN = """[...document.querySelectorAll('.scroll')].filter(table => table.scrollWidth > table.clientWidth)
.map(table => table.ariaLabel)"""
"""Tables of which a part is out of view."""

REASON = "the cups touch at the start of the pour: at tilt 37° the pourer enters the receiver by 4.1 mm"


@pytest.fixture(scope="module")
def chrome() -> Iterator[Any]:
    with browser() as found:
        yield found


@pytest.fixture(scope="module")
def fresh(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The page of a run that was made just now."""
    plan = load_campaign(write_campaign(tmp_path_factory.mktemp("report")))
    fails = iter((None, None, None, None, PourFailedError(REASON)))
    bench = ToyBench(fails=lambda seed: next(fails, None))
    page = publish(plan, asyncio.run(run_campaign(plan, laboratory(bench), create_run(plan)))).report
    assert page is not None
    return page


@pytest.mark.slow
def test_a_report_opens_from_its_file_alone(fresh: Path, chrome: Any) -> None:
    assert len(SHIPPED) == 2
    for path in (fresh, *SHIPPED):
        for width in WIDTHS:
            opened(chrome, path, width)


@pytest.mark.slow
@pytest.mark.parametrize("width", [700, 1100])
def test_no_column_of_a_table_is_out_of_view_with_a_long_remark(fresh: Path, chrome: Any, width: int) -> None:
    page = chrome.new_page(viewport={"width": width, "height": 900})
    try:
        page.goto(fresh.resolve().as_uri())
        assert page.get_by_role("cell", name=REASON).count() > 0
        assert page.evaluate(HIDDEN) == []
    finally:
        page.close()


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
