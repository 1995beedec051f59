"""A Ray cluster of three nodes that have no checkout; workers and whole nodes are lost."""

import importlib.util
import json
import os
import secrets
import socket
import subprocess
import sys
import tempfile
from collections import Counter
from functools import partial
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from agents import LawNetwork
from benchmarks.lib.fan_out import FanOut, TasksFailedError
from benchmarks.sweep.__main__ import main as sweep
from benchmarks.train.command import trained
from benchmarks.train.through_plant import Training
from tests import tasks
from tests.conftest import ROOT, python
from tests.test_fan_out import counted, work

NODES = ROOT / "tests" / "nodes"
SECONDS = 300.0  # after which something hangs, on the slowest machine
DESIGN = (
    *("--design", "random", "--plants", "8", "--runs", "2", "--samples", "1200"),
    *("--agents", "ppo"),
)
TRAININGS = [Training(seed=1, steps=3, plants=4, samples=60, choosing=4, adding=3)]

pytestmark = [
    pytest.mark.skipif(
        not sys.platform.startswith("linux"), reason="Ray's clusters are Linux's"
    ),
    pytest.mark.skipif(importlib.util.find_spec("ray") is None, reason="Ray is not installed"),
]


def private():
    """Return an environment that keeps Ray to those who have its token."""
    return os.environ | {
        "RAY_AUTH_MODE": "token",  # whatever this machine's settings are
        "RAY_AUTH_TOKEN": secrets.token_hex(16),
        "RAY_USAGE_STATS_ENABLED": "0",
    }


def free_port():
    with socket.create_server(("127.0.0.1", 0)) as server:
        return server.getsockname()[1]


class Cluster:
    """Three nodes of a core each, one of which can be lost. `environment` is its users'."""

    def __init__(self, process, log, environment):
        self._process = process
        self._log = log
        self.environment = environment | {"RAY_ADDRESS": process.stdout.readline().strip()}

    def lose_a_node(self):
        self._process.stdin.write("lose\n")
        self._process.stdin.flush()
        assert self._process.stdout.readline() == "done\n", self._log.read_text()


@pytest.fixture(scope="module")
def results(tmp_path_factory):
    """Return the folder below which drivers write all results."""
    return tmp_path_factory.mktemp("results")


@pytest.fixture(scope="module")
def cluster(results):
    packages = [str(ROOT / name) for name in ("agents", "benchmarks", "mptc_gym")]
    with tempfile.TemporaryDirectory(prefix="ray", ignore_cleanup_errors=True) as folder:
        environment = private() | {"RAY_TMPDIR": folder}
        of_nodes = {
            "PYTHONPATH": str(NODES),
            "ELSEWHERE": os.pathsep.join([*packages, str(results)]),
            "RAY_worker_niceness": "0",  # other tests run beside this
        }
        log = Path(folder) / "log"
        with log.open("w") as errors, subprocess.Popen(
            [sys.executable, NODES / "hold.py"],
            env=environment | of_nodes, cwd=folder, stdin=subprocess.PIPE,
            stdout=subprocess.PIPE, stderr=errors, text=True,
        ) as process:  # fmt: skip
            try:
                yield Cluster(process, log, environment)
            finally:
                process.stdin.close()
                process.wait(30)


def test_a_sweep_loses_a_node(cluster, results):
    there, here = results / "swept there", results / "swept here"
    with subprocess.Popen(
        [sys.executable, "-m", "benchmarks.sweep", *DESIGN, "--backend=ray", f"--out={there}"],
        env=cluster.environment, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
        text=True,
    ) as driver:  # fmt: skip
        begun = "tasks/*/limit *.json"
        try:
            tasks.until(lambda: driver.poll() or len(list(there.glob(begun))) > 1, SECONDS)
            cluster.lose_a_node()
            assert not (there / "runs.csv").exists()  # the end was not reached
            said = driver.communicate(timeout=SECONDS)[0]
        finally:
            driver.kill()
    assert driver.returncode == 0, said
    assert sweep([*DESIGN, "--jobs", "1", "--out", str(here)]) == 0
    pd.testing.assert_frame_equal(
        pd.read_csv(there / "runs.csv"), pd.read_csv(here / "runs.csv"), check_exact=True
    )


def there(cluster, function, folder):
    """Call a function of this file in a process that is a user of the cluster."""
    program = f"from tests.test_ray_cluster import {function.__name__} as run; run(r'{folder}')"
    done = python("-c", program, env=cluster.environment)
    assert done.returncode == 0, done.stderr


def train(folder):
    trained(TRAININGS, Path(folder), FanOut(backend="ray"), here=False)


def test_trainings_give_the_networks_that_they_give_here(cluster, results):
    away, here = results / "trained there", results / "trained here"
    there(cluster, train, away)
    networks = trained(TRAININGS, here, FanOut(1))
    assert len(networks) == len(list(away.glob("*/network.npz"))) == len(TRAININGS)
    for network in networks:
        key = network.provenance["code"]
        other = LawNetwork.load(away / key / "network.npz")
        for layer, same in zip(network.choosing, other.choosing, strict=True):
            assert all(map(np.array_equal, layer, same))
        assert other.provenance["commit"] == network.provenance["commit"]


def lose_a_worker(folder):
    """Run tasks, one of which kills its worker, and one more, which fails."""
    from ray import cloudpickle

    cloudpickle.register_pickle_by_value(tasks)  # the tests do not travel
    scratch = Path(folder)
    given = work(24, scratch / "calls", 0.05)
    given["plant 9"] = partial(tasks.die_once, 9, scratch / "died", scratch / "calls")
    fan_out = FanOut(backend="ray")
    out = {"results": fan_out.run(given), **fan_out.run({"there": os.listdir})}
    with pytest.raises(TasksFailedError) as failed:
        fan_out.run({"the fault": partial(tasks.fail, 1)})
    out["errors"] = failed.value.errors
    (scratch / "out.json").write_text(json.dumps(out))


def test_a_lost_worker_loses_nothing(cluster, tmp_path):
    (tmp_path / "calls").mkdir()
    there(cluster, lose_a_worker, tmp_path)
    out = json.loads((tmp_path / "out.json").read_text())
    assert (tmp_path / "died").exists()
    assert out["results"] == FanOut(1).run(work(24))
    assert list(out["results"]) == list(work(24))
    # The cluster makes up for the worker: nothing that had finished runs again.
    assert counted(tmp_path / "calls") == Counter(range(24))
    assert set(out["there"]) == {"agents", "benchmarks", "mptc_gym"}
    assert list(out["errors"]) == ["the fault"]
    assert "no such plant as 1" in out["errors"]["the fault"]


@pytest.mark.parametrize("named_in", ["environment", "file"])
def test_a_cluster_that_is_gone_is_not_waited_for(named_in, tmp_path):
    nowhere = f"127.0.0.1:{free_port()}"
    environment = private() | {"RAY_ADDRESS": nowhere, "RAY_TMPDIR": str(tmp_path)}
    if named_in == "file":
        del environment["RAY_ADDRESS"]
        (tmp_path / "ray").mkdir()
        (tmp_path / "ray/ray_current_cluster").write_text(nowhere)
    program = "from benchmarks.lib.fan_out import FanOut; FanOut(2, 'ray')"
    said = python("-c", program, env=environment).stderr
    assert "ValueError: No Ray cluster can be reached: start one with `ray start" in said
