"""Deferred overrides: keys of a trial that are set after each swept option has been composed.

Hydra first composes the default configuration, in which keys that exist only in swept options are
unknown, such as ``policy.budget_us=20`` with ``policy=beyond/exact,beyond/trace``. Such overrides
are removed from the command line and applied later.
"""

from __future__ import annotations

import contextlib
import re
import sys
from collections.abc import Iterator, Sequence

from hydra._internal.config_loader_impl import ConfigLoaderImpl
from hydra._internal.utils import get_args_parser
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import DictConfig

from orchestrate.config.grid import TRIAL_SECTIONS

_DEFERRED = re.compile(rf"[+~]*(?:{'|'.join(TRIAL_SECTIONS)})\.")
_OF_HYDRA = re.compile(r"[+~]*hydra[./]")


@contextlib.contextmanager
def hold_back() -> Iterator[tuple[str, ...]]:
    """Hide deferred overrides from Hydra; yield all overrides except Hydra's own."""
    before = list(sys.argv)
    flags = get_args_parser().parse_known_intermixed_args(before[1:])[0]
    held = {word for word in flags.overrides if flags.multirun and _DEFERRED.match(word)}
    sys.argv[:] = [word for word in before if word not in held]
    try:
        yield tuple(word for word in flags.overrides if not _OF_HYDRA.match(word))
    finally:
        sys.argv[:] = before


def apply_deferred(config: DictConfig, overrides: Sequence[str]) -> None:
    """Apply deferred overrides with a single value to the default configuration, if it has the key.

    A setting of the launch may refer to one, as in ``store.url=sqlite:///${env.horizon}.db``.
    """
    parser = OverridesParser.create()
    for word in overrides:
        with contextlib.suppress(Exception):  # an unknown key or an invalid value is reported later
            [override] = parser.parse_overrides([word])
            if _DEFERRED.match(word) and not override.is_sweep_override():
                ConfigLoaderImpl._apply_overrides_to_config([override], config)
