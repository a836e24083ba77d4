"""Conversion of configuration sections to specification dataclasses and back.

A section names a class of this package by ``name``, or a custom class by ``_target_``, the
dotted path of a class that can be imported. Such a section also holds the digest of the file that
defines the class: when the file changes, its trials are other trials.
"""

from __future__ import annotations

import ast
import codecs
import contextlib
import dataclasses
import functools
import hashlib
import importlib.util
import inspect
import linecache
import re
import sys
import traceback
from collections.abc import Callable, Mapping
from importlib.machinery import ModuleSpec
from pathlib import Path
from types import FunctionType, ModuleType
from typing import Any, TypeVar, cast

from dopt.errors import SpecificationError, unknown_name
from dopt.fields import Validated, check_own_fields

T = TypeVar("T", bound=Validated)

TARGET = "_target_"
SOURCE = "source"

Part = Mapping[str, object] | Validated
"""A section of a configuration, or an object in its place."""

_ABOUT = ("name", TARGET, SOURCE)


def build(section: str, registry: Mapping[str, type[T]], given: Part) -> T:
    """Return the dataclass that ``given`` names, filled with its other entries; or an object.

    Raises
    ------
    SpecificationError
        If the class or a field is unknown, or a value does not fit.
    """
    if isinstance(given, Validated):
        if type(given) not in registry.values():
            source_digest(_fitting(section, registry, _target(type(given)), type(given)))
        return cast("T", given)
    cls = _own(section, registry, given) if TARGET in given else _shipped(section, registry, given)
    fields = [field.name for field in dataclasses.fields(cls)]
    for key in given:
        if key not in _ABOUT and key not in fields:
            raise unknown_name(f"{section}.{cls.name} field", key, fields)  # type: ignore[attr-defined]
    return cls(**{key: value for key, value in given.items() if key not in _ABOUT})


def build_optional(section: str, registry: Mapping[str, type[T]], given: object) -> T | None:
    """Return what a section that may be left out describes; None without it, or named "none".

    Without a name it is the first class of the registry.

    Raises
    ------
    SpecificationError
        As :func:`build`; also if it is no section, or one of the name "none" has other keys.
    """
    first, kinds = next(iter(registry)), tuple(registry.values())
    if not isinstance(given, (Mapping, *kinds, type(None))):
        raise SpecificationError(
            f"configuration key '{section}' is {given!r}, but a section with a name and fields is "
            f"expected: choose {section}={first}, or {section}=none."
        )
    if not isinstance(given, Mapping):
        return cast("T | None", given)
    if given.get("name") != "none":
        named = {"name": first, **given} if given and TARGET not in given else given
        if isinstance(name := named.get("name"), str) and name not in registry:
            raise unknown_name(section, name, [*registry, "none"])
        return build(section, registry, named)
    if others := ", ".join(key for key in map(str, given) if key != "name"):
        raise SpecificationError(
            f"{section}=none has {others}, but no other key than its name is expected: leave it "
            f"out, or choose an option that has it."
        )
    return None


def section_of(item: Validated) -> dict[str, object]:
    """Return the configuration section that :func:`build` turns into ``item``."""
    if hasattr(item, "to_section"):  # of something that is no dataclass of ours
        written: dict[str, object] = item.to_section()
        return written
    fields = {field.name: getattr(item, field.name) for field in dataclasses.fields(item)}
    listed = {key: list(v) if isinstance(v, tuple) else v for key, v in fields.items()}
    cls, origin = type(item), dict[str, object]()
    if cls.__module__.partition(".")[0] != __name__.partition(".")[0]:  # of the user's own
        origin = {TARGET: _target(cls), SOURCE: source_digest(cls)}
    return {"name": getattr(item, "name", None), **origin, **listed}


def identifying_section(item: Validated) -> dict[str, object]:
    """Return the section without the added fields that have their default.

    It is what a trial's key is made of: :func:`section_of` as it was before the fields were added.
    """
    section, added = section_of(item), added_defaults(type(item))
    return {key: v for key, v in section.items() if key not in added or v != added[key]}


def added_defaults(cls: type[Validated]) -> dict[str, object]:
    """Return the defaults of the fields of a class that were added after trials were stored."""
    added = [field for field in dataclasses.fields(cls) if field.metadata.get("added")]
    return {
        field.name: list(field.default) if isinstance(field.default, tuple) else field.default
        for field in added
    }


def name_of(given: Mapping[str, object]) -> str:
    """Return how a section is called in a message: its name, or its class where it gives none."""
    return str(given.get("name") or given.get(TARGET))


def _shipped(section: str, registry: Mapping[str, type[T]], given: Mapping[str, object]) -> type[T]:
    if "name" not in given:
        raise SpecificationError(
            f"{section}.name is missing, one of {', '.join(sorted(registry))} is expected: set it."
        )
    name = given["name"]
    if not isinstance(name, str) or name not in registry:
        raise unknown_name(section, name, registry)
    return registry[name]


def _own(section: str, registry: Mapping[str, type[T]], given: Mapping[str, object]) -> type[T]:
    """Import a class of the user's own and see that it fits."""
    path = str(given[TARGET])
    own = _fitting(section, registry, path, imported(section, path, given))
    check_source(section, path, own, given, own.__dict__["name"])
    return own


def _fitting(section: str, registry: Mapping[str, type[T]], path: str, cls: Any) -> type[T]:
    """Return a class of the user's own that fits into a section."""
    shipped = next(iter(registry.values()))
    wanted = next(base for base in shipped.__mro__ if "section" in base.__dict__)
    if not (isinstance(cls, type) and issubclass(cls, wanted) and dataclasses.is_dataclass(cls)):
        raise _unfit(section, path, f"a dataclass derived from dopt's {wanted.__name__}")
    check_own_fields(cls)
    own = cast("type[T]", cls)
    missing = [key for key in dir(own) if getattr(getattr(own, key), "__isabstractmethod__", False)]
    for base in wanted.__mro__:
        declared = {
            key for key, hint in inspect.get_annotations(base).items() if "ClassVar" in hint
        }
        missing += [key for key in sorted(declared - {"name"}) if not hasattr(own, key)]
    if missing:
        raise _unfit(section, path, f"a class that defines {', '.join(missing)}")
    if unlike := _unlike_bases(cls):
        raise _unfit(section, path, f"a class with {', '.join(unlike)}")
    name = own.__dict__.get("name")
    if not isinstance(name, str) or name in registry:
        raise _unfit(section, path, "a class with a 'name' of its own, which no other has,")
    return own


@functools.cache
def _unlike_bases(own: type) -> list[str]:
    """Return the methods whose arguments differ from a base's; a class is looked at once."""

    def method_of(key: str) -> Any:
        return inspect.getattr_static(own, key).__get__(0, own)

    bases = (base for base in own.__mro__ if base.__module__.startswith("dopt."))
    return next((unlike for base in bases if (unlike := _unlike(base, method_of))), [])


def _unlike(base: type, method_of: Callable[[str], Any]) -> list[str]:
    """Return the methods of a base whose arguments the method found does not take."""
    unlike = []
    for key, value in vars(base).items():
        if isinstance(value, FunctionType | staticmethod) and key[0] != "_":
            given = inspect.signature(value.__get__(0, base)).parameters.values()
            names = [one.name for one in given if one.default is one.empty]
            try:
                inspect.signature(method_of(key)).bind(*names)
            except TypeError:
                unlike.append(f"{key}({', '.join(names)})")
            except ValueError:  # of a method in C, whose arguments nobody knows
                continue
    return unlike


def check_source(
    section: str, path: str, cls: type, given: Mapping[str, object], name: str
) -> None:
    """Refuse a section of another name, or stored when the file of its class was another one."""
    if given.get("name", name) != name:
        raise SpecificationError(
            f"{section}.name is '{given['name']}', but {path} is called '{name}': "
            f"leave {section}.name out, or correct it."
        )
    if given.get(SOURCE, source_digest(cls)) != source_digest(cls):
        raise _changed(section, path)


def check_stored(config: Mapping[str, object]) -> None:
    """Refuse a stored configuration that names a class without the digest of its file.

    :func:`imported` compares the digest with the file that is here before any of it runs: so what
    is stored, by whomever, runs nothing but files that are here, unchanged.
    """
    for key, section in config.items():
        if isinstance(section, Mapping) and TARGET in section and not section.get(SOURCE):
            raise SpecificationError(
                f"{key}.{TARGET} is stored as '{section[TARGET]}' without {key}.{SOURCE}, but the "
                f"digest of the file is expected, as no unknown code is run: register the trial "
                f"again with a launch of your own."
            )


def imported(section: str, path: str, given: Mapping[str, object] | None = None) -> object:
    """Return what a dotted path names.

    Raises
    ------
    SpecificationError
        If it cannot be imported, or its section ``given`` has the digest of another file; then
        nothing of the module runs.
    """
    module, _, name = path.rpartition(".")
    if given and SOURCE in given and module not in sys.modules:
        _check_file(section, path, given[SOURCE])
    found = _module(section, path, module)
    try:
        return getattr(found, name)
    except AttributeError as error:
        raise _absent(section, path, error) from error


def _check_file(section: str, path: str, source: object) -> None:
    """Refuse a class unless its file, or one that its module takes it from, has a digest."""
    followed, seen = path, set[str]()
    while followed not in seen:
        seen.add(followed)
        module, _, name = followed.rpartition(".")
        spec = _found(module)
        if spec is None or not spec.has_location or not spec.origin:
            raise _absent(section, path, "no file of this name is found")
        with contextlib.suppress(OSError, SyntaxError, ValueError, ImportError):
            content = Path(spec.origin).read_bytes()
            if _digest(content) == source:
                return
            package = module if spec.submodule_search_locations else module.rpartition(".")[0]
            followed = _taken_from(content, package, name) or followed
    raise _changed(section, path)


def _found(module: str) -> ModuleSpec | None:
    """Return where a module would be imported from, without running its packages."""
    spec: ModuleSpec | None = None
    name = ""
    for part in module.split("."):
        within = spec.submodule_search_locations if spec else None
        if not part.isidentifier() or (name and within is None):
            return None
        name = f"{name}.{part}".lstrip(".")
        finders = [one for one in sys.meta_path if hasattr(one, "find_spec")]
        places = (finder.find_spec(name, within) for finder in finders)
        spec = getattr(sys.modules.get(name), "__spec__", None) or next(filter(None, places), None)
    return spec


def _taken_from(content: bytes, package: str, name: str) -> str:
    """Return the path that a module imports a name from, by its text; empty if it does not."""
    for node in ast.parse(content).body:
        if isinstance(node, ast.ImportFrom):
            relative = "." * node.level + (node.module or "")
            for alias in node.names:
                if name == (alias.asname or alias.name):
                    return f"{importlib.util.resolve_name(relative, package)}.{alias.name}"
    return ""


def _module(section: str, path: str, module: str) -> ModuleType:
    """Import a module; an error of its own code names the file."""
    try:
        return importlib.import_module(module)
    except Exception as error:
        place = _place(error)
        if place is None:
            raise _absent(section, path, error) from error
        raise SpecificationError(
            f"{section}.{TARGET} is '{path}', but the file {place[0]} fails in line {place[1]} "
            f"({type(error).__name__}: {getattr(error, 'msg', error)}): correct the file."
        ) from error


def _place(error: Exception) -> tuple[str, int | None] | None:
    """Return file and line of an error in an imported file; None where there is no such file."""
    if isinstance(error, SyntaxError) and error.filename:
        return error.filename, error.lineno
    for frame in traceback.extract_tb(error.__traceback__)[1:]:
        if frame.filename != importlib.__file__ and not frame.filename.startswith("<frozen"):
            return frame.filename, frame.lineno
    return None


def _changed(section: str, path: str) -> SpecificationError:
    return SpecificationError(
        f"{section} asks for {path} as it was in another state of its file: restore the file, or "
        f"leave {section}.{SOURCE} out of a launch to take it as it is now."
    )


def _absent(section: str, path: str, error: object) -> SpecificationError:
    check_importable(section, {TARGET: path})
    return SpecificationError(
        f"{section}.{TARGET} is '{path}', which cannot be imported ({error}): give the path of "
        f"a class as module.Class, in a folder that PYTHONPATH names."
    )


def _unfit(section: str, path: str, expected: str) -> SpecificationError:
    return SpecificationError(
        f"{section}.{TARGET} is '{path}', but {expected} is expected: correct the class or "
        f"the path."
    )


def _target(cls: type) -> str:
    return f"{cls.__module__}.{cls.__qualname__}"


def check_importable(section: str, given: object) -> None:
    """Raise SpecificationError if a section names a class that no other process can import."""
    path = str(given.get(TARGET, "")) if isinstance(given, Mapping) else ""
    if path.startswith(_TYPED) or ".<locals>." in path:
        raise SpecificationError(
            f"{section} is of the class {path} of a notebook, a script or a function, which no "
            f"other process can import: put it into a file of its own, and import it from there."
        )


_TYPED = ("__main__.", "builtins.")
"""Modules of what is typed into a notebook or a script, or executed as text."""


def source_digest(cls: type) -> str:
    """Return the digest of the file that defines a class, as it was when first asked for.

    Of a class that is typed into a notebook it is the digest of its cell and its bases' cells.

    Raises
    ------
    SpecificationError
        If the source cannot be read, as for a class typed into an interpreter.
    """
    if cls not in _digests:
        _digests[cls] = _digest(_source(cls))
    return _digests[cls]


_digests: dict[type, str] = {}


def _digest(content: bytes) -> str:
    """Return the digest of a text, which does not depend on how its lines end."""
    text = content.removeprefix(codecs.BOM_UTF8).replace(b"\r\n", b"\n").replace(b"\r", b"\n")
    return hashlib.sha256(text).hexdigest()[:16]


def _source(cls: type) -> bytes:
    """Return the text of the file that defines a class, or of the cells of a notebook."""
    try:
        return Path(inspect.getfile(cls)).read_bytes()
    except (OSError, TypeError):
        typed = [base for base in cls.__mro__[:-1] if _target(base).startswith(_TYPED)]
    cells = [_cell(base) for base in typed]
    if not (cells and all(cells)):
        raise SpecificationError(
            f"the source of the class {cls.__name__}, which identifies its trials, cannot be read: "
            f"put it into a file of its own, and import it from there."
        )
    return "".join(cells).encode()


def _cell(cls: type) -> str:
    """Return the text of the cell that defines a class, empty where it is not known."""
    functions = filter(inspect.isfunction, map(inspect.unwrap, vars(cls).values()))
    names = [*(one.__code__.co_filename for one in functions), *reversed(linecache.cache)]
    texts = ("".join(linecache.getlines(name)) for name in names)
    return next((text for text in texts if re.search(rf"class {cls.__name__}\b", text)), "")


def check_returned(whose: str, method: str, found: object, base: type) -> None:
    """Refuse what has not the methods of ``base``; ``whose`` names the class in a message.

    Raises
    ------
    SpecificationError
        If it is None, a class, or an object without one of the methods.
    """
    wanted = [key for key, value in vars(base).items() if callable(value) and key[0] != "_"]
    missing = [key for key in wanted if not callable(getattr(found, key, None))]
    missing = missing or _unlike(base, functools.partial(getattr, found))
    if not missing and not isinstance(found, type):
        return
    shown, remedy = "None", f"add the return statement to {method}()"
    if isinstance(found, type):
        shown = f"the class {found.__name__} itself"
        remedy = f"return {found.__name__}(...), an object of it"
    elif found is not None:
        shown = f"an object of type {type(found).__name__}"
        remedy = f"return one that has {', '.join(missing)}"
    raise SpecificationError(
        f"{method}() of {whose} returned {shown}, but an object of a class derived from "
        f"{base.__module__}.{base.__name__} is expected: {remedy}."
    )
