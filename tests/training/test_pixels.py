"""Training from pixels: the encoder, actors that see, and critics that see or read states."""

import itertools

import pytest
import torch
from for_each import for_each
from torch.nn.functional import pad
from torchrl.envs import ExcludeTransform, ToTensorImage

import torchrl_loco as loco
from torchrl_loco import training
from torchrl_loco.encoder import PixelEncoder, shifted
from torchrl_loco.export import export_policy
from torchrl_loco.training import preset
from torchrl_loco.training.environments import make_for
from torchrl_loco.training.run_folder import RunFolder
from torchrl_loco.training.trainer import Trainer

SMALL = {"num_envs": 4, "num_steps": 4, "minibatch_size": 8, "total_frames": 64, "action_repeat": 1, "hidden": (16,)}
SMALL |= {"video_seconds": 0, "eval_episodes": 2, "logger": "csv", "size": (28, 24), "camera": "back", "epochs": 2}


def test_the_encoder_sees_what_differs_from_the_mean_picture():
    torch.manual_seed(0)
    encoder = PixelEncoder((20, 24, 6))
    pictures = torch.randint(0, 256, (5, 3, 20, 24, 6), dtype=torch.uint8)
    encoder.merge(10, pictures[:2].float().mean((0, 1)))
    encoder.merge(5, pictures[2].float().mean(0))
    torch.testing.assert_close(
        encoder.mean, (pictures[:2].float().sum((0, 1)) * 10 / 6 + pictures[2].sum(0) * 5 / 3) / 15
    )
    features = encoder(pictures)
    assert features.shape == (5, 3, 50)
    rows = (pictures.flatten(0, 1).float() - encoder.mean).movedim(-1, 1) / 255
    plain = encoder.head(encoder.others(encoder.first(rows)).flatten(1)).view(5, 3, 50)
    torch.testing.assert_close(features, plain, rtol=1e-4, atol=1e-5)
    coarse = PixelEncoder((20, 24, 6), strides=(3, 2))
    assert coarse.head[0].in_features == 32 * 2 * 3
    assert coarse(pictures).shape == (5, 3, 50)
    for strides, least in (((2, 1, 1, 1), 15), ((2, 2, 1, 1), 23), ((3, 2), 9)):
        PixelEncoder((least, 24, 3), strides=strides)
        with pytest.raises(ValueError, match=f"at least {least} x {least}, got 24 x {least - 1}"):
            PixelEncoder((least - 1, 24, 3), strides=strides)
    for wrong in (pictures.view(15, 10, 48, 6), pictures[..., :3], pictures.float()):
        with pytest.raises(ValueError, match=r"uint8 pixels of shape \(20, 24, 6\), got"):
            encoder(wrong)


def test_shifted_pictures_repeat_their_edges():
    pictures = torch.randint(0, 256, (6, 9, 11, 2), dtype=torch.uint8)
    torch.manual_seed(1)
    moved = shifted(pictures, 2)
    wide = pad(pictures.movedim(-1, 1).float(), (2, 2, 2, 2), mode="replicate").movedim(1, -1).byte()
    crops = {(i, j): wide[:, i : i + 9, j : j + 11] for i in range(5) for j in range(5)}
    found = [next(at for at, crop in crops.items() if torch.equal(crop[k], moved[k])) for k in range(6)]
    assert len(set(found)) > 2


@pytest.mark.slow
@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda", marks=pytest.mark.gpu)])
@for_each("algorithm, critic_sees", list(itertools.product(("ppo", "reppo"), (False, True))))
def test_actors_that_see(algorithm, critic_sees, device, tmp_path):
    """They learn, the run is resumed exactly, and its policy acts and is exported as the actor."""
    settings = {**SMALL, "from_pixels": True, "critic_from_pixels": critic_sees, "random_shift": 2}
    settings["strides"] = (2, 2, 1) if critic_sees else (2, 1, 1, 1)
    settings |= {"compile": False} if algorithm == "reppo" else {}
    out = tmp_path / f"{algorithm}-{critic_sees}"
    run = RunFolder.create(preset("walker_walk", device, algorithm, out=out, **settings))
    first = Trainer(run)
    before = {name: value.clone() for name, value in first.algorithm.networks.state_dict().items()}
    first.iterate()
    after = first.algorithm.networks.state_dict()
    changed = {name for name in before if not torch.equal(before[name], after[name])}
    assert sum("first.weight" in name for name in changed) == 1 + critic_sees  # a first convolution each
    means = [value for name, value in after.items() if name.endswith("0.mean") and value.ndim == 3]
    assert all((mean != 127.5).any() for mean in means)
    first.save()
    first.iterate()
    again = Trainer(run, resume=True)
    again.iterate()
    close = {"rtol": 0, "atol": 0} if device == "cpu" else {"rtol": 0.05, "atol": 2e-3}  # cuDNN adds in any order
    torch.testing.assert_close(first.algorithm.networks.state_dict(), again.algorithm.networks.state_dict(), **close)
    again.train()
    for init in (run.path, run.policy):
        other = preset("walker_walk", device, algorithm, out=out, **settings | {"strides": (1, 2, 2), "init": init})
        with pytest.raises(ValueError, match=rf"strides \({settings['strides'][0]}, .*\), here \(1, 2, 2\)"):
            Trainer(RunFolder.create(other))
    policy = run.load_policy()
    assert policy.in_keys == ["pixels"]
    td = make_for(policy, 3, device, 0).rollout(3, policy)
    assert td["pixels"].shape == (3, 3, 24, 28, 9)
    assert td["action"].abs().max() <= 1.0
    assert export_policy(policy, out / "policy.pt2") < 1e-5


def test_an_environment_that_sees_is_trained_in(tmp_path, caplog):
    """With its own camera and size; without states for the critic, that sees too. Depth is for transforms to read."""
    options = {"from_pixels": True, "size": (20, 16), "frame_stack": 2}
    env = loco.make("walker_walk", 4, "cpu", 0, camera="back", depth=3.0, **options)
    few = {name: value for name, value in SMALL.items() if name not in ("size", "camera", "num_envs")}
    run = training.train(env, algorithm="reppo", out=tmp_path, **few)
    config = run.load_config()
    assert (config.from_pixels, config.camera, config.size, config.frame_stack) == (True, "back", (20, 16), 2)
    assert config.critic_from_pixels
    assert run.load_policy().module[0].shape == (16, 20, 6)
    assert "networks do not read depth: join them to 'observation'" in caplog.text
    other = loco.make("walker_walk", 4, "cpu", 0, camera="side", **options)
    with pytest.raises(ValueError, match="was begun with camera='back', the environment has 'side'"):
        training.train(other, resume=run, total_frames=128)
    blind = loco.TransformedEnv(
        loco.make("walker_walk", 4, "cpu", 0, from_pixels=True, pixels_only=False), ExcludeTransform("pixels")
    )
    for name in ("from_pixels", "critic_from_pixels", "random_shift"):
        with pytest.raises(ValueError, match=f"{name} needs an environment that returns 'pixels': .* leave transforms"):
            training.train(blind, algorithm="reppo", out=tmp_path, **few, **{name: True})
    run = training.train(blind, algorithm="reppo", out=tmp_path, **few)
    assert not run.load_config().from_pixels
    with pytest.raises(ValueError, match=r"uint8 of shape .* frame_stack .* leave transforms of pixels out"):
        training.train(loco.TransformedEnv(env, ToTensorImage()), algorithm="reppo", out=tmp_path, **few)
