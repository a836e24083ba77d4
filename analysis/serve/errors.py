"""Errors of a request."""

from __future__ import annotations

from analysis.errors import AnalysisError


class RequestError(AnalysisError):
    """A query parameter has an invalid value."""


class NotFoundError(AnalysisError):
    """The trial or file does not exist."""


class ForbiddenError(AnalysisError):
    """The request comes from another site, or needs a right that is not given."""


class BusyError(AnalysisError):
    """Too many queries are running."""
