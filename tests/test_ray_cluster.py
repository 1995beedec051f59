"""A sweep on a Ray cluster of two nodes that have no checkout."""

import importlib.util
import os
import secrets
import socket
import subprocess
import sys
import tempfile

import pandas as pd
import pytest

from benchmarks.sweep.__main__ import main as sweep
from tests.conftest import ROOT, python

NODES = ROOT / "tests" / "nodes"
DESIGN = (
    *("--design", "random", "--plants", "4", "--runs", "2", "--samples", "300"),
    *("--agents", "pi-simc"),
)

pytestmark = [
    pytest.mark.skipif(
        not sys.platform.startswith("linux"), reason="Ray's clusters are Linux's"
    ),
    pytest.mark.skipif(importlib.util.find_spec("ray") is None, reason="Ray is not installed"),
]


def private(folder):
    """Return an environment that keeps Ray to this folder, and to those who have its token."""
    return os.environ | {
        "RAY_AUTH_MODE": "token",  # whatever this machine's settings are
        "RAY_AUTH_TOKEN": secrets.token_hex(16),
        "RAY_TMPDIR": str(folder),
        "RAY_USAGE_STATS_ENABLED": "0",
    }


def test_a_cluster_gives_the_numbers_that_one_process_gives(tmp_path):
    there, here = tmp_path / "there", tmp_path / "here"
    packages = [str(ROOT / name) for name in ("agents", "benchmarks", "mptc_gym")]
    with tempfile.TemporaryDirectory(prefix="ray", ignore_cleanup_errors=True) as folder:
        environment = private(folder)
        of_nodes = {
            "PYTHONPATH": str(NODES),
            "ELSEWHERE": os.pathsep.join([*packages, str(there)]),
            "RAY_worker_niceness": "0",  # other tests run beside this
        }
        with subprocess.Popen(
            [sys.executable, NODES / "hold.py"], env=environment | of_nodes, cwd=folder,
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True,
        ) as cluster:  # fmt: skip
            environment["RAY_ADDRESS"] = cluster.stdout.readline().strip()
            command = "-m", "benchmarks.sweep", *DESIGN, "--backend=ray", f"--out={there}"
            try:
                done = python(*command, env=environment)
            finally:
                cluster.stdin.close()
                cluster.wait(30)
    assert done.returncode == 0, done.stdout + done.stderr
    assert sweep([*DESIGN, "--jobs", "1", "--out", str(here)]) == 0
    pd.testing.assert_frame_equal(
        pd.read_csv(there / "runs.csv"), pd.read_csv(here / "runs.csv"), check_exact=True
    )


@pytest.mark.parametrize("named_in", ["environment", "file"])
def test_a_cluster_that_is_gone_is_not_waited_for(named_in, tmp_path):
    with socket.create_server(("127.0.0.1", 0)) as server:
        nowhere = f"127.0.0.1:{server.getsockname()[1]}"
    environment = private(tmp_path) | {"RAY_ADDRESS": nowhere}
    if named_in == "file":
        del environment["RAY_ADDRESS"]
        (tmp_path / "ray").mkdir()
        (tmp_path / "ray/ray_current_cluster").write_text(nowhere)
    command = "-m", "benchmarks.sweep", *DESIGN, "--backend=ray", f"--out={tmp_path / 'out'}"
    done = python(*command, env=environment)
    assert done.returncode == 2
    assert "error: --backend: No Ray cluster can be reached: start one with" in done.stderr
