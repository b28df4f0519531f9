"""A folder of good and bad inputs, written once for each worker."""

from __future__ import annotations

from pathlib import Path
from typing import NoReturn

import pytest

from tests.support.cli_inputs import write_inputs


@pytest.fixture(scope="session")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("inputs")
    write_inputs(folder)
    return folder


@pytest.fixture
def folder(inputs: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The working directory, in which nothing can be started."""
    from actors import laboratory
    from sim_engine.simulator import PourSimulator

    def started(*args: object, **kwargs: object) -> NoReturn:
        raise AssertionError("something was started")

    monkeypatch.setattr(laboratory, "open_laboratory", started)
    monkeypatch.setattr(PourSimulator, "simulate", started)
    monkeypatch.chdir(inputs)
    return inputs
