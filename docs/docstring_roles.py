"""Extension of griffe that turns the Sphinx roles of docstrings into links of the site.

A role that names ``~dopt.result.TrialResult`` becomes a link that reads ``TrialResult``. A name
that the API reference does not describe stays plain code.
"""

from __future__ import annotations

import re
from typing import Any

import griffe

ROLE = re.compile(r":(?:func|class|meth|mod|attr|data|exc|obj):`(~?)([\w.]+)`")


class DocstringRoles(griffe.Extension):
    """Rewrites the roles in every docstring that griffe collects."""

    def on_object(self, *, obj: griffe.Object, **kwargs: Any) -> None:  # noqa: ARG002  # griffe passes more
        """Rewrite the docstring of a module, class, function or attribute."""
        _rewrite(obj)

    def on_package(self, *, pkg: griffe.Module, **kwargs: Any) -> None:  # noqa: ARG002  # griffe passes more
        """Rewrite the docstring of a whole package, which is no object to griffe."""
        _rewrite(pkg)


def _rewrite(documented: griffe.Object) -> None:
    if documented.docstring:
        documented.docstring.value = ROLE.sub(_link, documented.docstring.value)


def _link(role: re.Match[str]) -> str:
    short, name = role.groups()
    shown = name.rpartition(".")[2] if short else name
    return f'<autoref identifier="{name}" optional><code>{shown}</code></autoref>'
