"""`app`: how soon bad input is refused; `tests/golden` has the words."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.support.cli_inputs import process


@pytest.mark.slow
@pytest.mark.parametrize(
    "command",
    [
        pytest.param("run misspelt.yaml", marks=pytest.mark.slow),
        "run open-mesh.yaml",
        pytest.param("plan small.yaml --receiver small.yaml", marks=pytest.mark.slow),
        "simulate small.yaml --set angular_velocity=100 --set x_offset=10",
    ],
)
def test_refusing_wakes_nothing_heavy(command: str, inputs: Path) -> None:
    done = process(command, inputs)
    assert done.returncode == 2
    assert done.stderr.splitlines()[-1] == "loaded:"
    assert not (inputs / "runs").exists()
