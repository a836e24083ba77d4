"""Errors of the analysis; each message is one sentence that says what to do."""

from __future__ import annotations

from dopt.errors import DoptError


class AnalysisError(DoptError):
    """The request cannot be answered: unknown name, nothing stored, ambiguous choice."""


class IncompleteError(AnalysisError):
    """Trials that the request needs are missing from the database."""
