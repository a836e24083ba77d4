"""Folders of the repository that tests read, and programs and servers that they start."""

from __future__ import annotations

import importlib.util
import json
import os
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from types import ModuleType

ROOT = Path(__file__).resolve().parents[1]
CONF = ROOT / "conf"
EXAMPLE = ROOT / "docs" / "example"


def loaded(path: Path) -> ModuleType:
    """Run a file as a module of its own, which no other import finds, and return it."""
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def without_coverage() -> dict[str, str]:
    """Return an environment in which `make coverage` does not measure a program."""
    return {name: value for name, value in os.environ.items() if not name.startswith("COVERAGE")}


def ran(*words: object, folder: Path = ROOT, **variables: str) -> subprocess.CompletedProcess[str]:
    """Run Python with some words, such as ``-m orchestrate``; it may fail."""
    return subprocess.run(
        [sys.executable, *map(str, words)], cwd=folder, env=os.environ | variables,
        capture_output=True, text=True, check=False,
    )  # fmt: skip


def printed(program: str, *words: str, folder: Path = ROOT, **variables: str) -> str:
    """Return what a text prints as a program in a process of its own, which may not fail."""
    return _printed([program, *words], folder, os.environ | variables)


def loaded_by(program: str) -> list[str]:
    """Return all modules that are loaded once a program has run, in a process of its own."""
    shown = f"{program}\nimport json, sys; print(json.dumps(sorted(sys.modules)))"
    names: list[str] = json.loads(_printed([shown], ROOT, without_coverage()))
    return names


def _printed(words: list[str], folder: Path, variables: dict[str, str]) -> str:
    command = [sys.executable, "-c", *words]
    done = subprocess.run(
        command, cwd=folder, env=variables, stdout=subprocess.PIPE, text=True, check=True
    )
    return done.stdout


class _Silent(SimpleHTTPRequestHandler):
    def log_message(self, *_: object) -> None: ...


@contextmanager
def served(folder: Path) -> Iterator[str]:
    """Serve the files of a folder, and yield the address."""
    with ThreadingHTTPServer(("127.0.0.1", 0), partial(_Silent, directory=folder)) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        try:
            yield f"http://127.0.0.1:{server.server_port}"
        finally:
            server.shutdown()
            thread.join()
