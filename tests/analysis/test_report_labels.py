"""A label says of a variant what sets it apart from the others, and no more."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import pytest

from analysis.data.config_matching import Filter
from analysis.report.variants import variant_groups
from orchestrate.store import Reader
from tests.analysis.synthetic import fill, make_grid

SHORT = {"env": {"horizon": 40}}
Sections = Mapping[str, Mapping[str, object]]


def adam(rate: float) -> Sections:
    return {"learner": {"name": "adam", "window": 1, "learning_rate": rate}}


def ahead(**policy: object) -> Sections:
    return {"policy": policy}


@pytest.mark.parametrize(
    ("policies", "more", "labels"),
    [
        (
            ("d_optimal", "random"),
            [("d_optimal", adam(1e-3)), ("d_optimal", adam(1e-4))],
            [
                "D-optimal",
                "D-optimal, adam, learning_rate=0.0001",
                "D-optimal, adam, learning_rate=0.001",
                "random",
            ],
        ),
        (
            ("d_optimal", "lookahead"),
            [
                ("lookahead", ahead(lookahead=20)),
                ("lookahead", ahead(lookahead=20, criterion="joint")),
            ],
            [
                "D-optimal",
                "look-ahead",
                "look-ahead, criterion=joint, lookahead=20",
                "look-ahead, lookahead=20",
            ],
        ),
    ],
)
def test_variants_of_one_name_are_told_apart_by_all_that_is_unusual(
    policies: tuple[str, ...],
    more: list[tuple[str, Sections]],
    labels: list[str],
    tmp_path: Path,
) -> None:
    url = f"sqlite:///{tmp_path}/values.db"
    specs = make_grid(("pendulum",), policies, range(2), **SHORT)
    for policy, sections in more:
        specs += make_grid(("pendulum",), (policy,), range(2), **SHORT, **sections)
    fill(url, specs)
    with Reader.open(url) as opened:
        assert [one.label for one in variant_groups(opened, Filter())[0].variants] == labels
