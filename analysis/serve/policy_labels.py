"""Names and colours of policies as the figures have them, for a page that draws them itself."""

from __future__ import annotations

from typing import Any

from analysis.figures.style import policy_style


def look(policy: str) -> dict[str, Any]:
    """Return how a policy is named and drawn: dashes in units of the line's width."""
    style = policy_style(policy)
    dash = [] if isinstance(style.line, str) else list(style.line[1])
    return {
        "policy": policy,
        "label": style.label,
        "colour": style.colour,
        "dash": dash,
        "line_width": style.width,
    }
