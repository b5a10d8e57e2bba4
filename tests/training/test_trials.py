"""Several beginnings of a run, of which the best goes on."""

import copy
import itertools

import pytest
from compare import assert_same
from small_runs import made, networks

from torchrl_loco.training import Trainer

BATCH = 4 * 8 * 4
"""Frames of a batch."""
THREE = {"trials": 3, "trial_fraction": 0.3, "total_frames": 8 * BATCH}
"""Trials of two whole batches, and two further ones."""


def knowledge(trainer):
    return copy.deepcopy(trainer.algorithm.parameters_and_moments())


def moments(trainer):
    optimizers = trainer.algorithm.parameters_and_moments()["optimizers"]
    return [value for of in optimizers.values() for state in of.values() for value in state.values()]


@pytest.mark.parametrize("algorithm", ["ppo", "reppo"])
@pytest.mark.parametrize("best", [0, 1, 2])
def test_the_best_goes_on(algorithm, best, tmp_path):
    trainer = Trainer(made(tmp_path, algorithm, **THREE))
    trials, ended = trainer.trials, []
    begun = [knowledge(trainer)]
    for number in range(3):
        assert trials.progress(trainer.frames) == 0.0
        trainer._iterate()
        assert not trials.is_over(trainer.frames)
        trainer._iterate()
        assert trials.is_over(trainer.frames)
        ended.append(knowledge(trainer))
        trials.end(trainer.frames, 500.0 if number == best else 100.0 * number)
        if number < 2:
            begun.append(knowledge(trainer))
            assert not any(value.any() for value in moments(trainer))
            assert trainer.algorithm.norm.count == 0
    assert not trials.running
    assert_same(knowledge(trainer), ended[best])
    for one, other in itertools.combinations(begun, 2):
        matrices = [(value, other["networks"][name]) for name, value in one["networks"].items() if value.dim() == 2]
        assert matrices
        assert all((first != second).any() for first, second in matrices)
    assert trials.progress(trainer.frames) == 0.5  # two of its four batches
    trainer._iterate()
    assert any((value != ended[best]["networks"][name]).any() for name, value in knowledge(trainer)["networks"].items())
    assert trials.state_dict()["best"] is None


def test_a_run_with_trials(tmp_path, capsys):
    """The first trial is the run without any; the policy is that of the best evaluation."""
    run = made(tmp_path, total_frames=5 * BATCH, trials=2, trial_fraction=0.4)
    alone = made(tmp_path, total_frames=2 * BATCH, final_lr_fraction=1.0)
    for one in (run, alone):
        Trainer(one).train()
    rows = run.read_evaluations()
    assert [row["frames"] for row in rows] == [2 * BATCH, 4 * BATCH, 5 * BATCH]
    out = capsys.readouterr()
    for number, row in enumerate(rows[:2], start=1):
        assert f"trial {number} of 2: {row['mean']:.1f} after 256 frames" in out.out + out.err
    assert run.load_policy("cpu").info["selected_by"] == max(row["mean"] for row in rows)
    assert run.load_checkpoint("cpu")["trials"] == {
        "ended": 2,
        "began": 2 * BATCH,
        "mean": rows[0]["mean"],
        "best": None,
    }
    assert run.read_metrics()["return"][0] == alone.read_metrics()["return"][0]
    assert networks(run).keys() == networks(alone).keys()
