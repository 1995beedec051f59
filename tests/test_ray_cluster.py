"""Fan-out on a Ray cluster of two nodes that have no checkout."""

import importlib.util
import os
import secrets
import sys
import tempfile

import pytest

from tests.conftest import ROOT, python


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="Ray's clusters are Linux's")
@pytest.mark.skipif(importlib.util.find_spec("ray") is None, reason="Ray is not installed")
def test_a_cluster_gives_the_numbers_that_one_process_gives():
    with tempfile.TemporaryDirectory(prefix="ray", ignore_cleanup_errors=True) as folder:
        private = {  # to this folder, and to those who have the token
            "RAY_AUTH_MODE": "token",
            "RAY_AUTH_TOKEN": secrets.token_hex(16),
            "RAY_TMPDIR": folder,
            "RAY_USAGE_STATS_ENABLED": "0",
            "RAY_worker_niceness": "0",  # other tests run beside this
            "PYTHONPATH": str(ROOT),
        }
        script = ROOT / "tests/nodes/two_nodes.py"
        done = python(str(script), env=os.environ | private, cwd=folder)
    assert "the same numbers from two nodes" in done.stdout, done.stderr
