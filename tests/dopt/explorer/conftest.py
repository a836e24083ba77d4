"""An exploration to save."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from dopt import Explorer
from tests.dopt.explorer.plants import drive, explorer


@pytest.fixture
def run() -> Iterator[Explorer]:
    with explorer() as opened:
        drive(opened, 40)
        yield opened
