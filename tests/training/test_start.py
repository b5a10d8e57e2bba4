"""``train``: what it takes, what it returns, and how what was handed in as an object is continued."""

import dataclasses
import gc
import json
import multiprocessing
import re
import shutil
import sys
import weakref
from types import SimpleNamespace

import pytest
import torch
from compare import assert_same
from for_each import for_each
from hook_tasks import Unsteady
from small_runs import SMALL, made, networks, trained
from torch import nn
from torchrl.envs import ObservationNorm, StepCounter, VecNormV2

import torchrl_loco
from torchrl_loco import Vary, cli, known_files, registry
from torchrl_loco.policy import Policy
from torchrl_loco.source import content_of
from torchrl_loco.training import PPO, Given, RunFolder, Trainer, begin, evaluate_policy, preset, train
from torchrl_loco.training.algorithm import Algorithm
from torchrl_loco.training.config import PPOConfig
from torchrl_loco.training.environments import Environments
from torchrl_loco.training.start import _warn_of_what_is_not_kept
from torchrl_loco.training.watching import last_policy

QUICK = {**SMALL, "logger": ("csv",)}


def elu(inputs, outputs):
    return nn.Sequential(nn.Linear(inputs, 8), nn.ELU(), nn.Linear(8, outputs))


class Counted(PPO):
    """PPO that counts its updates."""

    updates = 0

    def update(self, batch, progress):
        type(self).updates += 1
        return super().update(batch, progress)


def test_what_train_returns_is_what_the_trainer_leaves(tmp_path, capsys):
    run = train("mjx/walker_stand-v0", device="cpu", out=tmp_path / "a", **QUICK)
    assert f"run folder: {run.path}\n" in capsys.readouterr().out
    assert_same(networks(run), networks(trained(tmp_path / "b", **{**QUICK})))
    assert run.is_finished
    config = run.load_config()
    again = train(torchrl_loco.WalkerStand, config, seed=3, out=tmp_path / "c")
    assert again.load_config().seed == 3
    assert again.load_config().num_envs == SMALL["num_envs"]


@for_each("algorithm", ["ppo", "reppo"])
def test_networks_of_ones_own(algorithm, tmp_path):
    """They are what is trained, saved and played; PPO's critic is one too."""
    sizes = []
    run = train(
        "walker_stand",
        network=lambda *size: sizes.append(size) or elu(*size),
        algorithm=algorithm,
        device="cpu",
        out=tmp_path,
        **QUICK,
    )
    assert sizes == ([(24, 6), (24, 1)] if algorithm == "ppo" else [(24, 12)])
    layers = [type(layer) for layer in run.load_policy("cpu").module]
    assert layers[1:] == [nn.Linear, nn.ELU, nn.Linear, nn.Tanh]


def test_a_network_that_cannot_be_saved_is_refused_before_the_first_frame(tmp_path, monkeypatch):
    monkeypatch.setattr(Algorithm, "update", None)

    class Residual(nn.Module):
        def __init__(self, inputs, outputs):
            super().__init__()
            self.layer = nn.Linear(inputs, outputs)

        def forward(self, x):
            return self.layer(x)

    class Twice(nn.Sequential):
        def forward(self, x):
            return 2 * super().forward(x)

    cases = [
        (Residual, TypeError, "cannot hold Residual.* nn.Sequential of Linear, LayerNorm, SiLU, ELU"),
        (lambda i, o: Twice(nn.Linear(i, o)), RuntimeError, "would act differently from the actor"),
    ]
    for network, error, message in cases:
        with pytest.raises(error, match=message):
            train("walker_stand", network=network, device="cpu", out=tmp_path, **QUICK)
    ends = lambda i, o: nn.Sequential(nn.Linear(i, o), nn.ELU())  # noqa: E731
    with pytest.raises(TypeError, match="must end in a Linear"):
        train("walker_stand", network=ends, algorithm="reppo", device="cpu", out=tmp_path, **QUICK)
    assert list(tmp_path.iterdir()) == []


@for_each("algorithm", ["ppo", "reppo"])
def test_a_wrong_network(algorithm, tmp_path, capsys):
    cases = [
        (elu(24, 6), TypeError, "must be a function of the numbers of inputs and outputs .* got Sequential"),
        (lambda inputs: elu(inputs, 6), TypeError, "cannot be called with two numbers: too many"),
        (lambda inputs, outputs: None, TypeError, "but returned NoneType"),
        (
            lambda inputs, outputs: elu(inputs + 1, outputs),
            ValueError,
            r"network\(24, .*\) must take rows of 24 numbers",
        ),
        (lambda inputs, outputs: elu(inputs, 5), ValueError, r"must give (6|12) numbers for each row, but gave \(5,\)"),
    ]
    for network, error, message in cases:
        with pytest.raises(error, match=message):
            train("walker_stand", network=network, algorithm=algorithm, device="cpu", out=tmp_path, **QUICK)
    assert list(tmp_path.iterdir()) == []
    assert "run folder" not in capsys.readouterr().out  # which would name one that is gone


def test_objects_are_handed_in_again_where_a_run_goes_on(tmp_path, capsys):
    Counted.updates = 0
    run = train("walker_stand", network=elu, algorithm=Counted, device="cpu", out=tmp_path, **QUICK)
    assert Counted.updates == 2
    assert run.load_config().algorithm == "ppo"
    with pytest.raises(SystemExit, match="2"):
        cli.main(["resume", str(run.path), "--total_frames", "384"])
    call = f"torchrl_loco.training.train(task, network=..., algorithm=..., resume={str(run.path)!r})"
    assert (
        f"was begun with network and algorithm of your own, which the folder does not hold: continue it in Python "
        f"with {call}" in capsys.readouterr().err
    )
    with pytest.raises(ValueError, match=re.escape(call)):
        train("walker_stand", network=elu, resume=run, total_frames=384)
    with pytest.raises(ValueError, match="is a run of walker_stand, but task is walker_run"):
        train("walker_run", network=elu, algorithm=Counted, resume=run, total_frames=384)
    with pytest.raises(ValueError, match="keeps its settings: pass no other than total_frames"):
        train("walker_stand", network=elu, algorithm=Counted, resume=run, seed=2)
    again = train("walker_stand", network=elu, algorithm=Counted, resume=str(run.path), total_frames=384)
    assert (again.path, Counted.updates) == (run.path, 3)
    plain = made(tmp_path)
    plain.save_checkpoint({})
    with pytest.raises(ValueError, match="was begun without network of yours"):
        train("walker_stand", network=elu, resume=plain)


def test_an_environment_that_is_made_already(tmp_path, caplog):
    """Its worlds, protocol, settings and transforms are used, and it stays open."""
    base = torchrl_loco.make("walker_stand", 4, "cpu", seed=7, protocol="dm_control", episode_length=16, sim_dt=0.005)
    env = torchrl_loco.TransformedEnv(base, StepCounter())
    env.append_transform(ObservationNorm(loc=0.0, scale=0.5, in_keys=["observation"], standard_normal=False))
    settings = {name: value for name, value in QUICK.items() if name not in ("num_envs", "action_repeat")}
    run = train(env, algorithm="ppo", out=tmp_path, **settings)
    config = run.load_config()
    assert (config.task, config.seed, config.protocol) == ("walker_stand", 7, "dm_control")
    assert (config.num_envs, config.episode_length, config.action_repeat) == (4, 16, 1)
    assert run.given == ("env",)
    assert config.of_env == {"sim_dt": 0.005}
    assert not env.is_closed
    with pytest.raises(ValueError, match=r"was begun with sim=\{'sim_dt': 0.005\}, the environment has \{\}"):
        train(torchrl_loco.make("walker_stand", 4, "cpu", seed=7, protocol="dm_control"), resume=run)
    metrics = run.read_metrics()
    assert metrics["episodes"][-1] == 4 * 64 // 16  # of worlds that begin together, the first counts too
    assert set(metrics["episode_length"][1:]) == {16.0}
    for policy in (run.load_policy("cpu"), last_policy(run, "cpu")):
        with pytest.raises(ValueError, match="was trained behind StepCounter, ObservationNorm"):
            evaluate_policy(policy)
    with pytest.raises(ValueError, match="num_envs is that of the environment, 4"):
        train(env, algorithm="ppo", out=tmp_path, **{**settings, "num_envs": 8})
    noisy = torchrl_loco.make("walker_stand", 4, "cpu", noise_scale=0.5, randomize=[Vary("body_mass", 0.9, 1.1)])
    _warn_of_what_is_not_kept(noisy)
    assert "has a noise_scale and a randomize of its own" in caplog.text
    for sim, message in (({"sim_dt": 0.01}, r"with sim_dt=0\.005"), ({"iteration": 7}, "did you mean 'iterations'")):
        with pytest.raises(ValueError, match=message):
            train(env, algorithm="ppo", out=tmp_path, **{**settings, "sim": sim})
    other = preset("walker_stand", "cpu", "ppo", out=tmp_path, sim={"sim_dt": 0.01}, **QUICK)
    again = train(env, other, total_frames=64, randomize=False, sim={"sim_dt": 0.005})
    assert again.load_config().of_env == {"sim_dt": 0.005}
    with pytest.raises(ValueError, match="make the environment with num_envs=1 or more"):
        train(torchrl_loco.make("walker_stand", None, "cpu"), out=tmp_path)


def test_what_does_not_fit(tmp_path):
    config = preset("walker_stand", "cpu", "ppo", out=tmp_path, **QUICK)
    cases = [
        (("walker_run", config), {}, "config is for walker_stand, but task is walker_run"),
        (("walker_stand", config), {"algorithm": "reppo"}, "config is of ppo, but algorithm is reppo"),
        (("walker_stand", config), {"gama": 0.9}, "did you mean 'gamma'"),
        (("walker_stand",), {"device": "cpu", "gama": 0.9}, "did you mean 'gamma'"),
    ]
    for args, more, message in cases:
        with pytest.raises(ValueError, match=message):
            train(*args, **more)
    assert list(tmp_path.iterdir()) == []

    class Gait(torchrl_loco.WalkerWalk):
        options = {"gamma": (0.5, "how sharp")}

    with pytest.raises(ValueError, match=r"Gait.options: 'gamma' is a setting of training, too: rename it"):
        train(Gait, device="cpu", out=tmp_path, gamma=0.9)


def test_a_class_that_cannot_be_made_leaves_no_folder(tmp_path):
    file = tmp_path / "wrong.py"
    file.write_text(
        "import torchrl_loco\n"
        "class NoModel(torchrl_loco.LocoEnv): pass\n"
        "class NoFile(torchrl_loco.WalkerStand): model = 'none.xml'\n"
    )
    for name, error, message in (("NoModel", TypeError, "must set model"), ("NoFile", OSError, "no model 'none.xml'")):
        with pytest.raises(error, match=message):
            train(f"{file}:{name}", algorithm="ppo", device="cpu", out=tmp_path / "runs", **QUICK)
        assert list((tmp_path / "runs").iterdir()) == []


def test_what_an_edit_changes_is_noticed(tmp_path):
    files = {"task.py": "import torchrl_loco, helper\nclass A(torchrl_loco.LocoEnv):\n    model = 'robot.xml'\n"}
    files |= {"helper.py": "K = 1\n", "robot.xml": "<mujoco><worldbody/></mujoco>", "other.py": "\n"}
    for name, text in files.items():
        (tmp_path / name).write_text(text)
    frames = {"place": torch.zeros(3, 2)}
    env = SimpleNamespace(hooks=SimpleNamespace(catalog=SimpleNamespace(constants=frames)))

    def content():
        known_files.remember(tmp_path / "task.py")
        return content_of(f"{tmp_path / 'task.py'}:A", env)

    seen = {content()}
    (tmp_path / "other.py").write_text("# nobody imports it\n")
    assert {content()} == seen
    for name in ("task.py", "helper.py", "robot.xml"):
        (tmp_path / name).write_text(files[name] + "\n")
        seen.add(content())
    frames["place"][2, 1] = 1.0
    seen.add(content())
    assert len(seen) == 5


TASK = '''
import torch, torchrl_loco

class StandShaky(torchrl_loco.WalkerStand):
    """Stand up, or fall."""

    def reward(self, s):
        return {"height": s.xpos("torso")[:, 2] - 1.0}

    def terminated(self, s):
        return s.time > 0.3
'''


@pytest.mark.slow
def test_a_class_in_a_file(tmp_path, monkeypatch, capsys):
    """Trained, evaluated, resumed, recorded and exported by the command line; without the file, it is named."""
    file = tmp_path / "tasks" / "shaky.py"
    file.parent.mkdir()
    file.write_text(TASK)
    monkeypatch.chdir(tmp_path)
    small = [f"--{key}={value}" for key, value in SMALL.items() if key != "hidden"]
    assert cli.main(["train", "tasks/shaky.py:StandShaky", *small, "--hidden=16", "--device=cpu", "--out=runs"]) == 0
    (path,) = (tmp_path / "runs").iterdir()
    assert path.name.startswith("StandShaky-")
    run = RunFolder(path)
    assert run.load_config().task == f"{file}:StandShaky"
    assert run.load_policy("cpu").info["task"] == f"{file}:StandShaky"
    assert "reward/height" in run.read_metrics()
    assert cli.main(["resume", str(path), "--total_frames=384"]) == 0
    assert "was edited" not in capsys.readouterr().err

    def rewrite(text):
        file.write_text(text)
        sys.modules.pop(registry._name_of(file))  # as in another process

    edited = TASK.replace("- 1.0", "- 9.0")  # so that no policy earns what one did
    rewrite(edited)
    for frames, said in ((512, True), (640, False)):  # by the second time the checkpoint is of the new one
        assert cli.main(["resume", str(path), f"--total_frames={frames}"]) == 0
        assert (
            "StandShaky (a file or option of it, its model or a motion) was edited since" in capsys.readouterr().err
        ) == said
    assert run.load_policy("cpu").info["frames"] >= 512  # the best of those that were evaluated in this task
    rewrite(edited + "\n    def observation(self, s):\n        return s.qpos\n")
    with pytest.raises(SystemExit):
        cli.main(["resume", str(path), "--total_frames=768"])
    assert "networks were made for other sizes (observation 24, now 9): train anew" in capsys.readouterr().err
    rewrite(edited)
    assert cli.main(["eval", str(path), "--device=cpu"]) == 0
    capsys.readouterr()
    for command in (
        ["eval", "tasks/shaky.py:StandShaky", "--policy", str(path), "--episodes=2", "--device=cpu"],
        ["eval", "walker_walk", "--policy", str(path), "--episodes=2", "--device=cpu"],
        ["record", "walker_walk", "--policy", str(path), "--seconds=0.05", "--device=cpu"],
    ):
        assert cli.main(command) == 0
    said = capsys.readouterr().out
    assert said.count("over 2 episodes") == 2
    assert (tmp_path / "walker_walk.mp4").exists()
    assert cli.main(["export", str(path), "--format", "torch"]) == 0
    with pytest.raises(SystemExit, match="2"):
        cli.main(["eval", "tasks/shaky.py:StandShaky"])
    assert "name one of yours with --policy" in capsys.readouterr().err
    moved = file.rename(tmp_path / "moved.py")
    assert (path / "source" / "shaky.py").read_text() == moved.read_text()
    forget(monkeypatch)
    for command in (
        ["eval", str(path), "--episodes=2", "--device=cpu"],
        ["eval", str(run.policy), "--episodes=2", "--device=cpu"],
        ["record", str(path), "--seconds=0.05", "--device=cpu"],
        ["resume", str(path), "--total_frames=768"],
    ):
        assert cli.main(command) == 0
    assert run.load_config().task == Policy.load(run.policy, "cpu").info["task"] == f"{file}:StandShaky"
    assert "was edited" not in capsys.readouterr().err
    shutil.rmtree(path / "source")
    forget(monkeypatch)
    commands = (["eval", str(path), "--episodes=2", "--device=cpu"], ["resume", str(path), "--total_frames=896"])
    for command in commands:
        with pytest.raises(SystemExit, match="2"):
            cli.main(command)
        assert f"there is no file {file}" in capsys.readouterr().err
    for command in commands:
        assert cli.main([*command, f"--task={moved}:StandShaky"]) == 0
    assert [copy.read_text() for copy in (path / "source").iterdir()] == [moved.read_text()]
    moved.unlink()
    forget(monkeypatch)
    assert cli.main(commands[0]) == 0
    assert cli.main(["plot", str(path), "--out=curve.png"]) == 0


def forget(monkeypatch):
    """Continues as another process would."""
    monkeypatch.setattr(registry, "_named", {})
    for name in [name for name in sys.modules if name.startswith(("shaky", "moved", "evil", "gone"))]:
        monkeypatch.delitem(sys.modules, name)


@pytest.mark.slow
def test_a_run_of_a_stranger_runs_nothing(ppo_run, tmp_path, monkeypatch, capsys):
    """Its file is asked for, in its place and as a copy; the line that the message gives is what lets it run."""
    run = RunFolder(shutil.copytree(ppo_run.path, tmp_path / "run"))
    mark, evil = tmp_path / "mark", tmp_path / "evil.py"
    text = f"import torchrl_loco\nopen({str(mark)!r}, 'w').close()\nclass X(torchrl_loco.WalkerStand): pass\n"
    evil.write_text(text)
    (run.path / "source").mkdir()
    (run.path / "source" / "gone.py").write_text(f"{text}\n")  # another one: what is known is known by its hash
    monkeypatch.chdir(tmp_path)
    for named, asked in (("evil.py:X", evil), (f"{tmp_path}/gone.py:X", run.path / "source" / "gone.py")):
        config = json.loads((run.path / "config.json").read_text())
        (run.path / "config.json").write_text(json.dumps({**config, "task": named}))
        policy = Policy.load(run.policy, "cpu")
        policy.info["task"] = run.load_config().task
        policy.save(run.policy)
        checkpoint = torch.load(run.checkpoint, weights_only=True)
        checkpoint["settings"]["task"] = run.load_config().task
        torch.save(checkpoint, run.checkpoint)
        commands = (
            f"eval {run.path} --episodes=1 --device=cpu",
            f"eval {run.policy} --episodes=1 --device=cpu",
            f"play {run.path} --seconds=.1 --device=cpu --out=x.mp4",
            f"record {run.path} --seconds=.1 --device=cpu --out=x.mp4",
            f"verify {run.path} --episodes=1 --seconds=.1 --device=cpu",
            f"resume {run.path} --total_frames=384",
            f"watch {run.path}",
        )
        for command in commands:
            with pytest.raises(SystemExit, match="2"):
                cli.main(command.split())
            said = capsys.readouterr().err
            assert f"{asked} was not run" in said, command
            assert f"--task {asked}:X" in said
        assert cli.main(["plot", str(run.path)]) == 0
        assert cli.main(["export", str(run.path), "--format=torch"]) == 0
        assert f"the network alone: its task is not at hand: {asked} was not run" in capsys.readouterr().out
        assert not mark.exists()
        assert cli.main(["eval", str(run.path), "--episodes=1", "--device=cpu", f"--task={asked}:X"]) == 0
        mark.unlink()
        forget(monkeypatch)
        assert cli.main(["eval", str(run.path), "--episodes=1", "--device=cpu"]) == 0
        mark.unlink()


@pytest.mark.slow
def test_a_run_that_was_stopped_is_played_from_its_checkpoint(tmp_path, capsys):
    trainer = Trainer(made(tmp_path))
    for _ in range(2):
        trainer.iterate()
    trainer.save()
    run = str(trainer.run.path)
    for command in (["eval", run, "--episodes=2", "--device=cpu"], ["export", run, "--format=torch"]):
        assert cli.main(command) == 0
        said = capsys.readouterr()
        assert "no policy was evaluated yet, this is that of the last checkpoint, after 256 frames" in said.err
    assert cli.main(["eval", "walker_run", "--policy", run, "--episodes=2", "--device=cpu"]) == 0
    assert cli.main(["export", "walker_run", "--policy", run, "--format=torch", f"--out={tmp_path / 'x.pt2'}"]) == 0
    with pytest.raises(SystemExit, match="2"):
        cli.main(["eval", "walker_run", "--policy", run, "--task=walker_run"])
    assert "walker_run names the task already: leave --task out" in capsys.readouterr().err


HOOKS = {
    **QUICK,
    "num_envs": 8,
    "num_steps": 16,
    "minibatch_size": 64,
    "action_repeat": 1,
    "episode_length": 60,
    "eval_episodes": 2,
    "total_frames": 512,
}


def in_parts(task, out, settings):
    """Returns a run that was stopped after two batches, and resumed."""
    trainer = Trainer(RunFolder.create(preset(task, out=out, **settings)))
    for _ in range(2):
        trainer.run.append_metrics(trainer.iterate())
    trainer.save()
    Trainer(trainer.run, resume=True).train()
    return trainer.run


class Clumsy(Unsteady):
    """Falls at random too."""

    def terminated(self, s):
        return super().terminated(s) | (s.uniform(0.0, 1.0) < 0.05)


@pytest.mark.parametrize("algorithm", ["ppo", pytest.param("reppo", marks=pytest.mark.slow)])
def test_a_task_with_memory_falls_and_what_the_critic_alone_reads(algorithm, tmp_path):
    """Episodes end early, and a run that is stopped and goes on equals one that was not."""
    more = {"min_value": -20.0, "max_value": 20.0} if algorithm == "reppo" else {}
    settings = {"algorithm": algorithm, "device": "cpu", **HOOKS, **more}
    whole = train(Clumsy, out=tmp_path / "whole", **settings)
    parts = in_parts(Clumsy, tmp_path / "parts", settings)
    metrics = whole.read_metrics()
    assert metrics["episodes"][-1] > 3
    assert metrics["episode_length"][-1] < 60
    assert {"reward/height", "reward/rate"} <= metrics.keys()
    assert len(Policy.load(whole.policy, "cpu").module[0].mean) == 23  # the actor does not read what the critic does
    sizes = {name: len(value) for name, value in networks(whole).items() if name.endswith("mean")}
    assert set(sizes.values()) == {23, 26}
    for name in ("return", "episode_length", "episodes", "reward/rate"):
        assert parts.read_metrics()[name] == metrics[name]
    assert_same(networks(parts), networks(whole))


def test_a_refused_resume_changes_nothing(ppo_run, tmp_path):
    """Neither a file nor the lock."""
    run = RunFolder(shutil.copytree(ppo_run.path, tmp_path / "run"))
    run.append_metrics({**{name: values[-1] for name, values in run.read_metrics().items()}, "frames": 384})
    before = {file: file.read_bytes() for file in run.path.iterdir() if file.is_file()}
    with pytest.raises(ValueError, match="must be at least the 256 frames"):
        train("walker_stand", resume=run, total_frames=128)
    with pytest.raises(ValueError, match="no device 'cuda:99' on this machine"):
        train("walker_stand", resume=run, total_frames=512, device="cuda:99")
    assert {file: file.read_bytes() for file in run.path.iterdir() if file.is_file()} == before


def test_a_run_goes_on_on_another_device(ppo_run, tmp_path, caplog):
    """Of CUDA as far as its files say: a generator's state has another size there, and Adam other flags."""
    run = RunFolder(shutil.copytree(ppo_run.path, tmp_path / "run"))
    checkpoint = run.load_checkpoint("cpu")
    checkpoint["cuda_rng"] = checkpoint["algorithm"]["generator"] = torch.zeros(16, dtype=torch.uint8)
    for optimizer in checkpoint["algorithm"]["optimizers"].values():
        optimizer["param_groups"][0]["capturable"] = True
    run.save_checkpoint(checkpoint)
    run.store_config(run.load_config(device="cuda"))
    assert cli.main(["resume", str(run.path), "--device=cpu", "--total_frames=384"]) == 0
    assert "device: cuda so far, cpu from here on" in caplog.text
    assert run.load_config().device == "cpu"
    train("walker_stand", resume=run, device="cpu", total_frames=512)
    assert run.read_metrics()["frames"] == [128, 256, 384, 512]
    assert "cpu so far" not in caplog.text


@pytest.mark.filterwarnings("ignore:Support of VecNormV2 for containers:UserWarning")  # for any batch
def test_what_transforms_have_learned_is_in_the_checkpoint(tmp_path):
    """A run that was stopped and goes on behind new ones equals one that was not."""

    def env():
        base = torchrl_loco.make("walker_stand", 4, "cpu", seed=7, episode_length=16)
        return torchrl_loco.TransformedEnv(base, VecNormV2(["observation"], reduce_batch_dims=True))

    settings = {**{name: value for name, value in QUICK.items() if name != "num_envs"}, "action_repeat": 1}
    whole = train(env(), algorithm="ppo", out=tmp_path, **settings)
    trainer = begin(whole.load_config(), Given(env=env()))
    trainer.iterate()
    trainer.save()
    assert_same(networks(train(env(), resume=trainer.run)), networks(whole))


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:world 0 became non-finite")
def test_what_cannot_teach_anything_is_said(tmp_path, capsys):
    """Rewards that are all NaN end a training; the same reward everywhere, and episodes of one step, are said once."""
    hooks = {
        "Nothing": {"reward": lambda self, s: s.time * float("nan")},
        "Alike": {"reward": lambda self, s: 0 * s.time + 2.0},
        "AtOnce": {"reward": lambda self, s: s.qpos[:, 0], "terminated": lambda self, s: s.time > 0},
    }
    tasks = {name: type(name, (torchrl_loco.WalkerStand,), each) for name, each in hooks.items()}
    with pytest.raises(ValueError, match=r"in all steps of a batch .* was not finite"):
        train(tasks["Nothing"], algorithm="ppo", device="cpu", out=tmp_path, **SMALL)
    notes = {
        "Alike": "the reward was 2 in every step of every world",
        "AtOnce": "every episode ended at its first step",
    }
    for name, note in notes.items():
        train(tasks[name], algorithm="ppo", device="cpu", out=tmp_path, **{**SMALL, "action_repeat": 1})
        said = capsys.readouterr()
        assert (said.out + said.err).count(note) == 1


def test_networks_that_are_not_finite_replace_nothing(tmp_path, monkeypatch):
    """Neither the last checkpoint nor the best policy."""
    update = PPO.update

    def diverging(ppo, batch, progress):
        metrics = update(ppo, batch, progress)
        if progress > 0.4:
            ppo.critic.module[1][0].bias.data.fill_(torch.nan)
        return metrics

    monkeypatch.setattr(PPO, "update", diverging)
    settings = {**QUICK, "total_frames": 512, "eval_interval": 128, "checkpoint_seconds": 0.0}
    with pytest.raises(ValueError, match=r"networks of .* are not finite after 384 frames: a smaller lr may help"):
        train("walker_stand", algorithm="ppo", device="cpu", out=tmp_path, **settings)
    (run,) = map(RunFolder, tmp_path.iterdir())
    assert run.load_checkpoint("cpu")["frames"] == 256
    assert [row["frames"] for row in run.read_evaluations()] == [128, 256]


def test_settings_of_an_algorithm_of_ones_own_may_be_defined_again(tmp_path):
    """In a cell of a notebook that runs twice; those of the package keep their names."""

    def mine(beta, name="mine"):
        fields = [("beta", float, beta)]
        settings = dataclasses.make_dataclass("MineConfig", fields, bases=(PPOConfig,), frozen=True)
        settings.algorithm = name
        return type("Mine", (PPO,), {"config_type": settings})

    for beta in (0.1, 0.7):
        run = train("walker_stand", algorithm=mine(beta), device="cpu", out=tmp_path, **QUICK)
        assert run.load_config().beta == beta
    with pytest.raises(ValueError, match=r"MineConfig.algorithm is 'ppo', which is PPOConfig's: give it a name"):
        train("walker_stand", algorithm=mine(0.1, "ppo"), device="cpu", out=tmp_path, **QUICK)


def test_earlier_trainings_of_a_process_leave_no_memory_behind(tmp_path, monkeypatch):
    config = preset("walker_stand", "cpu", "ppo", out=tmp_path, **QUICK)
    monkeypatch.setattr(gc, "isenabled", lambda: False)
    gc.disable()
    try:
        trainer = begin(config)
        trainer.train()
        known = [weakref.ref(each) for each in (trainer.algorithm, trainer.collector, trainer.env)]
        del trainer
        begin(config)
        assert [each() for each in known] == [None] * 3
    finally:
        gc.enable()


def test_a_script_that_is_read_for_its_class_does_not_train_again(tmp_path, monkeypatch):
    script = tmp_path / "trains.py"
    script.write_text(
        "import torchrl_loco\n"
        "from torchrl_loco.training import train\n"
        "class Slowly(torchrl_loco.WalkerWalk):\n"
        "    target_speed = 0.25\n"
        f"train(Slowly, out={str(tmp_path / 'runs')!r})\n"
        "raise AssertionError\n"
    )
    assert registry.resolve(f"{script}:Slowly", by_user=True).target_speed == 0.25
    assert not (tmp_path / "runs").exists()
    monkeypatch.setattr(
        multiprocessing.current_process(), "_inheriting", True, raising=False
    )  # a child reads its script
    with pytest.raises(RuntimeError, match="would train again: put what it does"):
        train("walker_walk", out=tmp_path / "runs")
    assert not (tmp_path / "runs").exists()


ORDERED = """import torchrl_loco
class Ordered(torchrl_loco.WalkerStand):
    def observation(self, s):
        return {"observation": {"pos": s.qpos, "vel": s.qvel}}
"""


def test_terms_that_are_observed_in_another_order_are_refused(tmp_path):
    """Their sizes may be the same: networks would learn on from the wrong numbers."""
    file = tmp_path / "task.py"
    file.write_text(ORDERED)
    run = train(f"{file}:Ordered", device="cpu", out=tmp_path / "runs", **SMALL)
    file = tmp_path / "edited" / "task.py"  # in its place it would not be imported again
    file.parent.mkdir()
    file.write_text(ORDERED.replace('"pos": s.qpos, "vel": s.qvel', '"vel": s.qvel, "pos": s.qpos'))
    with pytest.raises(ValueError, match="observes vel, pos: another order"):
        train(f"{file}:Ordered", resume=run.path, total_frames=run.load_config().total_frames + 1000)
    for source in (run.path, run.policy):
        with pytest.raises(ValueError, match="this run observes vel, pos: another order"):
            train(f"{file}:Ordered", device="cpu", init=source, out=tmp_path / "other", **SMALL)


def test_a_repeated_action_ends_with_its_episode(tmp_path):
    """Beside worlds in which each step is an action of its own: what they earn, and see last."""
    settings = {"num_envs": 8, "episode_length": 10, "num_steps": 4, "minibatch_size": 32}
    configs = [preset("walker_walk", "cpu", action_repeat=repeat, **settings) for repeat in (3, 1)]
    env, single = (Environments(config).training(tmp_path / "dump.safetensors") for config in configs)
    td, each, over = env.reset(), single.reset(), torch.zeros(8, 1, dtype=torch.bool)
    for _ in range(4):
        action = env.action_spec.rand()
        after, runs, earned = env.step(td.set("action", action))["next"], ~over, torch.zeros(8, 1)
        for _ in range(3):
            alone = single.step(each.set("action", action))["next"]
            earned += torch.where(over, 0.0, alone["reward"])
            over |= (ends := ~over & alone["done"])
            assert torch.equal(after["observation"][ends[:, 0]], alone["observation"][ends[:, 0]])
            each = alone.exclude("reward")
        assert torch.allclose(after["reward"][runs], earned[runs])
        td = after.exclude("reward")
    assert over.all()


def test_an_option_that_is_edited_selects_the_best_policy_anew(tmp_path, capsys):
    """What was earned before is of another reward; a number is the same however it is written."""
    file = tmp_path / "task.py"
    file.write_text(
        "import torchrl_loco\nclass Paid(torchrl_loco.WalkerStand):\n    options = {'bonus': (0.0, 'For each step.')}\n"
        "    def reward(self, s):\n        return s.qpos[:, 1] + self.bonus\n"
    )
    run = train(f"{file}:Paid", device="cpu", bonus=5, out=tmp_path / "runs", **SMALL)
    capsys.readouterr()
    for bonus, frames, said in ((5.0, 1000, False), (1.0, 2000, True)):
        settings = json.loads((run.path / "config.json").read_text())
        settings["options"]["bonus"] = bonus
        (run.path / "config.json").write_text(json.dumps(settings))
        total = run.load_config().total_frames + frames
        train(f"{file}:Paid", resume=run.path, total_frames=total)
        assert ("was edited since" in capsys.readouterr().err) == said
    assert run.load_policy("cpu").info["selected_by"] < 2000
    file.write_text(file.read_text().replace("s.qpos[:, 1]", "s.qpos[:, 2]"))
    assert cli.main(["eval", str(run.path), "--episodes", "1", "--device", "cpu"]) == 0
    assert "was edited since the training of this policy" in capsys.readouterr().err
