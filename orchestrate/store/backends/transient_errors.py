"""Classification of database errors: transient ones, after which waiting may help."""

from __future__ import annotations

# A lock held for too long, or a race between processes that open the file.
_SQLITE = ("SQLITE_BUSY", "SQLITE_LOCKED", "SQLITE_PROTOCOL")

# Classes and codes of the SQL standard and of PostgreSQL's appendix A.
_STATES = (
    "08",  # connection lost or refused
    "40",  # deadlock, serialization failure: the transaction was the victim, not the cause
    "53200",  # out of memory
    "53300",  # too many connections
    "55P03",  # lock not available
    "57014",  # cancelled, as by a statement timeout
    "57P01",  # shutting down
    "57P02",  # crashed
    "57P03",  # starting up
    "57P05",  # an idle session was ended
    "25P03",  # an idle transaction was ended
)

# During a connection attempt the driver has no code; only the text of the server distinguishes a
# permanent refusal from a temporary one.
_TEMPORARY_REFUSALS = (
    "starting up",
    "shutting down",
    "recovery mode",
    "not yet accepting connections",
    "too many clients",
    "too many connections",
    "connection slots are reserved",
    "terminating connection",
)
_UNKNOWN_HOST = ("failed to resolve host", "could not translate host name")


def is_transient(error: BaseException | None, known_host: bool) -> bool:
    """Return whether the same request may succeed later without any intervention.

    ``known_host`` is True if the server has answered before: its name is valid then, and may be
    unresolvable only for a while, such as during the restart of a container.
    """
    name = getattr(error, "sqlite_errorname", None)
    if name is not None:
        return str(name).startswith(_SQLITE)
    state = getattr(error, "sqlstate", None)
    if state is not None:
        return str(state).startswith(_STATES)
    return _is_psycopg_error(error) and _text_is_transient(str(error), known_host)


def _is_psycopg_error(error: BaseException | None) -> bool:
    return type(error).__module__.partition(".")[0] == "psycopg"


def _text_is_transient(text: str, known_host: bool) -> bool:
    if any(words in text for words in _UNKNOWN_HOST):
        return known_host
    return "FATAL:" not in text or any(words in text for words in _TEMPORARY_REFUSALS)
