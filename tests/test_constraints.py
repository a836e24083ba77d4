"""Versions that ``constraints.txt`` pins can be installed with Debian's Python."""

from __future__ import annotations

import contextlib
import re
from importlib import metadata

from packaging.specifiers import SpecifierSet

from tests.paths import ROOT


def test_debian_s_python_can_install_what_is_pinned() -> None:
    """A library may ask for a later bugfix of Python 3.11 than Debian 12 has."""
    pinned = re.findall(r"^([\w.-]+)==", (ROOT / "constraints.txt").read_text(), flags=re.MULTILINE)
    asked = {}
    for name in pinned:
        with contextlib.suppress(metadata.PackageNotFoundError):  # of an extra that is left out
            asked[name] = str(metadata.metadata(name).json.get("requires_python", ""))
    assert len(asked) > 100
    assert not {name for name, versions in asked.items() if "3.11.2" not in SpecifierSet(versions)}
