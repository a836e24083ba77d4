"""Links and paths of the pages for readers lead somewhere."""

from __future__ import annotations

import re

import pytest

from tests.pages import GENERATED, PAGES, anchors, links
from tests.paths import ROOT

MADE = {"docker/secrets"}
"""Paths that a command of a page writes."""


@pytest.mark.parametrize("page", PAGES)
def test_every_link_leads_to_a_file_and_a_heading(page: str) -> None:
    for link in links(page):
        path, _, anchor = link.partition("#")
        target = (ROOT / page).parent / path if path else ROOT / page
        assert target.exists(), link
        assert not anchor or anchor in anchors(target.read_text()), link


def test_every_file_that_a_page_names_exists() -> None:
    folders = "analysis|benchmarks|conf|docker|docs|dopt|orchestrate|studies|tests"
    for page, text in PAGES.items():
        for path in re.findall(rf"`((?:{folders})/[\w./-]+)`", text):
            if page not in GENERATED and path not in MADE:
                assert (ROOT / path).exists(), f"{page}: {path}"


@pytest.mark.parametrize("page", PAGES)
def test_no_page_says_that_it_is_out_of_date(page: str) -> None:
    assert not re.search(r"out of date|outdated|no longer true|earlier version of", PAGES[page])
