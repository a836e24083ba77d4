"""The page of an exploration draws what is added to it."""

from __future__ import annotations

import numpy as np
from playwright.sync_api import Browser

from dopt import Explorer
from orchestrate.store import Reader
from tests.analysis.browser import chromium
from tests.dopt.explorer.plants import MOTOR, following


def explore(explorer: Explorer, steps: int) -> None:
    x = explorer.states[-1] if explorer.n_steps else np.zeros(2)
    for _ in range(steps):
        x = following(x, explorer.ask(x))
        explorer.tell(x)


def test_its_page_follows_it(browser: Browser, sqlite_url: str) -> None:
    with Explorer(MOTOR, policy="random", steps=500) as explorer:
        explore(explorer, 60)
        explorer.save(sqlite_url)
        with Reader.open(sqlite_url) as reader:
            [(key,)] = reader.query("SELECT trial_key FROM trial")
        with (
            chromium.served(sqlite_url) as address,
            chromium.strict_page(browser, address) as page,
        ):
            page.goto(f"{address}/trials/{key}")
            page.wait_for_selector("#charts[data-drawn]")
            assert "running, 60 of 500 steps" in page.inner_text("#trial-state")
            explore(explorer, 60)
            explorer.save(sqlite_url)
            page.wait_for_selector("text=running, 120 of 500 steps")
            page.wait_for_selector("#charts[data-drawn='120']")
            assert page.locator("#loss canvas").count() == 1, "the chart before is gone"
            assert "prequential loss" in page.inner_text("#outcome")


def test_its_curve_is_a_running_median_among_points(browser: Browser, sqlite_url: str) -> None:
    with Explorer(MOTOR, policy="random", steps=500) as explorer:
        explore(explorer, 40)
        explorer.save(sqlite_url)
        errors = explorer.errors
    with (
        chromium.served(sqlite_url) as address,
        chromium.strict_page(browser, address) as page,
    ):
        [curve] = page.request.get(f"{address}/api/curves?env=plant").json()["curves"]
        np.testing.assert_allclose(curve["points"], errors)
        assert curve["values"][20] == np.median(errors[8:33])
        assert "low" not in curve
        page.goto(f"{address}/curves?env=plant")
        page.wait_for_selector("#chart[data-shown=random] canvas")
        assert page.inner_text("#lead").startswith("Prequential loss against time")
        assert "Points: each step. Lines: running median" in page.inner_text("#band")
        assert not page.is_visible("[name=column]")
