"""Sizes and positions in a real browser: tiles, hover values, legends, and a phone's width."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from playwright.sync_api import Browser, Page, ViewportSize, expect

from tests.analysis.browser import chromium

pytestmark = [pytest.mark.browser, pytest.mark.xdist_group("browser")]

DESK: ViewportSize = {"width": 1400, "height": 900}
BOXES = """(tiles) => tiles.map((tile) => {
  const { left, right, top, bottom } = tile.getBoundingClientRect();
  return { left, right, top, bottom, inner: tile.scrollHeight - tile.clientHeight };
})"""

Box = dict[str, float]


@pytest.fixture
def page(browser: Browser, variants: str) -> Iterator[Page]:
    """Return a page over the grid of variants on a desk's screen."""
    with chromium.strict_page(browser, variants, viewport=DESK) as opened:
        yield opened


def boxes(page: Page, selector: str) -> list[Box]:
    found: list[Box] = page.locator(selector).evaluate_all(BOXES)
    return found


def overlap(one: Box, other: Box) -> bool:
    apart = (
        one["right"] <= other["left"]
        or other["right"] <= one["left"]
        or one["bottom"] <= other["top"]
        or other["bottom"] <= one["top"]
    )
    return not apart


def test_tiles_are_apart_and_inside_the_window(page: Page) -> None:
    page.goto("/")
    found = boxes(page, ".tile")
    assert len(found) == 10
    for place, one in enumerate(found):
        assert one["inner"] <= 0, "a text does not fit into its tile"
        assert one["left"] >= 0
        assert one["right"] <= DESK["width"]
        assert not any(overlap(one, other) for other in found[place + 1 :])
    cells = boxes(page, ".heat td:has(.tile)")
    for one in found:
        assert any(
            cell["top"] <= one["top"] + 1 and one["bottom"] <= cell["bottom"] + 1
            for cell in cells
            if overlap(cell, one)
        )


def test_tiles_of_one_cell_say_how_they_differ(page: Page) -> None:
    page.goto("/")
    cell = page.locator(".heat tbody tr").first.locator("td").first
    labels = cell.locator(".tile small:nth-of-type(2)").all_inner_texts()
    assert len(labels) == len(set(labels)) >= 4
    assert any("γ=3" in label for label in labels)
    assert any("adam_replay" in label for label in labels)


def test_hover_values_are_inside_the_window(page: Page) -> None:
    page.goto("/curves?env=pendulum")
    check_hover(page, "#chart", "D-optimal")
    page.goto("/trials?env=quadrotor&policy=random&seed=0")
    page.locator("tbody a").click()
    page.wait_for_selector("#charts[data-drawn]")
    for chart, text in (("#loss", "reachable set"), ("#inputs", "u₁"), ("#spectrum", "density")):
        check_hover(page, chart, text)


def check_hover(page: Page, chart: str, text: str) -> None:
    """Move the mouse over a chart; check that its box has the text and is inside the window."""
    over, hover = page.locator(f"{chart} .u-over"), page.locator(f"{chart} .hover")
    over.scroll_into_view_if_needed()
    size = over.bounding_box()
    assert size
    for share in (0.02, 0.5, 0.98):
        over.hover(position={"x": share * size["width"], "y": share * size["height"]})
        expect(hover).to_be_visible()
        expect(hover).to_contain_text(text)
        (box,) = boxes(page, f"{chart} .hover")
        assert box["left"] >= 0
        assert box["top"] >= 0
        assert box["right"] <= DESK["width"]
        assert box["bottom"] <= DESK["height"]
        assert box["inner"] <= 0
    page.mouse.move(2, 2)
    expect(hover).to_be_hidden()


def test_two_inputs_have_a_legend(page: Page) -> None:
    page.goto("/trials?env=quadrotor&policy=random&seed=0")
    page.locator("tbody a").click()
    legend = page.locator("#inputs-legend li")
    expect(legend).to_have_text(["u₁ [N]", "u₂ [N]"])
    colours = {line.get_attribute("stroke") for line in legend.locator("line").all()}
    assert len(colours) == 2
    page.goto("/trials?env=pendulum&policy=random&seed=0")
    page.locator("tbody a").first.click()
    page.wait_for_selector("#charts[data-drawn]")
    expect(page.locator("#inputs-legend")).to_be_hidden()
