"""How many trials stand behind each line, as short as honesty allows."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping


def count_text(counts: Mapping[str, str]) -> str:
    """Return the counts by policy as a text: the commonest one, then those that differ from it.

    ``{"a": "100", "b": "100", "c": "98/100, 2 diverged"}`` gives
    ``n = 100; c: 98/100, 2 diverged``.
    """
    if not counts:
        return "n = 0"
    common, _ = Counter(counts.values()).most_common(1)[0]
    others = [f"{name}: {count}" for name, count in counts.items() if count != common]
    return "; ".join([f"n = {common}", *others])
