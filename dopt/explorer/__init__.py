"""Exploration of a plant that is measured and not simulated."""

from __future__ import annotations

from dopt.explorer.explorer import Explorer

__all__ = ["Explorer"]
