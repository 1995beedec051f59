"""Fan-out: nothing depends on where and when tasks run, and a failure costs no other task."""

import os
import secrets
import signal
import subprocess
import sys
import tempfile
import time
from functools import partial
from pathlib import Path
from unittest.mock import Mock

import joblib
import numpy as np
import pytest

from benchmarks.lib.errors import UnfinishedError, UsageError
from benchmarks.lib.parallel import FanOut
from tests.conftest import ROOT, python


def draw(seed, seconds=0.0):
    """Return a random number of a seed, after some time."""
    time.sleep(seconds)
    return [{"seed": seed, "drawn": np.random.default_rng(seed).normal()}]


def die_of_memory():
    """Kill the own process as the system does if memory runs out."""
    os.kill(os.getpid(), getattr(signal, "SIGKILL", signal.SIGTERM))  # as Windows has it


def fail(seed):
    """Raise an exception that cannot be pickled."""

    class LocalError(Exception):
        pass

    raise LocalError(f"no such plant as {seed}")


def work(n):
    return {f"plant {seed}": partial(draw, seed) for seed in range(n)}


def run(tasks, jobs=2):
    return dict(FanOut(jobs=jobs).stream(tasks, "tasks"))


def test_jobs_and_order_do_not_matter():
    tasks = work(5)
    tasks["plant 0"] = partial(draw, 0, 0.3)  # The first task is not ready first.
    reversed_tasks = dict(reversed(tasks.items()))
    for ordered_tasks, jobs in ((tasks, 1), (tasks, 2), (reversed_tasks, 2)):
        results = run(ordered_tasks, jobs=jobs)
        assert results == {f"plant {seed}": draw(seed) for seed in range(5)}
    assert run({"pid": os.getpid}, jobs=1) == {"pid": os.getpid()}
    assert os.getpid() not in run({"one": os.getpid, "two": os.getpid}).values()


@pytest.mark.parametrize("jobs", [1, 2])
def test_an_exception_names_its_task_and_spares_the_others(jobs):
    faulty = {"the fault": partial(fail, 3), "left": partial(sys.exit, 3)}
    done = {}
    with pytest.raises(UnfinishedError, match="no such plant as 3") as error:
        done.update(FanOut(jobs=jobs).stream({**faulty, **work(4)}, "tasks"))
    assert "2 of 6 tasks failed" in str(error.value)
    assert "left: SystemExit: 3" in str(error.value)
    assert done == {f"plant {seed}": draw(seed) for seed in range(4)}


def refuse():
    raise UsageError("--agent: a controller cannot be run: no reason\n\nTraceback of the user")


def test_an_error_of_the_user_is_listed_by_its_first_line():
    with pytest.raises(UnfinishedError) as error:
        run({"mine, square": refuse, "mine, constant": refuse}, jobs=1)
    lines = str(error.value).splitlines()
    assert lines[1:3] == [
        "mine, square: --agent: a controller cannot be run: no reason",
        "mine, constant: --agent: a controller cannot be run: no reason",
    ]
    assert lines[-1] == "Traceback of the user"


def test_a_killed_process_is_a_sentence():
    with pytest.raises(
        UnfinishedError, match="killed, perhaps because memory ran out: try fewer"
    ):
        run({**work(2), "the killer": die_of_memory})
    assert run(work(2))  # with new processes


RAY = """
import os
from functools import partial
from ray.cluster_utils import Cluster
from benchmarks.lib.parallel import FanOut
node = {"num_cpus": 2, "object_store_memory": 80_000_000, "include_dashboard": False}
cluster = Cluster(initialize_head=True, head_node_args=node)
os.environ["RAY_ADDRESS"] = cluster.address
work = {f"plant {seed}": partial(pow, 0.1, seed) for seed in range(3)} | {"where": os.getpid}
there = dict(FanOut(backend="ray").stream(work, "on the cluster"))
here = dict(FanOut(jobs=1).stream(work, "here"))
assert there.pop("where") != here.pop("where") and there == here, there
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


def test_where_there_is_no_cluster_it_says_so(monkeypatch):
    pytest.importorskip("ray", reason="Ray is not installed")
    monkeypatch.setenv("RAY_ADDRESS", "nowhere")  # "auto" would find those of other users
    with pytest.raises(UsageError, match="--backend: no Ray cluster can be reached: start one"):
        dict(FanOut(backend="ray").stream(work(1), "tasks"))


def test_an_error_of_joblib_leaves_the_signals_as_they_were(monkeypatch):
    before = signal.getsignal(signal.SIGINT)
    monkeypatch.setattr(joblib.Parallel, "__call__", Mock(side_effect=OSError("no semaphores")))
    with pytest.raises(OSError, match="no semaphores"):
        run(work(3))
    assert signal.getsignal(signal.SIGINT) is before


ORPHANS = """
import os, pathlib, sys, time
from functools import partial
from benchmarks.lib.parallel import FanOut

def wait(folder):
    (folder / str(os.getpid())).touch()
    time.sleep(120)

folder = pathlib.Path(sys.argv[1])
dict(FanOut(jobs=2).stream({name: partial(wait, folder) for name in "ab"}, "tasks"))
"""


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="reads /proc")
def test_processes_end_when_the_one_that_started_them_is_killed(tmp_path):
    parent = subprocess.Popen([sys.executable, "-c", ORPHANS, tmp_path], cwd=ROOT)

    def begun():
        return [path.name for path in tmp_path.iterdir()]

    assert wait_until(lambda: len(begun()) == 2)
    parent.kill()
    parent.wait()
    assert wait_until(lambda: not any(is_running(number) for number in begun()), seconds=15)


def wait_until(condition, seconds=60):
    """Return whether a condition comes true in time."""
    for _ in range(10 * seconds):
        if condition():
            return True
        time.sleep(0.1)
    return False


def is_running(process):
    """Return whether a process runs; one that ended may wait for its parent to ask for it."""
    try:
        status = Path("/proc", process, "stat").read_text()
    except OSError:
        return False
    return status.rpartition(")")[2].split()[0] != "Z"
