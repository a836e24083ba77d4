"""The head of the cluster is lost: the launch ends, and goes on with another head."""

from __future__ import annotations

import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import pytest

from tests.machines import servers
from tests.machines.hosts import until
from tests.machines.lab import Lab
from tests.machines.outcome import Outcome


@pytest.mark.parametrize("fault", ["power off", "gcs_server stopped"])
def test_without_its_head_a_launch_ends_and_a_new_cluster_completes_it(
    lab: Lab, undisturbed: Outcome, measured: Callable[[str, float], None], fault: str
) -> None:
    lab.start_cluster("w1", "w2")
    launched = lab.launch(witness=True)
    lab.until_done(launched, 4)
    start = time.monotonic()
    if fault == "power off":
        lab.network.power_off(lab.host("head"))
    else:
        lab.host("head").run("pkill", "-STOP", "gcs_server")  # its port still takes connections
    until(lambda: lab.count("trial", "status = 'running'") == 0, 60.0, lambda: "free claim")
    measured(f"head, {fault}: claims free", time.monotonic() - start)
    assert launched.wait() == 75, launched.output
    measured(f"head, {fault}: exit 75", time.monotonic() - start)
    assert "error: The head of the Ray cluster at 10.77.0." in launched.output
    assert "Traceback" not in launched.output
    before = lab.done()
    assert 4 <= before < len(undisturbed.trials)

    if fault != "power off":
        lab.network.power_off(lab.host("head"))
    lab.network.replace(lab.host("head"))
    with ThreadPoolExecutor() as threads:
        list(threads.map(servers.leave, map(lab.host, ("desk", "w1", "w2"))))
    lab.start_cluster("w1", "w2")
    again = lab.launch()
    assert again.wait() == 0, again.output
    assert f"{before} of {len(undisturbed.trials)} already done" in again.output
    outcome = lab.outcome()
    outcome.check_complete(undisturbed)
    assert outcome.launches == [(1, "failed"), (2, "done")]
