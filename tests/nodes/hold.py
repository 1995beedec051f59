"""Holds a Ray cluster of two nodes with a core each, and prints its address."""

import sys

from ray.cluster_utils import Cluster

NODE = {"num_cpus": 1, "object_store_memory": 80_000_000}

cluster = Cluster(
    initialize_head=True,
    head_node_args={**NODE, "include_dashboard": False},
    shutdown_at_exit=True,
)
cluster.add_node(**NODE)
print(cluster.address, flush=True)
sys.stdin.read()  # until the test closes it
cluster.shutdown()
