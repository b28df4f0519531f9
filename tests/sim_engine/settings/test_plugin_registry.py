"""`plugin_registry`: doors: what installed packages register is found, and a broken one is named and disturbs
nobody.
"""

from __future__ import annotations

from pathlib import Path

import pytest

from sim_engine.settings.plugin_registry import PluginError, PluginRegistry


def _numbers_only(loaded: object, name: str) -> int:
    if not isinstance(loaded, int):
        raise TypeError(f"'{name}' is not a number")
    return loaded


@pytest.fixture
def door(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> PluginRegistry[int]:
    _install(tmp_path, "good", "1.0", {"seven": "good_numbers:SEVEN", "eight": "good_numbers:EIGHT"})
    (tmp_path / "good_numbers.py").write_text("SEVEN = 7\nEIGHT = 8\n")
    _install(tmp_path, "bad", "0.3", {"gone": "no_such_module:X", "word": "bad_words:WORD", "seven": "bad_words:SEVEN"})
    (tmp_path / "bad_words.py").write_text("WORD = 'nine'\nSEVEN = 77\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    return PluginRegistry("decant.test-numbers", "number", _numbers_only)


def _install(folder: Path, name: str, version: str, entries: dict[str, str]) -> None:
    info = folder / f"{name}-{version}.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n")
    rows = "".join(f"{key} = {value}\n" for key, value in entries.items())
    (info / "entry_points.txt").write_text(f"[decant.test-numbers]\n{rows}")


def test_what_packages_register_is_found_by_name(door: PluginRegistry[int]) -> None:
    assert door.get("eight") == 8
    assert door.package("eight") == "good 1.0"


def test_a_broken_plug_in_is_named_with_its_package_and_the_others_work(door: PluginRegistry[int]) -> None:
    assert door.names == ("eight", "seven")
    with pytest.raises(PluginError, match=r"'gone'.*bad 0\.3.*no_such_module"):
        door.get("gone")
    with pytest.raises(PluginError, match="'word' is not a number"):
        door.get("word")


def test_of_two_with_one_name_the_second_is_refused(door: PluginRegistry[int]) -> None:
    kept, refused = door.get("seven"), [plugin for plugin in door.broken if plugin.name == "seven"]
    assert len(refused) == 1
    assert (kept, refused[0].package) == (77, "good 1.0")
    assert "bad 0.3 has registered" in refused[0].reason


def test_an_unknown_name_is_answered_with_the_nearest(door: PluginRegistry[int]) -> None:
    with pytest.raises(PluginError, match="unknown number 'sevn'; did you mean 'seven'"):
        door.get("sevn")
