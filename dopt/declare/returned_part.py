"""Check of what a method of a user's own class returns for a trial: a plan or an update."""

from __future__ import annotations

from dopt.errors import SpecificationError


def check_returned(whose: str, method: str, found: object, base: type) -> None:
    """Refuse what has not the methods of ``base``; ``whose`` names the class in a message.

    Raises
    ------
    SpecificationError
        If it is None, a class, or an object without one of the methods.
    """
    wanted = [key for key, value in vars(base).items() if callable(value) and key[0] != "_"]
    missing = [key for key in wanted if not callable(getattr(found, key, None))]
    if not missing and not isinstance(found, type):
        return
    raise SpecificationError(
        f"{method}() of {whose} returned {_shown(found)}, but an object of a class derived from "
        f"{base.__module__}.{base.__name__} is expected: {_remedy(found, method, missing)}."
    )


def _shown(found: object) -> str:
    if found is None:
        return "None"
    if isinstance(found, type):
        return f"the class {found.__name__} itself"
    return f"an object of type {type(found).__name__}"


def _remedy(found: object, method: str, missing: list[str]) -> str:
    if found is None:
        return f"add the return statement to {method}()"
    if isinstance(found, type):
        return f"return {found.__name__}(...), an object of it"
    return f"return one that has {', '.join(missing)}"
