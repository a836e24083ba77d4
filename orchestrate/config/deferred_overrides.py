"""What Hydra composes first, when no choice of a grid has been made yet.

It has the default option of every group that is swept, so that a setting which only the choices
have, such as ``policy.budget_us=20`` with ``policy=beyond/exact,beyond/trace``, would be unknown to
it. The settings inside the parts of a trial therefore wait for the choices.
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

from orchestrate.grid import TRIAL_SECTIONS

_WAITS = re.compile(rf"[+~]*(?:{'|'.join(TRIAL_SECTIONS)})\.")
_OF_HYDRA = re.compile(r"[+~]*hydra[./]")


@contextlib.contextmanager
def waiting() -> Iterator[tuple[str, ...]]:
    """Keep from Hydra what has to wait; yield all overrides that are not about Hydra itself."""
    before = list(sys.argv)
    flags = get_args_parser().parse_known_intermixed_args(before[1:])[0]
    held = {word for word in flags.overrides if flags.multirun and _WAITS.match(word)}
    sys.argv[:] = [word for word in before if word not in held]
    try:
        yield tuple(word for word in flags.overrides if not _OF_HYDRA.match(word))
    finally:
        sys.argv[:] = before


def apply_known(config: DictConfig, words: Sequence[str]) -> None:
    """Set what waited and has a single value in the first configuration, where it has the key.

    A setting of the launch may refer to it, as in ``store.url=sqlite:///${env.horizon}.db``.
    """
    parser = OverridesParser.create()
    for word in words:
        with contextlib.suppress(Exception):  # that it lacks the key, or that the word is wrong
            [override] = parser.parse_overrides([word])
            if _WAITS.match(word) and not override.is_sweep_override():
                ConfigLoaderImpl._apply_overrides_to_config([override], config)
