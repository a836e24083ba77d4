"""Manifests of docker/kubernetes, as kubectl renders them."""

from __future__ import annotations

import functools
import shutil
import subprocess
from typing import Any

import pytest
import yaml

from tests.machines.requirements import unavailable
from tests.paths import ROOT

KUBERNETES = ROOT / "docker" / "kubernetes"

Manifest = dict[str, Any]


def rendered(folder: str) -> list[Manifest]:
    """Return the manifests of a folder; skip the test where no kubectl is installed."""
    if shutil.which("kubectl") is None:
        unavailable("kubectl not on PATH: install kubernetes-client")
    return _rendered(folder)


@functools.cache
def _rendered(folder: str) -> list[Manifest]:
    done = subprocess.run(
        ["kubectl", "kustomize", KUBERNETES / folder], capture_output=True, text=True, check=False
    )
    if done.returncode:
        pytest.fail(done.stderr)
    return list(yaml.safe_load_all(done.stdout))


def of_kind(folder: str, kind: str, name: str) -> Manifest:
    """Return the manifest of an object of a folder."""
    [found] = (
        one for one in rendered(folder) if (one["kind"], one["metadata"]["name"]) == (kind, name)
    )
    return found


def pods(manifest: Manifest) -> list[Manifest]:
    """Return the pod templates of an object."""
    spec = manifest.get("spec", {})  # a ConfigMap has none
    if manifest["kind"] == "RayCluster":
        groups = [spec["headGroupSpec"], *spec["workerGroupSpecs"]]
        return [group["template"] for group in groups]
    return [spec["template"]] if "template" in spec else []


def containers(manifest: Manifest) -> list[Manifest]:
    """Return all containers of an object, those that come first included."""
    return [
        container
        for pod in pods(manifest)
        for key in ("initContainers", "containers")
        for container in pod["spec"].get(key, [])
    ]
