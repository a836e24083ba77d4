"""Table of what each test of the soak saw, printed at the end."""

from __future__ import annotations

from collections.abc import Callable

import pytest


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    for reports in terminalreporter.stats.values():
        for report in reports:
            if getattr(report, "when", None) == "call":
                for kind, text in report.user_properties:
                    if kind == "seen":
                        terminalreporter.write_line(f"\n{text}")


@pytest.fixture
def tell(record_property: Callable[[str, object], None]) -> Callable[[str], None]:
    """Return a function that keeps a text for the end of the report, also from another process."""
    return lambda text: record_property("seen", text)
