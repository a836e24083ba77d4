"""The manifests for Kubernetes are valid, and say the same as the rest of the project."""

from __future__ import annotations

import functools
import re
import shutil
import subprocess
from typing import Any

import kubernetes_validate
import pytest
import yaml

from orchestrate.errors import ExitCode
from tests.machines.hosts import unavailable
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


FOLDERS = ("database", "workers", "ray")
VERSIONS = ("1.31", "1.37")
"""The first in which a Job may ignore evicted pods without a feature gate, and the newest."""

RAY_CLUSTER = {
    "headGroupSpec": {"rayStartParams", "template"},
    "workerGroupSpecs": {
        "groupName", "maxReplicas", "minReplicas", "rayStartParams", "replicas", "template",
    },
}  # fmt: skip
"""The fields of ray.io/v1 that are used, by their part."""


@pytest.mark.parametrize("version", VERSIONS)
@pytest.mark.parametrize("folder", FOLDERS)
def test_every_object_is_valid_by_the_schemas_of_kubernetes(folder: str, version: str) -> None:
    for manifest in rendered(folder):
        if manifest["kind"] != "RayCluster":  # which Kubernetes itself does not know
            kubernetes_validate.validate(manifest, version, strict=True)
        for pod in pods(manifest):
            alone = {"apiVersion": "v1", "kind": "Pod", "metadata": {"name": "one"}, **pod}
            kubernetes_validate.validate(alone, version, strict=True)


def test_a_cluster_has_the_fields_of_its_kind() -> None:
    cluster = of_kind("ray", "RayCluster", "dopt")
    assert cluster["apiVersion"] == "ray.io/v1"
    assert cluster["metadata"]["annotations"] == {"ray.io/overwrite-container-cmd": "true"}
    spec = cluster["spec"]
    assert spec.keys() == RAY_CLUSTER.keys()
    assert spec["headGroupSpec"].keys() == RAY_CLUSTER["headGroupSpec"]
    for group in spec["workerGroupSpecs"]:
        assert group.keys() == RAY_CLUSTER["workerGroupSpecs"]
        assert group["minReplicas"] <= group["replicas"] <= group["maxReplicas"]


@pytest.mark.parametrize("folder", FOLDERS)
def test_no_container_has_rights_and_none_is_root(folder: str) -> None:
    found = [(one, container) for one in rendered(folder) for container in containers(one)]
    assert found
    for manifest, container in found:
        assert container["securityContext"]["capabilities"] == {"drop": ["ALL"]}
        assert container["securityContext"]["allowPrivilegeEscalation"] is False
        for pod in pods(manifest):
            assert pod["spec"]["securityContext"]["runAsNonRoot"] is True
            assert pod["spec"]["automountServiceAccountToken"] is False


@pytest.mark.parametrize("folder", FOLDERS)
def test_memory_is_limited_and_no_secret_is_written_down(folder: str) -> None:
    for manifest in rendered(folder):
        for container in containers(manifest):
            assert container["resources"]["limits"]["memory"]
            for variable in container.get("env", []):
                name, value = variable["name"], variable["value"]
                assert name.endswith(("_FILE", "_PATH")) or not re.search("PASSWORD|TOKEN$", name)
                assert not re.search(r"://[^/@]*:[^/@]*@", value)


def test_a_worker_has_a_core_for_each_trial_and_memory_for_all() -> None:
    job = of_kind("workers", "Job", "dopt-workers")
    [worker] = job["spec"]["template"]["spec"]["containers"]
    given = dict(word[2:].split("=") for word in worker["args"] if word.startswith("--"))
    assert worker["resources"]["requests"]["cpu"] == given["processes"]
    gib = float(worker["resources"]["limits"]["memory"].removesuffix("Gi"))
    assert int(given["processes"]) * float(given["memory-gib"]) + 1.0 <= gib


def test_a_job_counts_only_what_it_cannot_mend() -> None:
    """An eviction, a lost database and a failed trial cost no pod one of its tries."""
    rules = of_kind("workers", "Job", "dopt-workers")["spec"]["podFailurePolicy"]["rules"]
    actions = {
        (rule["onExitCodes"]["containerName"], code): rule["action"]
        for rule in rules
        if "onExitCodes" in rule
        for code in rule["onExitCodes"]["values"]
    }
    assert actions == {
        ("register", ExitCode.BAD_REQUEST): "FailJob",
        ("register", ExitCode.INFRASTRUCTURE): "Ignore",
        ("worker", ExitCode.SOME_FAILED): "Ignore",
        ("worker", ExitCode.INFRASTRUCTURE): "Ignore",
        ("worker", ExitCode.INTERRUPTED): "Ignore",
    }
    evicted = {"type": "DisruptionTarget", "status": "True"}
    assert {"action": "Ignore", "onPodConditions": [evicted]} in rules


def test_the_head_is_found_by_the_name_that_the_operator_gives_it() -> None:
    cluster = of_kind("ray", "RayCluster", "dopt")
    head = f"{cluster['metadata']['name']}-head-svc:6379"
    launch = of_kind("ray", "Job", "dopt-launch")
    given = [
        variable["value"]
        for manifest in (cluster, launch)
        for container in containers(manifest)
        for variable in container["env"]
        if variable["name"] == "DOPT_HEAD"
    ]
    assert given == [head, head]


def test_commands_of_the_files_name_folders_that_exist() -> None:
    for path in KUBERNETES.glob("*/kustomization.yaml"):
        for folder in re.findall(r"--kustomize (\S+)", path.read_text()):
            assert (KUBERNETES.parents[1] / folder / "kustomization.yaml").exists()
        assert yaml.safe_load(path.read_text())["kind"] == "Kustomization"
