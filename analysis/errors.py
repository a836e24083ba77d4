"""What can go wrong between the database and a picture; each message is a sentence that helps."""

from __future__ import annotations


class AnalysisError(Exception):
    """The request cannot be answered: unknown name, nothing stored, ambiguous choice."""


class IncompleteError(AnalysisError):
    """Trials that the request needs are missing from the database."""
