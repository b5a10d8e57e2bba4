"""What the tests of TorchRL's collectors run as scripts of their own, as their workers import the script again."""

import functools
import sys

import torch
from actors_and_learner import make_env, make_networks
from torchrl.collectors import MultiSyncCollector
from torchrl.collectors.distributed import DistributedCollector

import torchrl_loco

WORKERS, WORLDS, STEPS = 2, 3, 8


def environments():
    return [functools.partial(make_env, "walker_stand", WORLDS, "cpu", 0, k) for k in range(WORKERS)]


def policy():
    torch.manual_seed(0)
    actor, _ = make_networks(torchrl_loco.make("walker_stand", 1, "cpu"), "cpu")
    return actor


def check(batches, actor, update):
    """Checks two batches, between which the weights change: who starts where, and who acts by which weights."""
    whole = torchrl_loco.make("walker_stand", WORKERS * WORLDS, "cpu", 0, world_offset=0, stagger=True).reset()
    for number, batch in enumerate(batches):
        data = batch.reshape(WORKERS, WORLDS, STEPS)
        if number == 0:
            starts = data["observation"][:, :, 0].flatten(0, 1)
            assert torch.equal(starts, whole["observation"]), "worlds are not numbered over all workers"
        assert (data["action"][0] != data["action"][1]).float().mean() > 0.5, "workers draw the same actions"
        with torch.no_grad():
            expected = actor[0](data.select("observation"))["loc"]
        torch.testing.assert_close(data["loc"], expected, atol=1e-4, rtol=1e-4)
        if number == 2:
            break
        with torch.no_grad():
            for parameter in actor.parameters():
                parameter.add_(0.05 * torch.randn_like(parameter))
        update()
    assert number == 2
    print("as it should be")


def multi_sync():
    actor = policy()
    sizes = {"frames_per_batch": WORKERS * WORLDS * STEPS, "total_frames": 3 * WORKERS * WORLDS * STEPS}
    collector = MultiSyncCollector(
        environments(), actor, **sizes, cat_results=0, use_buffers=True, auto_register_policy_transforms=False
    )
    check(collector, actor, collector.update_policy_weights_)
    collector.shutdown()


def distributed():
    actor = policy()
    sizes = {"frames_per_batch": WORKERS * WORLDS * STEPS, "total_frames": 3 * WORKERS * WORLDS * STEPS}
    collector = DistributedCollector(
        environments(),
        actor,
        **sizes,
        sync=True,
        launcher="mp",
        tcp_port=int(sys.argv[2]),
        collector_kwargs={"track_traj_ids": False, "auto_register_policy_transforms": False},
    )
    check(collector, actor, collector.update_policy_weights_)
    collector.shutdown()


def in_ray():
    """A cluster of two nodes with room for an actor each, of which one is killed."""
    import ray
    import ray_ppo
    from ray.cluster_utils import Cluster

    started, start = [], ray_ppo.start_actors

    def noted(*args):
        started.append(start(*args))
        return started[-1]

    ray_ppo.start_actors = noted
    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1})
    cluster.add_node(num_cpus=1)
    ray.init(address=cluster.address, log_to_driver=False)
    actor = policy()
    check(ray_ppo.collect(actor, environments(), WORKERS * WORLDS * STEPS, 3), actor, lambda: None)
    nodes = {node["NodeID"] for node in ray.nodes() if node["Alive"]}
    assert len(nodes) == 2

    shapes = []
    for batch in ray_ppo.collect(actor, environments(), WORKERS * WORLDS * STEPS, 4):
        shapes.append(batch.shape)
        if len(shapes) == 2:
            ray.kill(started[-1].remote_collectors[1])
    assert shapes == [(WORKERS, WORLDS, STEPS)] * 4
    assert len(started) == 3
    ray.shutdown()
    cluster.shutdown()


if __name__ == "__main__":
    {"multi_sync": multi_sync, "distributed": distributed, "ray": in_ray}[sys.argv[1]]()
