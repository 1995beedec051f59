"""A Ray cluster of three nodes that have no checkout, and lose one of them in the middle."""

import importlib.util
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from agents import PolicyNetwork
from benchmarks.lib.fan_out import FanOut
from benchmarks.sweep.__main__ import main as sweep
from benchmarks.train.__main__ import run as train
from tests.nodes.train import TRAININGS
from tests.test_fan_out import private, until

ROOT = Path(__file__).parent.parent
NODES = ROOT / "tests" / "nodes"
DESIGN = (
    *("--design", "random", "--plants", "8", "--runs", "2", "--samples", "1200"),
    *("--agents", "ppo"),
)

pytestmark = [
    pytest.mark.skipif(
        not sys.platform.startswith("linux"), reason="Ray's clusters are Linux's"
    ),
    pytest.mark.skipif(importlib.util.find_spec("ray") is None, reason="Ray is not installed"),
]


class Cluster:
    """Three nodes of a core each; two of them can be lost."""

    def __init__(self, process, log, environment):
        self._process = process
        self._log = log
        self._environment = environment | {"RAY_ADDRESS": process.stdout.readline().strip()}

    def order(self, what):
        self._process.stdin.write(f"{what}\n")
        self._process.stdin.flush()
        assert self._process.stdout.readline() == "done\n", self._log.read_text()

    def run(self, *command, files, count, last):
        """Run Python, and end a node that is at work when so many files of a kind are there."""
        with subprocess.Popen(
            [sys.executable, *command],
            env=self._environment, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
            text=True,
        ) as driver:  # fmt: skip
            try:
                until(lambda: driver.poll() is not None or len(files()) >= count, 120.0)
                if driver.poll() is None:
                    self.order("lose")
                    assert not last()  # the end was not reached
                said = driver.communicate(timeout=120)[0]
            finally:
                driver.kill()
        assert driver.returncode == 0, said
        self.order("join")  # three again


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
    cluster.run(
        "-m", "benchmarks.sweep", *DESIGN, "--backend", "ray", "--out", str(there),
        files=lambda: list(there.glob("cells/*/limit *.json")), count=2,
        last=(there / "runs.csv").exists,
    )  # fmt: skip
    assert sweep([*DESIGN, "--jobs", "1", "--out", str(here)]) == 0
    pd.testing.assert_frame_equal(
        pd.read_csv(there / "runs.csv"), pd.read_csv(here / "runs.csv"), check_exact=True
    )


def test_a_training_loses_a_node(cluster, results):
    there, here = results / "trained there", results / "trained here"
    cluster.run(
        "-m", "tests.nodes.train", str(there),
        files=lambda: list(there.glob("*/network.npz")), count=1,
        last=lambda: len(list(there.glob("*/network.npz"))) == len(TRAININGS),
    )  # fmt: skip
    networks = train(TRAININGS, here, FanOut(1))
    for network in networks:
        key = network.provenance["code"]
        other = PolicyNetwork.load(there / key / "network.npz")
        for layer, same in zip(network.layers, other.layers, strict=True):
            assert all(map(np.array_equal, layer, same))
        assert other.provenance["commit"] == network.provenance["commit"]
