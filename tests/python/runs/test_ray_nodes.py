# SPDX-License-Identifier: Apache-2.0
"""A cluster of several nodes, played on one machine, loses one of them: the run goes on elsewhere and is the same."""

from __future__ import annotations

import os
import sys

import pytest
from locations import PYTHON_TESTS
from run_facts import list_facts
from test_ray_servers import run_walk

from wiw.runs import ray_engine, ray_servers

pytestmark = pytest.mark.nightly


@pytest.fixture
def cluster(tmp_path, monkeypatch):
    """A head that runs no actors, and two nodes of a core and a GPU, which Ray only counts."""
    ray = pytest.importorskip("ray", reason="needs ray: pip install 'wiw[ray]'")
    from ray.cluster_utils import Cluster

    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(PYTHON_TESTS), *sys.path]))
    monkeypatch.setenv("RAY_USAGE_STATS_ENABLED", "0")
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    monkeypatch.setenv("CALLS", str(tmp_path / "calls"))
    made = Cluster(initialize_head=True, head_node_args={"num_cpus": 0, "object_store_memory": 10**8})
    made.workers = [made.add_node(num_cpus=1, num_gpus=1, object_store_memory=10**8) for _ in range(2)]
    ray.init(address=made.address, log_to_driver=False)
    try:
        yield made
    finally:
        ray.shutdown()
        made.shutdown()


def remove_a_node_once(cluster, monkeypatch, is_replaced):
    """Remove the node of the first server when an episode has ended; return the list that then has all their nodes."""
    served, note = [], ray_servers.ServerPool.note_progress

    def remove_once(pool):
        note(pool)
        if not served and len(pool):
            served.extend(server.node for server in pool._servers)
            (lost,) = [node for node in cluster.workers if node.node_id == served[0]]
            cluster.remove_node(lost)
            if is_replaced:
                cluster.add_node(num_cpus=1, num_gpus=1, object_store_memory=10**8)

    monkeypatch.setattr(ray_servers.ServerPool, "note_progress", remove_once)
    return served


def test_a_lost_node_takes_its_actor_and_its_server_with_it_and_nothing_else(cluster, tmp_path, monkeypatch):
    run_walk(tmp_path / "here").close()
    served = remove_a_node_once(cluster, monkeypatch, is_replaced=True)
    run_walk(tmp_path / "run", engine="ray", workers=2, live=2, servers=2, server_gpus=1).close()
    assert len({*served}) == 2, "a server on each node, for each has one GPU"
    assert list_facts(tmp_path / "run") == list_facts(tmp_path / "here")


def test_a_lost_node_that_nothing_replaces_ends_no_run(cluster, tmp_path, monkeypatch):
    """Its server has no place any more, and neither has its actor: the others do the work."""
    monkeypatch.setattr(ray_engine, "SERVER_SECONDS", 60.0)
    monkeypatch.setattr(ray_engine, "PLACE_SECONDS", 30.0)
    run_walk(tmp_path / "here").close()
    served = remove_a_node_once(cluster, monkeypatch, is_replaced=False)
    run_walk(tmp_path / "run", engine="ray", workers=2, live=2, servers=2, server_gpus=1).close()
    assert len({*served}) == 2
    assert list_facts(tmp_path / "run") == list_facts(tmp_path / "here")
