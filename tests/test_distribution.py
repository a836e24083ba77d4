"""Distribution of the tests over workers: a group stays in one of them."""

from __future__ import annotations

import pytest


@pytest.mark.xdist_group("alone")
def test_a_group_is_known_to_the_scheduler(request: pytest.FixtureRequest) -> None:
    """Where pytest and pytest-xdist do not fit, each worker starts what a group shares."""
    grouped = getattr(request.config.option, "loadgroup", False)
    assert request.node.nodeid.endswith("@alone") == grouped
