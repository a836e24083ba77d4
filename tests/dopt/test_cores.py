"""Quotas of control groups, of both versions, as containers show them."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import pytest

from dopt import process

Group = Callable[..., None]


@pytest.fixture
def group(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Group:
    """Return a function that puts this process, on eight cores, into a control group."""
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {*range(8)})
    monkeypatch.setattr(process, "PROC", tmp_path)

    def put(kind: str, groups: str, quotas: dict[str, str], root: str = "/") -> None:
        (tmp_path / "cgroup").write_text(groups)
        options = "rw,nsdelegate" if kind == "cgroup2" else "rw,cpuacct,cpu"
        (tmp_path / "mountinfo").write_text(
            f"30 23 0:2 / /proc rw shared:1 - proc proc rw\n"
            f"31 23 0:28 {root} {tmp_path}/fs rw,relatime shared:9 - {kind} cgroup {options}\n"
        )
        for name, quota in quotas.items():
            path = tmp_path / "fs" / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(quota)

    return put


def test_without_a_group_the_affinity_counts(group: Group, tmp_path: Path) -> None:
    assert process.usable_cores() == 8  # no file says anything
    group("cgroup2", "0::/\n", {"cpu.max": "max 100000\n"})
    assert process.usable_cores() == 8
    group("cgroup", "4:cpu,cpuacct:/\n", {"cpu.cfs_quota_us": "-1", "cpu.cfs_period_us": "100000"})
    assert process.usable_cores() == 8
    (tmp_path / "mountinfo").write_text("of another kind\n")
    assert process.usable_cores() == 8


@pytest.mark.parametrize(
    ("quota", "expected"), [("50000", 1), ("150000", 1), ("200000", 2), ("900000", 8)]
)
@pytest.mark.parametrize("version", [1, 2])
def test_a_quota_counts_in_whole_cores(
    group: Group, quota: str, expected: int, version: int
) -> None:
    if version == 2:
        group("cgroup2", "0::/a/b\n", {"a/b/cpu.max": f"{quota} 100000\n"})
    else:
        files = {"a/b/cpu.cfs_quota_us": quota, "a/b/cpu.cfs_period_us": "100000"}
        group("cgroup", "5:memory:/m\n4:cpu,cpuacct:/a/b\n", files)
    assert process.usable_cores() == expected


def test_the_smallest_quota_up_the_hierarchy_counts(group: Group) -> None:
    quotas = {"a/cpu.max": "300000 100000", "a/b/cpu.max": "max 100000", "a/b/c/cpu.max": "5 1"}
    group("cgroup2", "0::/a/b/c\n", quotas)
    assert process.usable_cores() == 3


def test_a_container_sees_its_own_group_as_the_top(group: Group) -> None:
    """What is mounted begins at it, while its path is that on the host."""
    files = {"cpu.cfs_quota_us": "250000", "cpu.cfs_period_us": "100000"}
    group("cgroup", "4:cpu,cpuacct:/docker/1f\n", files, root="/docker/1f")
    assert process.usable_cores() == 2
    files = {"job/cpu.cfs_quota_us": "100000", "job/cpu.cfs_period_us": "100000"}
    group("cgroup", "4:cpu,cpuacct:/docker/1f/job\n", files, root="/docker/1f")
    assert process.usable_cores() == 1


def test_nothing_else_counts_cores() -> None:
    from tests.paths import ROOT

    counting = ("cpu_count", "sched_getaffinity(0))")
    found = [
        str(path.relative_to(ROOT))
        for package in ("dopt", "orchestrate", "analysis", "benchmarks")
        for path in (ROOT / package).rglob("*.py")
        if any(words in path.read_text() for words in counting)
    ]
    assert found == ["dopt/process.py"]
