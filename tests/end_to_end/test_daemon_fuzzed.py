"""The API held against its own description, with requests that a fuzzer makes of it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import pytest
import schemathesis
from hypothesis import HealthCheck, settings
from schemathesis.checks import not_a_server_error
from schemathesis.specs.openapi.checks import (
    content_type_conformance,
    response_headers_conformance,
    response_schema_conformance,
    status_code_conformance,
)

from orchestrator.daemon.http_api import create_app
from orchestrator.daemon.state.access_tokens import Role
from tests.support.daemon_thread import Real
from tests.support.hypothesis_examples import examples

pytestmark = pytest.mark.slow

pytest_plugins = ["schemathesis.pytest.plugin"]

SCHEMA = schemathesis.openapi.from_dict(create_app().openapi())

CHECKS = [
    not_a_server_error,
    status_code_conformance,
    content_type_conformance,
    response_headers_conformance,
    response_schema_conformance,
]


@pytest.fixture(scope="module")
def real(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Real]:
    found = Real(tmp_path_factory.mktemp("fuzzed") / "state")
    try:
        yield found
        with found.client() as client:
            assert client.get("/status")["problems"] == []
    finally:
        found.close()


def test_of(label: str) -> Callable[..., None]:
    """A test of one operation. Tests of one name, as `SCHEMA.parametrize` makes them, are one test for pytest-xdist."""

    @SCHEMA.include(name=label).parametrize()
    @settings(max_examples=examples(80), deadline=None, suppress_health_check=list(HealthCheck))
    def test(case: Any, real: Real) -> None:
        if case.operation.path.endswith("/events"):
            case.query = {**(case.query or {}), "until": "true"}
        headers = {"Authorization": f"Bearer {real.token(Role.ADMIN)}"}
        # Bearer tokens are tried in tests of their own; a fuzzer's would bar this address.
        case.headers = {k: v for k, v in (case.headers or {}).items() if k.lower() not in ("authorization", "host")}
        # 'Not ready' is 503 by convention; anywhere else it would be a defect.
        checks = [one for one in CHECKS if one is not not_a_server_error or case.operation.path != "/readyz"]
        if case.operation.path.endswith("/events"):  # the schema is that of the whole text, not of one event
            checks.remove(response_schema_conformance)
        case.call_and_validate(base_url=real.url, headers=headers, checks=checks)

    return test


test_of.__test__ = False  # type: ignore[attr-defined]
LABELS = [operation.ok().label for operation in SCHEMA.get_all_operations()]
globals().update({f"test_answers_are_as_described_of_{label}": test_of(label) for label in LABELS})
