"""Fan-out: nothing depends on where and when tasks run, and a failure costs no other task."""

import os
import secrets
import signal
import sys
import tempfile
import time
from functools import partial

import pytest

from benchmarks.lib import fan_out
from benchmarks.lib.command import CommandError
from benchmarks.lib.fan_out import FanOut
from tests.conftest import ROOT, python


def die_of_memory():
    """Kill the own process as the system does if memory runs out."""
    time.sleep(1.0)  # until the other tasks have finished
    os.kill(os.getpid(), getattr(signal, "SIGKILL", signal.SIGTERM))  # as Windows has it


def fail():
    """Raise an exception that cannot be pickled."""

    class LocalError(Exception):
        pass

    raise LocalError("no such plant")


def stop():
    raise KeyboardInterrupt


# The first task is not ready first.
WORK = {"slow": partial(time.sleep, 0.3)} | {
    f"plant {i}": partial(pow, 0.1, i) for i in range(4)
}
RESULTS = {name: task() for name, task in WORK.items()}


@pytest.mark.parametrize("jobs", [1, 2])
def test_an_exception_names_its_task_and_spares_the_others(jobs):
    saved = {}
    finished = FanOut(jobs=jobs).run({"the fault": fail} | WORK, "tasks", saved.setdefault)
    assert finished.results == saved == RESULTS
    assert [*finished.results] == [*WORK]  # in the order of the tasks
    first, second, *traceback = str(finished.error).splitlines()
    assert first == "1 of 6 tasks are missing"
    assert second.startswith("the fault: ")
    assert second.endswith("LocalError: no such plant")
    assert traceback[0] == "Traceback (most recent call last):"
    assert finished.error.status == 1


def test_after_an_interruption_what_has_finished_is_kept():
    finished = FanOut(jobs=1).run(WORK | {"Ctrl-C": stop, "later": fail}, "tasks")
    assert finished.results == RESULTS
    assert str(finished.error) == "interrupted: 2 of 7 tasks are missing"
    assert finished.error.status == 130
    with pytest.raises(CommandError, match="interrupted: 6 of 6 tasks are missing"):
        FanOut(jobs=1).run({"Ctrl-C": stop} | WORK, "tasks")


def test_a_process_that_was_killed_costs_no_result_of_the_others():
    finished = FanOut(jobs=2).run({**WORK, "the killer": die_of_memory}, "tasks")
    assert finished.results == RESULTS
    assert "1 of 6 tasks are missing" in str(finished.error)
    assert FanOut(jobs=2).run(WORK, "tasks") == (RESULTS, None)  # with new processes


RAY = """
import os
from functools import partial
from ray.cluster_utils import Cluster
from benchmarks.lib.fan_out import FanOut
node = {"num_cpus": 2, "object_store_memory": 80_000_000, "include_dashboard": False}
cluster = Cluster(initialize_head=True, head_node_args=node)
os.environ["RAY_ADDRESS"] = cluster.address
work = {f"plant {seed}": partial(pow, 0.1, seed) for seed in range(3)}
work |= {"folder": os.getcwd, "files": os.listdir}
there = FanOut(backend="ray").run(work, "on the cluster").results
assert there.pop("folder") != os.getcwd()
assert {"agents", "benchmarks", "mptc_gym"} < {*there.pop("files")}
assert there == {f"plant {seed}": 0.1**seed for seed in range(3)}
print("the same numbers")
cluster.shutdown()
"""


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="Ray's clusters are Linux's")
def test_a_cluster_gives_the_numbers_that_one_process_gives():
    pytest.importorskip("ray", reason="Ray is not installed")
    # Short, as the paths of sockets are, and for those alone who have the token.
    with tempfile.TemporaryDirectory(prefix="ray", ignore_cleanup_errors=True) as folder:
        private = {
            "RAY_AUTH_MODE": "token",
            "RAY_AUTH_TOKEN": secrets.token_hex(16),
            "RAY_TMPDIR": folder,
            "RAY_USAGE_STATS_ENABLED": "0",
            "RAY_worker_niceness": "0",  # other tests run beside this
            "PYTHONPATH": str(ROOT),
        }
        done = python("-c", RAY, env=os.environ | private)
    assert "the same numbers" in done.stdout, done.stderr


def test_a_terminal_alone_shows_the_bar(capsys, monkeypatch):
    assert list(fan_out.with_progress_bar("ab", "tasks", 2)) == ["a", "b"]
    assert capsys.readouterr().err.strip() == ""
    monkeypatch.setenv("FORCE_COLOR", "1")  # rich then takes any stream for a terminal
    list(fan_out.with_progress_bar("ab", "tasks", 2))
    assert "tasks" in capsys.readouterr().err
