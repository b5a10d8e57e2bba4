"""Several beginnings of a run, of which the best goes on."""

import copy
import itertools

import pytest
import torch
from compare import assert_same
from for_each import for_each
from small_runs import made

import torchrl_loco
from torchrl_loco.training import Trainer

BATCH = 4 * 8 * 4
"""Frames of a batch."""
THREE = {"trials": 3, "trial_fraction": 0.3, "total_frames": 8 * BATCH}
"""Trials of two whole batches, and two further ones."""


def knowledge(trainer):
    """Returns networks, and the moments of their gradients."""
    state = copy.deepcopy(trainer.algorithm.state_dict())
    moments = {name: optimizer["state"] for name, optimizer in state["optimizers"].items()}
    return {"networks": state["networks"], "moments": moments}


def moments(trainer):
    optimizers = trainer.algorithm.optimizers.values()
    return [
        value
        for optimizer in optimizers
        for state in optimizer.state_dict()["state"].values()
        for value in state.values()
    ]


def addresses(trainer):
    """What a recorded gradient step reads and writes must stay where it is."""
    trained = [p for o in trainer.algorithm.optimizers.values() for group in o.param_groups for p in group["params"]]
    return [x.data_ptr() for x in (*trainer.algorithm.networks.state_dict().values(), *trained, *moments(trainer))]


def test_the_return_of_a_trial_is_of_its_own_episodes(tmp_path):
    """Each trial of two batches begins with episodes that the policy before began: none counts in its first batch."""
    run = made(tmp_path, episode_length=16, **{**THREE, "num_steps": 4, "total_frames": 8 * BATCH // 2})
    Trainer(run).train()
    episodes = run.read_metrics()["episodes"]
    assert episodes[::2][:3] == [0.0, 0.0, 0.0]
    assert min(episodes[1::2][:3]) > 0


@for_each(("algorithm", "best"), [("ppo", 0), ("reppo", 1), ("ppo", 2)])
def test_the_best_goes_on(algorithm, best, tmp_path):
    trainer = Trainer(made(tmp_path, algorithm, **THREE))
    trials, ended = trainer.trials, []
    begun = [knowledge(trainer)]
    for number in range(3):
        assert trials.progress(trainer.frames) == 0.0
        trainer.iterate()
        assert not trials.is_over(trainer.frames)
        trainer.iterate()
        assert trials.is_over(trainer.frames)
        ended.append(knowledge(trainer))
        before = addresses(trainer)
        trials.end(trainer.frames, 500.0 if number == best else 100.0 * number)
        assert addresses(trainer) == before
        if number < 2:
            begun.append(knowledge(trainer))
            assert not any(value.any() for value in moments(trainer))
            assert trainer.algorithm.norms["observation"].count == 0
    assert not trials.running
    assert_same(knowledge(trainer), ended[best])
    for one, other in itertools.combinations(begun, 2):
        matrices = [(value, other["networks"][name]) for name, value in one["networks"].items() if value.dim() == 2]
        assert matrices
        assert all((first != second).any() for first, second in matrices)
    assert trials.progress(trainer.frames) == 0.5  # two of its four batches
    trainer.iterate()
    for name, parameter in trainer.algorithm.networks.named_parameters():
        assert (parameter != ended[best]["networks"][name]).any(), name
    assert trials.state_dict()["best"] is None


class Harder(torchrl_loco.WalkerStand):
    """Asks for more with every step of the training."""

    shared = {"trained": ()}
    episode_length = 8

    def adapt(self, s):
        return {"trained": s.trained + 1.0}

    def reward(self, s):
        return 100.0 - s.trained + torch.zeros_like(s.time)


def test_trials_and_evaluations_are_of_one_stage_of_a_curriculum(tmp_path):
    """A trial begins where the run began; the best policy so far plays at the stage of what it is compared with."""
    settings = {"action_repeat": 1, "lr": 1e-9, "task": torchrl_loco.registry.task_name(Harder)}
    run = made(tmp_path, **settings, total_frames=128, trials=2, trial_fraction=0.25, eval_interval=64)
    Trainer(run).train()
    means = [row["mean"] for row in run.read_evaluations()]
    assert means[0] == means[1] > means[2]  # of two trials of one batch, and two batches more
    info = run.load_policy("cpu").info
    assert info["frames"] == 128
    assert info["selected_by"] == means[-1]
    assert info["stage"]["shared"]["trained"] == run.load_checkpoint("cpu")["stage"]["shared"]["trained"]


def test_each_trial_begins_from_given_weights_and_with_the_first_learning_rate(tmp_path):
    first = made(tmp_path, "ppo", total_frames=BATCH)
    Trainer(first).train()
    trainer = Trainer(made(tmp_path, "ppo", **THREE, init=str(first.path), target_kl=1e-9, lr=1e-3))
    begun = copy.deepcopy(trainer.algorithm.networks.state_dict())
    for _ in range(2):
        trainer.iterate()
    lr = [group["lr"] for optimizer in trainer.algorithm.optimizers.values() for group in optimizer.param_groups]
    assert all(rate < 1e-3 for rate in lr)
    trainer.trials.end(trainer.frames, 1.0)
    assert_same(trainer.algorithm.networks.state_dict(), begun)
    assert all(rate == pytest.approx(1e-3) for rate in lr)


def test_a_run_with_trials(tmp_path, capsys):
    """The first trial is the beginning of a run without any; the policy is that of the best evaluation."""
    run = made(tmp_path, total_frames=5 * BATCH, trials=2, trial_fraction=0.4, eval_interval=3 * BATCH)
    alone = made(tmp_path, total_frames=3 * BATCH)
    for one in (run, alone):
        Trainer(one).train()
    rows = run.read_evaluations()
    assert [row["frames"] for row in rows] == [2 * BATCH, 4 * BATCH, 5 * BATCH]
    out = capsys.readouterr()
    for number, row in enumerate(rows[:2], start=1):
        assert f"trial {number} of 2: {row['mean']:.1f} after 256 frames" in out.out + out.err
    assert run.load_policy("cpu").info["selected_by"] == max(row["mean"] for row in rows)
    assert run.load_checkpoint("cpu")["trials"] == {
        **{"ended": 2, "began": 2 * BATCH, "length": 2 * BATCH},
        **{"mean": rows[0]["mean"], "best": None},
    }
    for name in ("return", "grad_norm", "kl_approx"):
        assert run.read_metrics()[name][:2] == alone.read_metrics()[name][:2]


def test_resumed_while_trials_run(tmp_path):
    """A trial keeps its length, whatever becomes of the run; all are compared after the same number of frames."""
    run = made(tmp_path, total_frames=10 * BATCH, trials=3, trial_fraction=0.2)
    trainer = Trainer(run)
    for _ in range(2):
        trainer.iterate()
    trainer.trials.end(trainer.frames, 500.0)
    trainer.iterate()
    trainer.save()
    longer = Trainer(run, resume=True, total_frames=20 * BATCH)
    longer.iterate()
    assert longer.trials.is_over(longer.frames)
    assert longer.trials.progress(longer.frames) == 2 / 16
    assert Trainer(run, resume=True, total_frames=5 * BATCH).trials.progress(5 * BATCH) == 1.0
