"""The page of the database is true: its queries answer, its tables and views are all there are."""

from __future__ import annotations

import re

import pytest

from orchestrate.store import Reader
from orchestrate.store.schema import SCHEMA_VERSION, VIEWS, metadata
from tests.analysis.synthetic import fill, make_grid
from tests.pages import PAGES, blocks
from tests.test_docs import SHORT, TASK

DATABASE = "docs/database.md"
QUERIES = [
    (question, query)
    for block in blocks(PAGES[DATABASE], "sql")
    for question, query in [block.removeprefix("-- ").split("\n", 1)]
]
EMPTY = {"what failed, and why?"}
"""Questions to which a grid without faults has no answer."""

INNER = {"alembic_version", "curve"}
"""Tables with nothing that other tables do not hold."""


@pytest.fixture(params=["sqlite", "postgresql"])
def small(request: pytest.FixtureRequest) -> str:
    """Return a small grid in a database of each kind."""
    url = str(request.getfixturevalue(f"{request.param}_url"))
    fill(url, make_grid(("pendulum", "cartpole"), seeds=range(8), **SHORT))
    fill(url, make_grid(("pendulum",), ("random",), seeds=range(8), **SHORT, **TASK))
    rail = {"limits": {"bounds": {"y": [-1.0, 1.0]}, "enforced": False}}
    fill(url, make_grid(("cartpole",), ("random",), seeds=range(8), **SHORT, **rail))
    return url


def _answers(url: str) -> dict[str, tuple[list[str], list[tuple[object, ...]]]]:
    """Return the columns and rows of every query of the page, numbers to nine digits."""
    with Reader.open(url) as reader:
        tables = {question: reader.query(query) for question, query in QUERIES}
    return {
        question: (list(table.columns), [tuple(map(_rounded, row)) for row in table])
        for question, table in tables.items()
    }


def _rounded(value: object) -> object:
    return f"{value:.9g}" if isinstance(value, float) else value


def test_every_query_answers_and_mixes_no_configurations(small: str) -> None:
    """A second configuration of a policy adds rows, but changes none and doubles no step."""
    before = _answers(small)
    for question, (_, rows) in before.items():
        assert rows or question in EMPTY, question
    other = {"env": {"horizon": 40, "gamma": 3.0}}
    fill(small, make_grid(("pendulum", "cartpole"), seeds=range(6), **other))
    fill(
        small,
        make_grid(("cartpole",), ("d_optimal",), range(6), policy={"regularization": 0.1}, **SHORT),
    )
    for question, (columns, rows) in _answers(small).items():
        assert set(before[question][1]) <= set(rows), question
        assert len(set(rows)) == len(rows), question
        if "t" in columns and "config_key" not in columns:
            steps = [row[columns.index("t")] for row in rows]
            assert len(set(steps)) == len(steps), question


def test_every_column_of_the_schema_is_described() -> None:
    described = re.findall(r"^\| `(\w+)` \| `(\w+)` \|", PAGES[DATABASE], flags=re.MULTILINE)
    own = [table for table in metadata.tables.values() if table.name not in INNER]
    stored = [(table.name, column.name) for table in own for column in table.columns]
    assert sorted(described) == sorted(stored)


def test_the_page_counts_its_queries() -> None:
    numbers = {"Six": 6, "Seven": 7, "Eight": 8, "Nine": 9}
    (said,) = re.findall(r"^## (\w+) useful queries$", PAGES[DATABASE], flags=re.MULTILINE)
    assert numbers[said] == len(QUERIES)


def test_every_table_and_view_is_described() -> None:
    page = PAGES[DATABASE]
    for name in (*metadata.tables, *VIEWS):
        assert f"`{name}`" in page or name == "alembic_version", name
    assert f"The schema is version {SCHEMA_VERSION}." in page


def test_every_column_of_a_view_is_named(sqlite_url: str) -> None:
    fill(sqlite_url, [])
    page = PAGES[DATABASE]
    shared = re.findall(r"`(\w+)`", page.split("Every view has the columns ")[1].split("|")[0])
    with Reader.open(sqlite_url) as reader:
        for view in VIEWS:
            (row,) = re.findall(rf"^\| `{view}` \| [^|]+ \| (.*) \|$", page, flags=re.MULTILINE)
            found = reader.query(f"SELECT * FROM {view}").columns
            assert list(found) == [*shared, *re.findall(r"`(\w+)`", row)], view
