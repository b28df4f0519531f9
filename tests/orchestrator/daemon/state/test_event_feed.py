"""`event_feed`: events of one campaign, and of some types, are read by an index and in their order."""

from __future__ import annotations

import asyncio
from collections.abc import Collection
from pathlib import Path

from orchestrator.daemon.state.event_feed import RING, Feed


def filled(path: Path) -> Feed:
    """A feed of two campaigns whose older half is on disk alone."""
    feed = Feed(path)
    for number in range(2 * RING):
        campaign, kind = ("a", "b")[number % 2], "LogLine" if number % 400 > 3 else "QuestionAsked"
        feed.publish(kind, {"number": number}, campaign)
    return feed


def read(feed: Feed, campaign: str | None = None, kinds: Collection[str] = ()) -> list[int]:
    async def work() -> list[int]:
        return [sent.id async for sent in feed.read(0, campaign, kinds, until=feed.last) if sent is not None]

    return asyncio.run(work())


def test_events_are_filtered_by_campaign_and_type_from_disk_and_memory(tmp_path: Path) -> None:
    feed = filled(tmp_path / "events.sqlite")
    everything = read(feed)
    assert everything == list(range(1, 2 * RING + 1))
    assert read(feed, "a") == everything[::2]
    asked = [number for number in everything if (number - 1) % 400 <= 3]
    assert read(feed, None, ["QuestionAsked"]) == asked
    assert read(feed, "b", ["QuestionAsked", "AuditEntry"]) == [number for number in asked if number % 2 == 0]
    assert read(feed, "c") == []
    feed.close()


def test_one_campaign_is_found_by_an_index_in_one_query(tmp_path: Path) -> None:
    feed = filled(tmp_path / "events.sqlite")
    feed.publish("CampaignRests", {}, "finished long ago")
    for _ in range(2 * RING):
        feed.publish("LogLine", {}, "a")
    feed.flush()
    statements: list[str] = []
    feed._db.set_trace_callback(statements.append)  # type: ignore[union-attr]
    assert len(read(feed, "finished long ago")) == 1
    queries = [text for text in statements if text.startswith("select")]
    assert len(queries) == 1
    feed._db.set_trace_callback(None)  # type: ignore[union-attr]
    (plan,) = feed._db.execute(f"explain query plan {queries[0]}").fetchall()  # type: ignore[union-attr]
    assert "event_by_campaign" in plan[-1]
    feed.close()


def test_the_index_is_added_to_a_file_of_an_earlier_version(tmp_path: Path) -> None:
    feed = filled(tmp_path / "events.sqlite")
    feed._db.execute("drop index event_by_campaign")  # type: ignore[union-attr]
    feed.close()
    again = Feed(tmp_path / "events.sqlite")
    names = [row[0] for row in again._db.execute("select name from sqlite_schema where type = 'index'")]  # type: ignore[union-attr]
    assert "event_by_campaign" in names
    again.close()
