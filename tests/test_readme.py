"""The README: short, with an example that runs."""

from __future__ import annotations

import contextlib
import io

import pytest

from tests.pages import PAGES, blocks

README = PAGES["README.md"]
LONGEST = 900
"""Words that the README may have, as ``wc -w`` counts them."""


def test_it_is_short() -> None:
    assert len(README.split()) <= LONGEST


def test_its_example_runs() -> None:
    (example,) = blocks(README, "python")
    assert len(example.strip().splitlines()) <= 10
    output = io.StringIO()
    with contextlib.redirect_stdout(output):
        exec(compile(example, "README.md", "exec"), {})
    loss, states, inputs = output.getvalue().strip().split(" ", 1)[0], "(501, 2)", "(500, 1)"
    assert 0 < float(loss) < 10
    assert output.getvalue().strip().endswith(f"{states} {inputs}")


@pytest.mark.parametrize(
    "part", ["docs/figure1.png", "make figures", "make test", "@inproceedings"]
)
def test_it_has_what_a_reader_looks_for(part: str) -> None:
    assert part in README


@pytest.mark.parametrize("paper", ["NeurIPS_ML4PS_2022_37", "2304.13426"])
def test_it_cites_the_paper_and_its_successor(paper: str) -> None:
    (entries,) = blocks(README, "bibtex")
    assert paper in entries
    assert README.count(paper) >= 2  # linked in the text as well
