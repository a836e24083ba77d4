"""Sentences on what is selected: what was left out, limits, and losses of another kind."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable

from dopt.spec.label import limits_label
from dopt.spec.prequential import is_prequential
from orchestrate.store import ConfigRow


def omissions(accepted: list[ConfigRow], chosen: list[ConfigRow]) -> Iterable[str]:
    """Yield sentences on configurations that were left out, on limits and on explorations."""
    kept = {config.config_key for config in chosen}
    left = Counter(config.env for config in accepted if config.config_key not in kept)
    for env, count in sorted(left.items()):
        yield f"{env}: {count} other stored configurations are not part of this (see --where)"
    for env, limits in sorted({(one.env, limits_label(one.config)) for one in chosen}):
        if limits:
            yield f"{env}: these trials have {limits}"
    for env in sorted({config.env for config in chosen if is_prequential(config.config)}):
        yield (
            f"{env}: the loss is prequential, the error of each predicted acceleration before it "
            f"is learned; explorations take paths of their own, so that it is not compared"
        )
