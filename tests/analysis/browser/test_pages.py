"""Clicks, sizes and positions in a real browser."""

from __future__ import annotations

import re
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest
from playwright.sync_api import Browser, Page, Route, ViewportSize, expect

from tests.analysis.browser import chromium, grids
from tests.orchestrate.faults.trials import Gate
from tests.paths import ROOT
from tests.waiting import PATIENCE_SECONDS

pytestmark = [pytest.mark.browser, pytest.mark.xdist_group("browser")]

CONTRAST = (Path(__file__).parent / "contrast.js").read_text()
PATHS = (*("/", "/curves", "/trials"), "/sql?q=SELECT env, seed FROM v_trial")
TRIALS = ("/trials?status=failed", "/trials?env=cartpole&status=diverged")
WIDE = """[...document.querySelectorAll('main .card:not(.scroll)')]
  .filter((box) => box.scrollWidth > box.clientWidth).map((box) => box.innerText.slice(0, 60))"""


@pytest.fixture
def show(browser: Browser) -> Iterator[Callable[[str], Page]]:
    """Return a function that serves a new database and gives a page of it."""
    with ExitStack() as stack:

        def open_page(url: str) -> Page:
            address = stack.enter_context(chromium.served(url))
            return stack.enter_context(chromium.strict_page(browser, address))

        yield open_page


def test_from_the_grid_to_a_trial(page: Page) -> None:
    page.goto("/")
    expect(page.locator("#state-text")).to_have_text("45 of 48 trials ended, 1 failed")
    page.get_by_role("link", name=re.compile("1 diverged")).click()
    expect(page.locator("tbody tr")).to_have_count(4)
    page.locator("tbody tr", has_text="diverged").get_by_role("link").click()
    expect(page.get_by_role("heading", level=1)).to_have_text("cartpole, random, seed 2")
    page.wait_for_selector("#charts[data-drawn]")
    expect(page.locator("#charts canvas")).to_have_count(5)
    expect(page.locator("#spectrum-note")).to_contain_text("eigenfrequency")
    page.get_by_role("link", name="all seeds of this configuration").click()
    expect(page.locator("tbody tr")).to_have_count(4)


def test_states_with_bounds_have_a_chart(show: Callable[[str], Page], tmp_path: Path) -> None:
    url = f"sqlite:///{tmp_path}/limits.db"
    grids.with_limits(url)
    page = show(url)
    page.goto("/trials")
    page.locator("tbody").get_by_role("link").first.click()
    page.wait_for_selector("#charts[data-drawn]")
    expect(page.locator("#states canvas")).to_have_count(1)
    expect(page.locator("#states-legend li")).to_have_count(2)
    expect(page.locator("#charts canvas")).to_have_count(6)


def test_curves_follow_the_controls(page: Page) -> None:
    page.goto("/curves")
    chart, rows = page.locator("#chart"), page.locator("#legend tbody tr")
    expect(chart).to_have_attribute("data-shown", "d_optimal oracle uniform periodic random")
    expect(rows).to_have_count(5)
    expect(page.locator("#missing")).to_contain_text("periodic: 1 failed, 1 pending (seeds 2-3)")
    rows.nth(4).get_by_role("checkbox").uncheck()
    expect(chart).to_have_attribute("data-shown", "d_optimal oracle uniform periodic")
    page.locator("#legend").get_by_label("oracle").uncheck()
    page.locator("[name=env]").select_option("cartpole")
    expect(page.locator("#heading")).to_have_text("cartpole, width 16")
    expect(chart).to_have_attribute("data-shown", "d_optimal uniform periodic")
    page.locator("[name=x]").select_option("seconds")
    page.locator("[name=style]").select_option("none")
    page.locator("[name=column]").select_option("reachable_loss")
    expect(page).to_have_url(re.compile("env=cartpole.*column=reachable_loss.*x=seconds"))
    page.reload()
    expect(chart).to_have_attribute("data-shown", "d_optimal uniform periodic")
    expect(rows.nth(1).get_by_role("checkbox")).not_to_be_checked()
    page.locator("[name=env]").select_option("pendulum")
    page.get_by_label("Width").select_option("4")
    expect(chart).to_have_attribute("data-shown", "d_optimal")


def test_a_wrong_condition_is_one_sentence(browser: Browser, address: str) -> None:
    with chromium.strict_page(browser, address, complaint="status of 400") as page:
        page.goto("/curves")
        page.get_by_label("Where").fill("policy.form=none")
        page.get_by_label("Where").press("Tab")
        expect(page.locator("#problem")).to_contain_text("fits no stored configuration")
        page.get_by_label("Where").fill("")
        page.get_by_label("Where").press("Tab")
        expect(page.locator("#problem")).to_be_hidden()
        expect(page.locator("#legend tbody tr")).to_have_count(5)


def test_curves_are_read_by_mouse_and_keys(page: Page) -> None:
    page.goto("/curves")
    head, value = page.locator("#at"), page.locator("#legend tbody tr").first.locator("td").nth(1)
    expect(head).to_have_text("mean at the last step")
    last = value.inner_text()
    over = page.locator("#chart .u-over")
    over.hover(position={"x": 60, "y": 100})
    expect(head).to_have_text(re.compile(r"mean at t = \d+"))
    assert value.inner_text() != last
    page.mouse.move(2, 2)
    expect(head).to_have_text("mean at the last step")
    page.locator("#chart").focus()
    page.keyboard.press("ArrowLeft")
    expect(head).to_have_text("mean at t = 38")
    page.keyboard.press("PageUp")
    expect(head).to_have_text("mean at t = 13")


def test_the_list_sorts_filters_and_turns_pages(page: Page) -> None:
    page.goto("/trials")
    expect(page.locator("caption")).to_have_text("48 trials")
    expect(page.get_by_role("link", name="Next")).to_have_count(0)
    expect(page.locator("tbody tr")).to_have_count(48)
    page.get_by_role("link", name="final loss").click()
    expect(page.locator("th[aria-sort=ascending]")).to_contain_text("final loss")
    page.get_by_role("link", name="final loss").click()
    expect(page.locator("th[aria-sort=descending]")).to_contain_text("final loss")
    page.get_by_label("Status").select_option("failed")
    expect(page.locator("tbody tr")).to_have_count(1)
    assert "policy=" not in page.url
    page.locator("tbody a").click()
    expect(page.get_by_role("alert")).to_contain_text("the <b>input</b> is wrong")
    expect(page.locator("pre")).to_contain_text("<script>alert('no')</script>")
    page.get_by_role("link", name="Trials", exact=True).click()
    page.get_by_role("spinbutton", name="Seed").fill("3")
    page.get_by_role("button", name="Apply").click()
    expect(page.locator("caption")).to_have_text("12 trials")


def test_sql_answers_refuses_and_downloads(browser: Browser, address: str) -> None:
    with chromium.strict_page(browser, address, complaint="status of 400") as page:
        page.goto("/sql")
        page.get_by_role("link", name="Final losses").click()
        expect(page.get_by_label("Statement")).to_have_value(re.compile("avg"))
        expect(page.locator("#answer")).to_have_count(0)
        page.get_by_role("button", name="Run").click()
        expect(page.locator("#answer tbody tr")).to_have_count(12)
        with page.expect_download() as download:
            page.get_by_role("button", name="Download CSV").click()
        assert download.value.path().read_text().startswith("env,label,n,mean")
        box = page.get_by_label("Statement")
        box.fill("DELETE FROM trial")
        box.press("Control+Enter")
        expect(page.get_by_role("alert")).to_contain_text("The query failed")
        expect(box).to_have_value("DELETE FROM trial")
        box.fill("SELECT trial_key FROM v_trial WHERE status = 'failed'")
        page.get_by_role("button", name="Run").click()
        page.locator("#answer tbody a").click()
        expect(page.locator("h1")).to_contain_text("pendulum, periodic")


def test_a_choice_while_the_page_loads_is_applied(page: Page) -> None:
    def answer_late(route: Route) -> None:
        time.sleep(0.5)
        route.continue_()

    page.route("**/forms.js", answer_late)
    page.goto("/trials", wait_until="commit")
    page.get_by_label("Policy").select_option("oracle")
    expect(page).to_have_url(re.compile("policy=oracle"))


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_text_is_readable_and_fits_a_phone(browser: Browser, address: str, scheme: str) -> None:
    size = {"viewport": {"width": 390, "height": 844}, "color_scheme": scheme}
    with chromium.strict_page(browser, address, **size) as page:
        for path in PATHS:
            page.goto(path)
            if path == "/curves":
                page.wait_for_selector("#chart[data-shown]")
            check_phone(page, path)
        for path in TRIALS:
            page.goto(path)
            page.locator("tbody a").first.click()
            expect(page.locator("#trial-key")).to_have_text(re.compile("^[0-9a-f]{64}$"))
            page.wait_for_load_state()  # the style sheet too
            key = page.locator("#trial-key").bounding_box()
            assert key
            assert key["x"] + key["width"] <= 390
            check_phone(page, path)


def check_phone(page: Page, path: str) -> None:
    """Check that nothing is wider than the window, and that all text and controls are readable."""
    root = "document.documentElement"
    assert page.evaluate(f"{root}.scrollWidth - {root}.clientWidth") <= 0, path
    assert page.evaluate(WIDE) == [], path
    assert page.evaluate(CONTRAST) == [], path
    unnamed = "[...document.querySelectorAll('input:not([type=hidden]), select, textarea')]"
    assert page.evaluate(f"{unnamed}.filter((field) => !field.labels.length).length") == 0


def test_pages_follow_a_launch(browser: Browser, tmp_path: Path) -> None:
    url = f"sqlite:///{tmp_path}/results.db"
    grids.nothing(url)
    with chromium.commanded(url) as address, chromium.strict_page(browser, address) as page:
        page.goto("/")
        expect(page.locator("#grid")).to_contain_text("has no trials yet")
        gate = Gate(tmp_path)
        gate.let(3)
        module = "tests.analysis.browser.grids"
        program = [sys.executable, "-m", module, url, "6", str(tmp_path)]
        launch = subprocess.Popen(program, cwd=ROOT)
        expect(page.locator("#state")).to_have_attribute("data-mode", "writing")
        expect(page.locator(".tile").first).to_contain_text("3 running")
        page.get_by_role("link", name="Curves", exact=True).click()
        count = page.locator("#legend tbody tr").first.locator("td").nth(3)
        expect(count).to_have_text("3")
        page.evaluate("window.same = true")
        gate.open()
        assert launch.wait(timeout=PATIENCE_SECONDS) == 0
        expect(count).to_have_text("6")
        expect(page.locator("#state-text")).to_have_text("12 of 12 trials ended")
        expect(page.locator("#state")).to_have_attribute("data-mode", "still")
        assert page.evaluate("window.same") is True, "the page was loaded again"


def test_a_database_that_comes_later_appears(browser: Browser, tmp_path: Path) -> None:
    url = f"sqlite:///{tmp_path}/results.db"
    with (
        chromium.served(url) as address,
        chromium.strict_page(browser, address, complaint="status of 503") as page,
    ):
        page.goto("/")
        expect(page.get_by_role("alert")).to_contain_text("There is no results database")
        grids.one_trial(url)
        expect(page.locator(".tile")).to_have_count(1)


@pytest.mark.parametrize("state", [grids.nothing, grids.one_trial, grids.all_diverged])
def test_small_databases_are_shown_without_complaint(
    show: Callable[[str], Page], tmp_path: Path, state: Callable[[str], None]
) -> None:
    url = f"sqlite:///{tmp_path}/results.db"
    state(url)
    page = show(url)
    for path in ("/", "/curves", "/trials", "/sql"):
        page.goto(path)
        expect(page.locator("h1")).to_be_visible()
        if path == "/curves" and state is not grids.nothing:
            page.wait_for_selector("#chart[data-shown]")
    page.goto("/trials")
    if state is not grids.nothing:
        page.locator("tbody a").last.click()
        page.wait_for_selector("#charts[data-drawn]")


DESK: ViewportSize = {"width": 1400, "height": 900}
BOXES = """(tiles) => tiles.map((tile) => {
  const { left, right, top, bottom } = tile.getBoundingClientRect();
  return { left, right, top, bottom, inner: tile.scrollHeight - tile.clientHeight };
})"""

Box = dict[str, float]


@pytest.fixture
def desk(browser: Browser, variants: str) -> Iterator[Page]:
    """Return a page over the grid of variants on a desk's screen."""
    with chromium.strict_page(browser, variants, viewport=DESK) as opened:
        yield opened


def boxes(desk: Page, selector: str) -> list[Box]:
    found: list[Box] = desk.locator(selector).evaluate_all(BOXES)
    return found


def overlap(one: Box, other: Box) -> bool:
    apart = (
        one["right"] <= other["left"]
        or other["right"] <= one["left"]
        or one["bottom"] <= other["top"]
        or other["bottom"] <= one["top"]
    )
    return not apart


def test_tiles_are_apart_and_inside_the_window(desk: Page) -> None:
    desk.goto("/")
    found = boxes(desk, ".tile")
    assert len(found) == 10
    for place, one in enumerate(found):
        assert one["inner"] <= 0, "a text does not fit into its tile"
        assert one["left"] >= 0
        assert one["right"] <= DESK["width"]
        assert not any(overlap(one, other) for other in found[place + 1 :])
    cells = boxes(desk, ".heat td:has(.tile)")
    for one in found:
        assert any(
            cell["top"] <= one["top"] + 1 and one["bottom"] <= cell["bottom"] + 1
            for cell in cells
            if overlap(cell, one)
        )


def test_tiles_of_one_cell_say_how_they_differ(desk: Page) -> None:
    desk.goto("/")
    cell = desk.locator(".heat tbody tr").first.locator("td").first
    labels = cell.locator(".tile small:nth-of-type(2)").all_inner_texts()
    assert len(labels) == len(set(labels)) >= 4
    assert any("γ=3" in label for label in labels)
    assert any("adam_replay" in label for label in labels)


def test_hover_values_are_inside_the_window(desk: Page) -> None:
    desk.goto("/curves?env=pendulum")
    check_hover(desk, "#chart", "D-optimal")
    desk.goto("/trials?env=quadrotor&policy=random&seed=0")
    desk.locator("tbody a").click()
    desk.wait_for_selector("#charts[data-drawn]")
    for chart, text in (("#loss", "reachable set"), ("#inputs", "u₁"), ("#spectrum", "density")):
        check_hover(desk, chart, text)


def check_hover(desk: Page, chart: str, text: str) -> None:
    """Move the mouse over a chart; check that its box has the text and is inside the window."""
    over, hover = desk.locator(f"{chart} .u-over"), desk.locator(f"{chart} .hover")
    over.scroll_into_view_if_needed()
    size = over.bounding_box()
    assert size
    for share in (0.02, 0.5, 0.98):
        over.hover(position={"x": share * size["width"], "y": share * size["height"]})
        expect(hover).to_be_visible()
        expect(hover).to_contain_text(text)
        (box,) = boxes(desk, f"{chart} .hover")
        assert box["left"] >= 0
        assert box["top"] >= 0
        assert box["right"] <= DESK["width"]
        assert box["bottom"] <= DESK["height"]
        assert box["inner"] <= 0
    desk.mouse.move(2, 2)
    expect(hover).to_be_hidden()


def test_two_inputs_have_a_legend(desk: Page) -> None:
    desk.goto("/trials?env=quadrotor&policy=random&seed=0")
    desk.locator("tbody a").click()
    legend = desk.locator("#inputs-legend li")
    expect(legend).to_have_text(["u₁ [N]", "u₂ [N]"])
    colours = {line.get_attribute("stroke") for line in legend.locator("line").all()}
    assert len(colours) == 2
    desk.goto("/trials?env=pendulum&policy=random&seed=0")
    desk.locator("tbody a").first.click()
    desk.wait_for_selector("#charts[data-drawn]")
    expect(desk.locator("#inputs-legend")).to_be_hidden()
