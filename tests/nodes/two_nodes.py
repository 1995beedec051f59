"""Run tasks on a Ray cluster of two nodes with a core each, and in this process.

The folder of the environment variable PYTHONPATH is that of the checkout, which the nodes do
not have.
"""

import os
import tempfile
import time
from functools import partial
from pathlib import Path

import ray
from ray.cluster_utils import Cluster

from benchmarks.controllers.roster import ROSTER
from benchmarks.lib.fan_out import FanOut
from benchmarks.loop.metrics import mean_error

NODE = {"num_cpus": 1, "object_store_memory": 80_000_000}


def run(seed):
    """Return the errors of two runs. As a function of this script, it travels by value."""
    (factory,) = ROSTER["pi-simc"].members()
    return mean_error(factory.run({"noise_variance": 0.5}, 300, 2, seed)).tolist()


def meet(folder):
    """Wait until another node is here, too."""
    (folder / ray.get_runtime_context().get_node_id()).touch()
    end = time.monotonic() + 30.0
    while len(list(folder.iterdir())) < 2 and time.monotonic() < end:
        time.sleep(0.05)
    return len(list(folder.iterdir()))


checkout = os.environ["PYTHONPATH"]
elsewhere = [f"{checkout}/{name}" for name in ("agents", "benchmarks", "mptc_gym")]
os.environ["ELSEWHERE"] = os.pathsep.join(elsewhere)
os.environ["PYTHONPATH"] = str(Path(__file__).parent)  # of the nodes, with sitecustomize.py
cluster = Cluster(
    initialize_head=True,
    head_node_args={**NODE, "include_dashboard": False},
    shutdown_at_exit=True,
)
cluster.add_node(**NODE)
os.environ["RAY_ADDRESS"] = cluster.address
runs = {f"seed {seed}": partial(run, seed) for seed in range(4)}
with tempfile.TemporaryDirectory() as folder:
    nodes = {name: partial(meet, Path(folder)) for name in ("one", "other")}
    there = FanOut(backend="ray").run(nodes | runs)
assert there == {"one": 2, "other": 2} | FanOut(jobs=1).run(runs), there
print("the same numbers from two nodes")
ray.shutdown()
cluster.shutdown()
