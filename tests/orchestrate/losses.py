"""A database that loses what it is asked, or only its own answer, as often as a test says."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from typing import Any

import pytest

from orchestrate.store import Store, StoreUnavailableError

OPERATIONS = ("recover", "register", "claim", "commit_many", "fail", "written", "release")

Loss = str
"""``"question"``, ``"answer"`` or ``""`` for none."""


def lose(
    monkeypatch: pytest.MonkeyPatch,
    losses: Iterable[Loss],
    operations: Iterable[str] = OPERATIONS,
    transient: bool = True,
) -> None:
    """Let the next operations of every store be lost, one for each entry."""
    fate = iter(losses)
    for name in operations:
        operation = getattr(Store, name)
        monkeypatch.setattr(Store, name, _lossy(name, operation, fate, transient))


def _lossy(
    name: str, operation: Callable[..., Any], fate: Iterator[Loss], transient: bool
) -> Callable[..., Any]:
    def lossy(*arguments: Any) -> Any:
        loss = next(fate, "")
        if loss == "question":
            raise StoreUnavailableError(f"{name} was lost.", transient=transient)
        result = operation(*arguments)
        if loss == "answer":
            raise StoreUnavailableError(f"The answer of {name} was lost.", transient=transient)
        return result

    return lossy
