"""Runs of version 0.2 are read with today's names, and names that a user gave stay."""

from __future__ import annotations

from orchestrator.journal.upgrade import renamed, upgraded_fingerprint


def test_a_laboratory_may_be_named_like_a_retired_parameter() -> None:
    today = {"name": "viscosity", "laboratory": {"name": "viscosity", "cell": None}}
    assert upgraded_fingerprint(today) == today


def test_parameters_of_version_0_2_get_their_present_names() -> None:
    assert renamed({"axes": [{"name": "viscosity", "lower": 0.0}], "fixed": {"eddies": 0.17}}) == {
        "axes": [{"name": "xsph_rate", "lower": 0.0}],
        "fixed": {"smagorinsky_constant": 0.17},
    }
