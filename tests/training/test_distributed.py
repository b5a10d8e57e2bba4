"""Several ranks that train one run: what they share, what is their own, and how the run goes on."""

import shutil
import signal

import pytest
import torch
from compare import assert_same
from for_each import for_each
from ranks import BATCH, in_ranks, of_ranks, resumed_by_train
from small_runs import SMALL, made, small_walker

import torchrl_loco
from torchrl_loco import cli
from torchrl_loco.cli.runs import missing_processes
from torchrl_loco.training import Given, RunFolder, Trainer, distributed

pytestmark = pytest.mark.slow  # several processes train


@pytest.fixture(scope="module")
def ranks(tmp_path_factory):
    """What two ranks did, by rank."""
    return in_ranks(of_ranks, tmp_path_factory.mktemp("ranks"))


@for_each("algorithm", ["ppo", "reppo"])
def test_ranks_learn_as_one_from_worlds_of_their_own(ranks, algorithm):
    first, second = (of[algorithm]["updates"] for of in ranks)
    assert len(first) == len(second) == 4
    for (batch, parameters), (other, others) in zip(first, second, strict=True):
        assert_same(parameters, others)
        assert (batch["action"] != other["action"]).all()
        assert (batch["observation"] != other["observation"]).any(-1).all()
    assert all((first[0][1][i] != first[3][1][i]).any() for i in range(3))  # they learn


def test_worlds_are_numbered_over_all_ranks(ranks):
    """Two ranks of n worlds start as one process of 2 n."""
    run = RunFolder(ranks[0]["ppo"]["whole"])
    seed, worlds = run.load_config().seed, 2 * SMALL["num_envs"]
    with small_walker():
        whole = torchrl_loco.make("walker_stand", worlds, "cpu", seed, stagger=True, episode_length=23).reset()
    starts = [of["ppo"]["updates"][0][0]["observation"][:, 0] for of in ranks]
    assert torch.equal(torch.cat(starts), whole["observation"])


def test_observations_of_all_ranks_are_normalised(ranks):
    run = RunFolder(ranks[0]["ppo"]["whole"])
    networks = run.load_checkpoint("cpu")["algorithm"]["networks"]
    (name,) = (name for name in networks if name.startswith("actor") and name.endswith("count"))
    seen = torch.cat([batch["observation"].flatten(0, 1) for of in ranks for batch, _ in of["ppo"]["updates"]])
    var, mean = torch.var_mean(seen, dim=0, correction=0)
    assert networks[name] == len(seen)
    torch.testing.assert_close(networks[name.replace("count", "mean")], mean, atol=1e-4, rtol=1e-4)
    torch.testing.assert_close(networks[name.replace("count", "var")], var, atol=1e-4, rtol=1e-3)


@for_each("algorithm", ["ppo", "reppo"])
def test_a_resumed_run_equals_one_that_was_not_stopped(ranks, algorithm):
    """It was stopped because one rank was asked to end; the state of each rank is in the checkpoint."""
    runs = ranks[0][algorithm]
    whole, stopped = (RunFolder(runs[name]) for name in ("whole", "stopped"))
    assert runs["stopped_at"] == 2
    first, second = whole.load_checkpoint("cpu"), stopped.load_checkpoint("cpu")
    for name in ("frames", "iteration", "algorithm", "trials", "collector", "rng", "further_ranks"):
        assert_same({name: first[name]}, {name: second[name]})
    (further,) = first["further_ranks"]
    assert not torch.equal(first["rng"], further["rng"])  # each rank draws actions and minibatches of its own
    assert not torch.equal(first["algorithm"]["generator"], further["generator"])
    assert first["frames"] == 4 * 2 * BATCH
    assert whole.read_metrics()["return"] == stopped.read_metrics()["return"]
    assert whole.is_finished
    assert stopped.is_finished


def test_another_number_of_ranks(ranks, tmp_path, capsys, monkeypatch):
    """The run continues with fresh worlds and says what changes."""
    run = RunFolder(shutil.copytree(ranks[0]["ppo"]["whole"], tmp_path / "run"))
    with pytest.raises(ValueError, match=r"is complete"):
        Trainer(run, resume=True)
    config = run.path / "config.json"
    text, frames = config.read_text(), 4 * 2 * BATCH
    config.write_text(text.replace(f'"total_frames": {frames}', f'"total_frames": {frames + 3 * BATCH}'))
    before = run.load_checkpoint("cpu")
    trainer = Trainer(run, resume=True)
    assert_same(trainer.algorithm.networks.state_dict(), before["algorithm"]["networks"])
    said = " ".join(capsys.readouterr().err.split())
    assert "ranks: 2 so far, 1 from here on, each with 4 worlds and minibatches of 16" in said
    trainer.train()
    assert run.read_metrics()["frames"][-4:] == [8 * BATCH, 9 * BATCH, 10 * BATCH, 11 * BATCH]
    assert run.load_checkpoint("cpu")["further_ranks"] == []
    monkeypatch.setattr(distributed, "ranks", lambda: 4)
    with pytest.raises(ValueError, match=r"only 0 frames remain, less than a batch of 4 ranks \(512\)"):
        trainer._say_what_changes(1)


def test_messages(ranks):
    first, second = (of["messages"] for of in ranks)
    for got in (first, second):
        torch.testing.assert_close(got["gradients"][:2], [torch.full((2, 3), 1.5), torch.tensor(2.0)])
        assert got["gradients"][2] is None
        assert got["mean"].tolist() == [0.5, 3.0]
        assert got["any"] == [True, False]
        assert got["copied"].tolist() == [0.0, 0.0]
        assert got["from_first"] == "of 0"
        count, mean, var = got["moments"]
        expected = torch.var_mean(torch.cat([first["samples"], second["samples"]]), dim=0, correction=0)
        assert count == 20
        torch.testing.assert_close((var, mean), expected)
    assert (first["gathered"], second["gathered"]) == ([0, 1], [])


def test_what_worlds_share_is_added_up_and_mean_pictures_are_of_all_ranks(ranks):
    steps = 2 * BATCH // SMALL["num_envs"] * SMALL["num_envs"]
    counted, shared = [of["counted"] for of in ranks], {"all_steps": 2 * steps, "own_steps": steps}
    assert [(of["shared"], of["of_three"]) for of in counted] == [(shared, 2.0)] * 2
    with small_walker():  # another number of ranks goes on from there
        alone = Trainer(RunFolder(counted[0]["run"]), resume=True)
    assert {name: int(values) for name, values in alone._base.world.shared.items()} == shared
    alone.env.close()
    pictures = torch.cat([of["seen"]["pictures"] for of in ranks])  # of worlds of each
    for of in ranks:
        assert of["seen"]["count"] == len(pictures)
        torch.testing.assert_close(of["seen"]["mean"], pictures.float().mean(0))


def test_the_launcher_leaves_no_handlers_behind(ranks):
    assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL


def test_one_process_is_all_there_is():
    gradient = torch.ones(2)
    distributed.average([gradient])
    assert torch.equal(gradient, torch.ones(2))
    assert (distributed.rank(), distributed.ranks(), distributed.own_seed(7)) == (0, 1, 7)
    assert distributed.any_rank(True, False) == [True, False]
    assert distributed.own_device("cuda:3") == "cuda:3"
    with distributed.joined("cpu"):
        assert not torch.distributed.is_initialized()


def test_what_several_ranks_cannot_do(tmp_path, monkeypatch):
    monkeypatch.setattr(distributed, "ranks", lambda: 2)
    with pytest.raises(ValueError, match="device 'cuda:3' is one GPU, but there are 2 ranks"):
        distributed.own_device("cuda:3")
    run = made(tmp_path, total_frames=2 * BATCH - 1)
    with pytest.raises(ValueError, match=rf"total_frames \({2 * BATCH - 1}\) must be at least {2 * BATCH}"):
        Trainer(run)
    run = made(tmp_path, total_frames=8 * BATCH, trials=2)
    with pytest.raises(ValueError, match=rf"trial_fraction \({8 * BATCH // 5}\) must be at least {2 * BATCH}"):
        Trainer(run)
    for name, value in {"RANK": "1", "WORLD_SIZE": "2", "LOCAL_RANK": "1"}.items():
        monkeypatch.setenv(name, value)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 1)
    with pytest.raises(ValueError, match="no GPU for local rank 1, this machine has 1"), distributed.joined("cuda"):
        pass


def test_the_way_to_resume_keeps_the_number_of_ranks(monkeypatch):
    way = Given().way_to_resume
    assert way("runs/a", 1) == "torchrl-loco resume runs/a"
    assert way("my runs/a", 1) == "torchrl-loco resume 'my runs/a'"
    monkeypatch.setenv("LOCAL_WORLD_SIZE", "2")
    assert way("runs/a", 2) == "torchrl-loco resume runs/a --gpus 2"
    assert way("runs/a", 4).startswith("torchrun, with the options of this launch")  # several machines


def test_wrong_numbers_of_gpus(tmp_path, monkeypatch, capsys):
    command = ["train", "walker_stand", "--device=cpu", f"--out={tmp_path}"]
    cases = {
        "--gpus=0": "gpus must lie in [1, 2**31)",
        "--gpus=2 --seeds 0 1": "pass --seed with several GPUs",
        "--gpus=x": "Error parsing --gpus",
    }
    for options, message in cases.items():
        with pytest.raises(SystemExit, match="2"):
            cli.main([*command, *options.split()])
        said = capsys.readouterr()
        assert message in " ".join((said.out + said.err).replace("│", " ").split())
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 1)
    with pytest.raises(ValueError, match="gpus must be at most the 1 GPUs"):
        missing_processes(2, "cuda:0")
    monkeypatch.setenv("RANK", "0")
    monkeypatch.setenv("WORLD_SIZE", "4")
    with pytest.raises(SystemExit, match="2"):
        cli.main([*command, "--gpus=2"])
    assert "torchrun has started 4 processes: leave --gpus 2 out" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_ranks_resume_by_train(ranks, tmp_path):
    """Each calls it before they are connected; then they are connected anew."""
    path, frames = shutil.copytree(ranks[0]["ppo"]["whole"], tmp_path / "run"), 6 * 2 * BATCH
    assert in_ranks(resumed_by_train, path, frames, connected=False) == [frames, frames]
    assert RunFolder(path).load_config().total_frames == frames
    assert not (path / "lock").exists()
