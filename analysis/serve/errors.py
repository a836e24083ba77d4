"""What a request can get wrong."""

from __future__ import annotations

from analysis.errors import AnalysisError


class RequestError(AnalysisError):
    """A request that cannot be understood: a bad value of a parameter."""


class NotFoundError(AnalysisError):
    """A trial or a file that is not there."""


class BusyError(AnalysisError):
    """Too many queries run already."""
