"""A run is watched by its files: the newest policy, each once."""

import os
import shutil

import pytest
import torch

from torchrl_loco.policy import Policy
from torchrl_loco.training import RunFolder
from torchrl_loco.training.watching import Watched


def action(policy):
    return policy(observation=torch.linspace(-1, 1, 24))


def test_the_newest_policy_comes_once_from_whichever_file_is_newer(ppo_run, tmp_path):
    run = RunFolder(shutil.copytree(ppo_run.path, tmp_path / "run"))
    files = {path: path.read_bytes() for path in (run.policy, run.checkpoint)}
    watched = Watched(run, 2, "cpu", 0)
    assert watched.env.num_envs == 2
    for file in files:
        file.unlink()
    assert watched.newer() is None

    run.policy.write_bytes(files[run.policy])
    of_file = watched.newer()
    torch.testing.assert_close(action(of_file), action(Policy.load(run.policy, "cpu")))
    assert watched.newer() is None

    run.checkpoint.write_bytes(files[run.checkpoint])
    os.utime(run.checkpoint, ns=(2**62, 2**62))
    last = watched.newer()
    assert last.info["frames"] == run.load_checkpoint("cpu")["frames"]
    torch.testing.assert_close(action(last), action(of_file))  # that of the last evaluation, which was the best
    watched.env.rollout(2, last)
    assert watched.newer() is None


def test_a_run_with_objects_of_its_own_has_no_other_policy_than_its_file(ppo_run, tmp_path):
    run = RunFolder(shutil.copytree(ppo_run.path, tmp_path / "run"))
    (run.path / "given.json").write_text('["network"]')
    os.utime(run.checkpoint, ns=(2**62, 2**62))
    watched = Watched(run, 1, "cpu", 0)
    assert "selected_by" in watched.newer().info
    policy = Policy.load(run.policy, "cpu")
    policy.info["transforms"] = ["ObservationNorm"]
    policy.save(run.policy)
    os.utime(run.policy, ns=(2**62, 2**62))
    with pytest.raises(ValueError, match="behind ObservationNorm"):
        watched.newer()


def test_the_worlds_have_the_settings_of_the_run(ppo_run, tmp_path):
    run = RunFolder(shutil.copytree(ppo_run.path, tmp_path / "run"))
    run.store_config(run.load_config(sim={"iterations": 7}, from_pixels=True, size=(32, 24)))
    env = Watched(run, 1, "cpu", 0).env
    assert env.config.iterations == 7
    assert env.reset()["pixels"].shape == (1, 24, 32, 9)
