"""Stochastic value gradients: the model, what is remembered, returns, Muon, and that it learns."""

import copy
import functools
import signal

import mujoco
import pytest
import torch
from for_each import for_each
from tensordict import TensorDict
from torchrl.objectives.value.functional import td_lambda_return_estimate

import torchrl_loco as loco
from torchrl_loco import training
from torchrl_loco.envs.imagined import STATE
from torchrl_loco.training.actor import deterministic_policy
from torchrl_loco.training.algorithm import begin_from
from torchrl_loco.training.config import preset
from torchrl_loco.training.dynamics import Dynamics, unpredictable
from torchrl_loco.training.muon import Muon, orthogonal
from torchrl_loco.training.replay import Replay
from torchrl_loco.training.run_folder import RunFolder
from torchrl_loco.training.svg import SVG, lambda_returns
from torchrl_loco.training.trainer import Trainer

MODEL = """
<mujoco>
  <option gravity="0 0 0" timestep="0.005"/>
  <worldbody>
    <body name="base" pos="0 0 1">
      <freejoint/><geom type="box" size="0.2 0.2 0.1" mass="10"/>
      <body name="wheel" pos="0 0 0.2">
        <joint name="axle" axis="0 0 1" damping="0.2"/><geom type="box" size="0.2 0.05 0.05" mass="1"/>
      </body>
    </body>
  </worldbody>
  <actuator><motor name="engine" joint="axle" gear="2" ctrlrange="-1 1"/></actuator>
</mujoco>
"""


class Spin(loco.LocoEnv):
    """A wheel on a floating box is to turn at 3 rad/s."""

    body = "spin"
    model = MODEL
    config = loco.SimConfig(ctrl_dt=0.02, sim_dt=0.005, episode_length=100, euler_damping=True)
    memory = {"last_action": 1}

    def reward(self, s):
        return 1.0 / (1.0 + (s.joint_qvel("axle") - 3.0).square())

    def events(self, s):
        return {"last_action": s.action}

    def observation(self, s):
        return {"observation": {"rates": s.qvel, "last_action": s.last_action}}


PLAIN = {"engine": "mujoco", "compile_hooks": False}
"""What makes worlds that are hardly stepped: nothing is compiled."""
FEW = {
    **{"num_envs": 32, "num_steps": 8, "minibatch_size": 64, "epochs": 4, "horizon": 8, "window": 12, "warmup": 20},
    **{"hidden": (32,), "model_hidden": (32,), "critic_hidden": (32,), "average_rate": 0.1},
    **{"lr": 3e-3, "model_lr": 1e-2, "eval_episodes": 4, "video_seconds": 0},
}


def test_the_model_can_say_any_step_exactly():
    env = loco.make("g1_velocity", num_envs=1, seed=2, **PLAIN)
    env.rollout(5)
    before = env.sim.qpos.clone(), env.sim.qvel.clone()
    action = torch.randn(1, env.mj_model.nu)
    env.step(TensorDict({"action": action}, 1))
    after = torch.cat([env.sim.qpos, env.sim.qvel], dim=-1)
    model = Dynamics(env.mj_model, env.config.ctrl_dt, env.config.substeps, (8,))
    model.learn_moments(*before, action, after)
    with torch.no_grad():  # the means of one step are what the network must give
        model.net[-1].bias.copy_(model.outputs.mean / 10.0)
        model.outputs.mean.zero_(), model.outputs.var.fill_(100.0)
        torch.testing.assert_close(torch.cat(model(*before, action), dim=-1), after, rtol=1e-4, atol=1e-5)
        assert model.errors(*model(*before, action), after) < 1e-6
        assert model.errors(*before, after) > 1e-3


@for_each(
    ("world", "why"),
    [
        ("<geom type='plane' size='1 1 1' euler='0 0 30'/>", ""),
        ("<body euler='0 90 0'><geom type='plane' size='1 1 1' euler='0 -90 0'/></body>", ""),
        ("<geom type='box' size='1 1 1' pos='0 0 -2' contype='0' conaffinity='0'/>", ""),
        ("<geom type='box' size='1 1 1' pos='0 0 -2'/>", "level plane"),
        ("<body><geom type='box' size='1 1 1' pos='0 0 -2'/></body>", "level plane"),
        ("<body euler='20 0 0'><geom type='plane' size='1 1 1'/></body>", "level plane"),
        ("<body mocap='true'><geom type='plane' size='1 1 1'/></body>", "mocap"),
    ],
)
def test_robots_on_level_ground_have_a_model(world, why):
    m = mujoco.MjModel.from_xml_string(MODEL.replace("<worldbody>", f"<worldbody>{world}"))
    assert why in unpredictable(m) if why else not unpredictable(m)


def test_only_robots_that_float_have_a_model():
    with pytest.raises(ValueError, match="base must float"):
        Dynamics(loco.make("walker_walk", num_envs=1, **PLAIN).mj_model, 0.02, 4, (8,))


def counted(first, end=(), leap=(), lost=()):
    """Returns a batch of 3 worlds and 4 steps, of a robot with nq = 8, nv = 7 and nu = 1.

    Each number is that of its step; what physics made of step k is k + 0.25, events added 0.5 to velocities, and the
    control was -k.
    """
    steps = torch.arange(first, first + 4.0).expand(3, 4).unsqueeze(-1)
    before = steps.expand(3, 4, 16)
    found = torch.cat([(steps + 0.25).expand(3, 4, 15), -steps], dim=-1)
    later = torch.cat([(steps + 0.25).expand(3, 4, 8), (steps + 0.75).expand(3, 4, 7), steps, found], dim=-1)
    later[:, list(leap), :8] += 1.0
    later[:, list(lost)] = 0.0
    ends = torch.zeros(3, 4, 1, dtype=torch.bool)
    ends[:, list(end)] = True
    shown = {STATE: torch.cat([before, found], dim=-1), "observation": steps}
    return TensorDict({**shown, "next": {STATE: later, "done": ends}}, (3, 4))


def remembered(**batches):
    """Returns what remembers two batches of three, from step 0, 4 and 8 on, and draws windows of 5 steps."""
    m = loco.make(Spin, num_envs=1, **PLAIN).mj_model
    config = preset("g1_tracking", "cpu", "svg", num_envs=3, num_steps=4, minibatch_size=12, window=5, replay=2)
    replay = Replay(config, m, {"state": 16, "observation": 1}, torch.Generator().manual_seed(0))
    replay.keep(counted(0))
    assert not replay.has_window
    for first in (4, 8):
        steps = replay.keep(counted(first, **batches if first == 8 else {}))
    return replay, steps


@for_each(("what", "behind"), [("end", 9), ("leap", 9), ("lost", 8)])
def test_windows_go_across_batches_and_no_further_than_episodes(what, behind):
    """Of the steps from 8 on, the second ends episodes, makes a robot leap, or was not finite."""
    replay, (qpos, qvel, ctrl, after) = remembered(**{what: [1]})
    assert (qpos[::4] == 8.0).all()
    assert (qvel[::4] == 8.0).all()
    assert (ctrl[::4] == -8.0).all()
    nobody_moves = what == "lost"
    assert (after[1::4, :8] == (9.0 if nobody_moves else 9.25)).all()
    assert (after[1::4, 8:] == (0.0 if nobody_moves else 9.25)).all()
    assert (qvel[1::4] == (0.0 if nobody_moves else 9.0)).all()
    seen = set()
    for _ in range(20):
        replay.draw_window()
        state, ctrl, after, event, valid = replay.window
        times = state[:, 0] + torch.arange(5.0).unsqueeze(1)
        assert (state == state[:, :1]).all()
        sound = torch.ones_like(times) > 0 if what != "lost" else times != 9
        assert (ctrl[..., 0] == -times)[sound].all()
        assert (after == times.unsqueeze(-1) + 0.25)[sound].all()
        assert (event == 0.5)[sound].all()
        assert (valid == ((state[:, 0] > 9) | (times <= behind)).float()).all()
        replay.draw_starts()
        assert (replay.starts[0] == replay.starts[1]).all()
        seen |= {*state[:, 0].tolist()} | {100 + each for each in replay.starts[1][:, 0].tolist()}
    assert seen == {4.0, 5.0, 6.0, 7.0} | {100.0 + step for step in range(4, 12)}


@pytest.fixture(scope="module")
def made_once(tmp_path_factory):
    """Returns a function that makes a trainer of svg, which has learned from a few batches, where first needed."""

    @functools.cache
    def get():
        settings = {**FEW, "total_frames": 10_000, "warmup": 0, "horizon": 5, "target_rate": 0.5, "average_rate": 0.25}
        config = preset("g1_tracking", "cpu", "svg", out=tmp_path_factory.mktemp("svg"), **settings)
        trainer = Trainer(RunFolder.create(config))
        for _ in range(3):
            trainer.iterate()
        return trainer

    return get


@pytest.fixture
def svg(made_once):
    """It can be asked for more, and gets its networks back after each test."""
    svg = made_once().algorithm
    kept = copy.deepcopy(svg.networks.state_dict())
    yield svg
    svg.load_networks(kept)


def test_the_actor_ascends_the_gradient_of_the_imagined_return(svg):
    parameters = list(svg._mean.parameters())

    def imagined_return():
        torch.manual_seed(1)
        rewards, ended, cut, seen = svg._imagine()
        values = svg._target_value(seen.flatten(0, 1)).view_as(rewards)
        assert ended.any()
        assert not ended.all()
        return lambda_returns(rewards, values, ended, cut, svg.config.gamma, svg.config.lmbda)[0].double().mean()

    slopes = torch.autograd.grad(imagined_return(), parameters)
    torch.manual_seed(5)
    for _ in range(3):
        directions = [torch.randn_like(each) for each in parameters]
        slope = sum((one * other).sum() for one, other in zip(slopes, directions, strict=True)).double()
        reached = []
        for by in (1e-3, -2e-3, 1e-3):
            with torch.no_grad():
                for parameter, direction in zip(parameters, directions, strict=True):
                    parameter.add_(by * direction)
                reached.append(imagined_return())
        torch.testing.assert_close(slope, (reached[0] - reached[1]) / 2e-3, rtol=5e-2, atol=2e-3)


def test_actor_and_critic_learn_from_returns_up_to_the_end_of_episodes(svg, monkeypatch):
    """Of two worlds one ends after its second step: what comes then counts for nobody."""
    seen = torch.randn(4, 2, svg.spaces.critic)
    rewards, none = torch.tensor([[1.0, 2.0], [3.0, 4.0], [5.0, 1e6], [6.0, 1e6]]), torch.zeros(4, 2, dtype=torch.bool)
    ended = none.clone()
    ended[1, 1] = True
    of_actor = sum(each.sum() for each in svg._mean.parameters())
    monkeypatch.setattr(svg, "_imagine", lambda: (rewards + 0.0 * of_actor, ended, none, seen))
    values = svg._target_value(seen.flatten(0, 1)).view(4, 2)
    returns = lambda_returns(rewards, values, ended, none, svg.config.gamma, svg.config.lmbda)
    of_critic = svg.critic(seen[:-1].flatten(0, 1)).view(3, 2)
    counted = torch.tensor([[1.0, 1.0], [1.0, 0.0], [1.0, 0.0]])
    expected = ((of_critic - returns[1:]).square() * counted).sum() / 4.0
    before = [each.clone() for each in svg._target.parameters()]
    svg._totals.zero_()
    svg.value(*svg.improve())
    svg.follow()
    metrics = dict(zip(svg.metric_names, svg._totals.tolist(), strict=True))
    assert metrics["imagined_return"] == pytest.approx(returns[0].mean().item(), rel=1e-5)
    assert metrics["imagined_length"] == pytest.approx(3.0)  # of 4 and 2 steps
    assert metrics["loss_critic"] == pytest.approx(expected.item(), rel=1e-4)
    for old, now, critic in zip(before, svg._target.parameters(), svg.critic[1].parameters(), strict=True):
        torch.testing.assert_close(now, 0.5 * (old + critic))


def test_a_window_goes_on_with_what_events_changed(svg):
    """The error is that of the prediction itself."""
    first, controls, afters, _, _ = svg._replay.window
    qpos, qvel, _ = svg._imagined.unpacked(first)
    event = torch.randn_like(qvel)
    calm, pushed = (svg._moved(qpos, qvel, controls[0], afters[0], by) for by in (torch.zeros_like(event), event))
    for one, other in zip(pushed, (calm[0], calm[1] + event, calm[2]), strict=True):
        torch.testing.assert_close(one, other)


def test_gradients_that_are_not_finite_are_left_out_and_said(svg):
    before = [each.clone() for each in svg._mean.parameters()]
    whole = sum(each.sum() for each in svg._mean.parameters())
    assert svg._descend(svg._actor_optimizers, whole * float("nan")) == (0.0, True)
    assert all(each.isfinite().all() for each in svg._mean.parameters()), before
    assert svg._descend(svg._actor_optimizers, whole)[1] == False  # noqa: E712, a tensor
    none = {"lost_of_model": [0.0], "lost_of_actor": [0.0], "lost_of_critic": [0.0]}
    assert "left out, 50% of the actor's" in svg.note({**none, "lost_of_actor": [0.0, 0.5]})
    assert not svg.note(none)


def test_a_policy_begins_all_actors(svg, tmp_path):
    policy = deterministic_policy(svg.actor, svg.config, {})
    policy.save(tmp_path / "policy.safetensors")
    average = [each.clone() for each in svg._average.parameters()]
    with torch.no_grad():
        for mine in (svg._mean, svg._average, svg._shown):
            for own in mine.parameters():
                own.normal_()
    begin_from(svg, tmp_path / "policy.safetensors", "cpu", {})
    for mine in (svg._mean, svg._average, svg._shown):
        for own, kept in zip(mine.parameters(), average, strict=True):
            torch.testing.assert_close(own.detach(), kept)


def test_returns_are_those_of_torchrl():
    torch.manual_seed(0)
    rewards, values, draws = torch.randn(9, 50), torch.randn(9, 50), torch.rand(9, 50)
    ended, cut = draws < 0.1, (draws > 0.05) & (draws < 0.2)  # some both
    found = lambda_returns(rewards, values, ended, cut, 0.9, 0.8)
    by_world = (each.T.unsqueeze(-1) for each in (values, rewards, ended | cut, ended))
    expected = td_lambda_return_estimate(0.9, 0.8, *by_world)
    torch.testing.assert_close(found, expected.squeeze(-1).T)


@for_each("shape", [(20, 50), (50, 20)])
def test_muon_steps_along_all_directions(shape):
    torch.manual_seed(0)
    gradient = torch.randn(shape) @ torch.diag(torch.logspace(-0.5, 0.5, shape[1]))
    values = torch.linalg.svdvals(orthogonal(gradient))
    assert values.min() > 0.3
    assert values.max() < 1.3
    matrix, lr = torch.nn.Parameter(torch.zeros(shape)), torch.tensor(1.0)
    optimizer = Muon([matrix], lr)
    for rate in (1e-2, 1e-3):
        lr.fill_(rate)
        before, matrix.grad = matrix.detach().clone(), gradient
        optimizer.step()
        moved = before - matrix.detach()
        assert (moved * gradient).sum() > 0.0
        assert 0.1 * rate < moved.square().mean().sqrt() < 0.25 * rate


def test_hooks_are_called_in_single_precision(svg, monkeypatch):
    rows, observation = svg._replay.starts
    qpos, qvel, rest = svg._imagined.unpacked(rows)
    found = []
    monkeypatch.setattr(svg._imagined, "control", lambda q, v, action, _: found.append(action.T @ action) or action)
    with torch.autocast("cpu", torch.bfloat16):
        svg._dreamt(observation, qpos, qvel, svg._noise[0], *rest)
    assert found[0].dtype == torch.float32


def test_a_matrix_that_layers_share_is_stepped_once(svg, monkeypatch):
    monkeypatch.setattr(svg, "optimizers", {})
    layers = [torch.nn.Linear(4, 4) for _ in range(4)]
    layers[1].weight, layers[2].weight = layers[0].weight, layers[3].weight
    _, muon = svg._optimizers_of("shared", torch.nn.Sequential(*layers))
    assert [id(each) for each in muon.param_groups[0]["params"]] == [id(layers[0].weight)]


def learned(run):
    returns = [float(row["mean"]) for row in run.read_evaluations()]
    assert returns[0] < 40.0 < 70.0 < returns[-1]  # of 100


def test_the_policy_of_before_an_update_collects(svg, made_once):
    assert made_once().collector._policy is svg.acting()
    before = [each.clone() for each in svg._mean.parameters()]
    made_once().iterate()
    assert any((old != now).any() for old, now in zip(before, svg._mean.parameters(), strict=True))
    kept = [each.data_ptr() for each in svg.networks.state_dict().values()]  # by a checkpoint
    for old, collects in zip(before, svg._shown.parameters(), strict=True):
        torch.testing.assert_close(collects, old)
        assert collects.data_ptr() in kept


@pytest.mark.ci
def test_it_learns_in_a_minute_of_experience(tmp_path):
    few = {"total_frames": 32 * 8 * 25, "eval_interval": 32 * 8 * 5}
    run = training.train(Spin, algorithm="svg", device="cpu", out=tmp_path, **FEW, **few)
    learned(run)


@pytest.mark.gpu
def test_it_learns_on_cuda(tmp_path):
    few = {"total_frames": 32 * 8 * 25, "eval_interval": 32 * 8 * 5, "compile": False}
    learned(training.train(Spin, algorithm="svg", device="cuda", out=tmp_path, **FEW, **few))


def stopped_and_resumed(tmp_path, device, at=9, batches=26, **settings):
    """Returns the metrics of a run that Ctrl-C has stopped in the middle of an episode."""

    def update(self, batch, progress):
        if interrupts and len(interrupts) > at:
            interrupts.clear()
            signal.raise_signal(signal.SIGINT)
        elif interrupts:
            interrupts.append(progress)
        return plain(self, batch, progress)

    plain, interrupts = SVG.update, [0.0]
    settings = {**FEW, "epochs": 1, "total_frames": 32 * 8 * batches, "device": device, **settings}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(SVG, "update", update)
        with pytest.raises(KeyboardInterrupt):
            training.train(Spin, algorithm="svg", out=tmp_path, **settings)
    (run,) = tmp_path.iterdir()
    training.train(Spin, resume=run)
    return RunFolder(run).read_metrics()


def lengths(rows):
    """Returns those of the episodes that have ended."""
    return {length for length, count in zip(rows["episode_length"], rows["episodes"], strict=True) if count}


@pytest.mark.slow
def test_a_run_goes_on_without_what_it_remembered(tmp_path, capsys, monkeypatch):
    def ahead(self):  # as on CUDA
        return self._collect() if self.last_frame - self.frames > self.frames_per_iteration else None

    monkeypatch.setattr(Trainer, "_collected_ahead", ahead)
    rows = stopped_and_resumed(tmp_path, "cpu")
    assert "remembers steps anew" in capsys.readouterr().err
    assert rows["frames"][-1] == 32 * 8 * 26
    assert rows["loss_model"][-1] > 0.0
    assert lengths(rows) == {100.0}


@pytest.mark.gpu
def test_batches_are_collected_while_it_learns(tmp_path, monkeypatch):
    ahead, plain = [], Trainer._collected_ahead

    def noted(self):
        collected = plain(self)
        ahead.append(collected is not None)
        return collected

    monkeypatch.setattr(Trainer, "_collected_ahead", noted)
    rows = stopped_and_resumed(tmp_path, "cuda", compile=False)
    assert sum(ahead) > 15
    assert lengths(rows) == {100.0}


@for_each(
    ("settings", "why"),
    [
        ({"window": 200}, "pass replay="),
        ({"trials": 2}, "trials must be 1"),
        ({"action_repeat": 2}, "action_repeat must be 1"),
        ({"model_hidden": (0,)}, "model_hidden"),
        ({"critic_hidden": ()}, "critic_hidden must name"),
        ({"horizon": 1}, "horizon"),
        ({"target_rate": 0.0}, "target_rate"),
    ],
)
def test_settings_that_do_not_fit_are_refused(settings, why):
    with pytest.raises(ValueError, match=why):
        preset("g1_tracking", "cpu", "svg", **settings)


def test_environments_that_hide_their_states_are_refused(tmp_path):
    with pytest.raises(ValueError, match="id or class"):
        training.train(
            loco.make(Spin, num_envs=32),
            algorithm="svg",
            out=tmp_path,
            **{k: v for k, v in FEW.items() if k != "num_envs"},
        )
