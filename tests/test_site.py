"""The built pages: all members of the public classes, and nothing from another host."""

from __future__ import annotations

import ast
import inspect
import re
from pathlib import Path

import pytest

import dopt
from tests.paths import EXAMPLE, ran, served

pytestmark = pytest.mark.xdist_group("site")  # one site for all of them

LOADED = re.compile(
    r"<(?:script|img|iframe|video|audio|source|embed)\b[^>]*?\ssrc=[\"']?(?:https?:)?//"
    r"|<link\b(?![^>]*rel=[\"']?(?:canonical|next|prev))[^>]*?href=[\"']?(?:https?:)?//"
    r"|url\(\s*[\"']?(?:https?:)?//|@import\s+[\"']?(?:https?:)?//"
    r"|class=[\"']?mermaid\b"  # the theme loads the program that draws them from another host
)
"""Text of a page or of a style sheet that makes a browser ask another host."""


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of the pages; a broken link fails the build."""
    folder = tmp_path_factory.mktemp("site")
    done = ran("-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", folder)
    assert done.returncode == 0, done.stderr
    return folder


@pytest.fixture(scope="module")
def listed(site: Path) -> set[str]:
    """Return the dotted names of the API reference."""
    pages = [path.read_text() for path in (site / "api").glob("*.html")]
    assert len(pages) > 10
    return {
        name for page in pages for name in re.findall(r' id="((?:dopt|analysis)\.[^"]*)"', page)
    }


def test_all_members_of_the_public_classes_are_in_the_reference(listed: set[str]) -> None:
    classes = [value for name in dopt.__all__ if inspect.isclass(value := getattr(dopt, name))]
    assert dopt.Explorer in classes
    members = {
        f"{cls.__module__}.{cls.__name__}.{name}"
        for cls in classes
        for name in dir(cls)
        if not (name.startswith("_") or hasattr(Exception, name))
    }
    assert {f"dopt.explorer.explorer.Explorer.{name}" for name in ("tell", "save")} <= members
    assert members - listed == set()


def test_what_the_examples_import_is_in_the_reference(listed: set[str]) -> None:
    """It says that names which it does not list may change in any release."""
    trees = [ast.parse(path.read_text()) for path in EXAMPLE.glob("*.py")]
    found = [node for tree in trees for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)]
    names = {
        alias.name
        for node in found
        for alias in node.names
        if str(node.module).startswith("dopt") and not str(node.module).startswith("dopt.kernel")
    }
    assert {"CustomPolicy", "System", "parameter"} <= names
    assert names - {name.rpartition(".")[2] for name in listed} == set()


def test_a_page_that_asks_another_host_is_found() -> None:
    for text in (
        '<script src="https://cdn.jsdelivr.net/npm/katex@0.16.11/dist/katex.min.js"></script>',
        '<link rel="stylesheet" href="//fonts.googleapis.com/css?family=Roboto">',
        "@font-face{src:url(https://example.org/a.woff2)}",
    ):
        assert LOADED.search(text), text


def test_no_page_asks_another_host(site: Path) -> None:
    files = [path for path in site.rglob("*") if path.suffix in (".html", ".css")]
    assert len(files) > 30
    assert not [path for path in files if LOADED.search(path.read_text())]


@pytest.mark.browser
def test_formulas_are_set_in_their_fonts_and_nothing_else_is_asked_for(site: Path) -> None:
    from tests.analysis.browser import chromium

    with (
        served(site) as address,
        chromium.opened() as browser,
        chromium.strict_page(browser, address) as page,
    ):
        page.goto("/method.html")
        page.wait_for_selector(".katex")
        ready = (
            "document.fonts.ready.then(() => [...document.fonts].map(f => [f.family, f.status]))"
        )
        fonts = page.evaluate(ready)
        assert ["KaTeX_Math", "loaded"] in fonts
        assert page.locator(".katex-error").count() == 0
        page.goto("/api/explorer.html")
        page.get_by_role("heading", name="free_run_error").wait_for()
