"""Holds a Ray cluster of three nodes with a core each, and prints its address.

For each line that it reads it ends a node that is in the middle of a task, and prints a line.
"""

import os
import signal
import sys
import time
from contextlib import suppress
from pathlib import Path

from ray.cluster_utils import Cluster

NODE = {"num_cpus": 1, "object_store_memory": 80_000_000}


def processes(node):
    """Return the raylet of a node, and the workers that it started."""
    raylet = node.all_processes["raylet"][0].process.pid
    children = Path(f"/proc/{raylet}/task/{raylet}/children").read_text()
    return raylet, [int(child) for child in children.split()]


def at_work(node):
    """Say whether a node runs a task: Ray names its workers after what they run."""
    return any(name_of(worker).startswith("ray::_answer") for worker in processes(node)[1])


def name_of(process):
    with suppress(OSError):  # it has just ended
        return Path(f"/proc/{process}/cmdline").read_text()
    return ""


def end(node):
    """End a node at once, as a machine that loses power: no worker can still answer."""
    raylet, workers = processes(node)
    os.kill(raylet, signal.SIGSTOP)
    for worker in workers:
        os.kill(worker, signal.SIGKILL)
    cluster.remove_node(node, allow_graceful=False)
    others.remove(node)


cluster = Cluster(
    initialize_head=True,
    head_node_args={**NODE, "include_dashboard": False},
    shutdown_at_exit=True,
)
others = [cluster.add_node(**NODE) for _ in range(2)]
print(cluster.address, flush=True)
for _line in sys.stdin:
    last = time.monotonic() + 60.0
    while not (working := [node for node in others if at_work(node)]):
        assert time.monotonic() < last, "no node has anything to do"
        time.sleep(0.01)
    end(working[0])
    print("done", flush=True)
cluster.shutdown()
