"""Condition of tests/hydra_files.py: no configuration of the project sets the mode of Hydra."""

from __future__ import annotations

import yaml

from tests.paths import CONF, EXAMPLE, ROOT


def test_no_file_of_the_project_sets_the_mode_of_hydra() -> None:
    folders = [CONF, EXAMPLE / "conf", ROOT / "tests" / "machines" / "conf"]
    files = [path for folder in folders for path in sorted(folder.rglob("*.yaml"))]
    assert len(files) > 50
    for path in files:
        settings = (yaml.safe_load(path.read_text()) or {}).get("hydra") or {}
        assert "mode" not in settings, path
