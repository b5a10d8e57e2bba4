"""The settings of a training run: what is valid, and which are used for a task on a device."""

import dataclasses
import json
import math
import re
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal, get_args

from torchrl_loco import tasks
from torchrl_loco.checks import (
    ANY,
    COUNT,
    FRACTION,
    NOT_NEGATIVE,
    POSITIVE_FRACTION,
    SEED,
    Interval,
    check_choice,
    check_device,
    check_fields,
    check_int,
    check_packages,
    checked_size,
    is_run,
    several,
    within,
)
from torchrl_loco.config import PROTOCOLS, SimConfig, arguments_of
from torchrl_loco.registry import ALIASES, is_place, label, resolve, task_name

if TYPE_CHECKING:
    import torch

    from torchrl_loco.envs import LocoEnv

LoggerName = Literal["csv", "tensorboard", "wandb", "mlflow"]
OF_PIXELS = ("camera", "size", "frame_stack", "strides", "random_shift", "critic_from_pixels")
"""Settings that need from_pixels."""


Settings = dict[str, Any]  # fields of a config, by name

_OPTIONAL: Any = [(field.name, field.type | None, None) for field in dataclasses.fields(SimConfig)]  # type: ignore[operator]
_OPTIONAL = [field for field in _OPTIONAL if field[0] != "episode_length"]  # of which a run has a setting of its own
Sim: Any = dataclasses.make_dataclass("Sim", _OPTIONAL, frozen=True)
Sim.__doc__ = "Fields of :class:`torchrl_loco.SimConfig` that a run replaces; ``None`` is as the task says."
AS_THE_TASK = Sim()


def checked_sim(sim: Any) -> Sim:
    """Returns settings of the simulation, or a dict of some of them, as all of them."""
    if isinstance(sim, Sim):
        return sim
    if not isinstance(sim, Mapping):
        raise TypeError(f"sim must be a dict of fields of torchrl_loco.SimConfig, got {sim!r}")
    names = [field.name for field in dataclasses.fields(Sim)]
    return Sim(**{check_choice("field of sim", name, names): value for name, value in sim.items()})


class Options(dict[str, Any]):
    """Values of a task's own options by name, as JSON can hold them. They do not change."""

    def __hash__(self) -> int:  # type: ignore[override]
        return hash(json.dumps(self, sort_keys=True))


@dataclasses.dataclass(frozen=True)
class TrainingConfig:
    """Settings of any training run.

    Numbers must be positive, but for those of which an interval is named.

    A frame is a control step of one world. A step of the policy is an action that is held for ``action_repeat`` frames;
    ``frames_per_batch`` alone counts those, as collectors do.

    Raises:
        TypeError: a field has the wrong type.
        ValueError: a field is out of range, or does not fit another; the message names what is valid.
    """

    algorithm: ClassVar[str]
    presets: ClassVar[dict[str, Settings]] = {"cpu": {}, "cuda": {}}
    """What differs from the defaults, by kind of device."""
    of_others: ClassVar[Settings] = {"action_repeat": 1, "episode_length": 0}
    """What differs for tasks other than those of dm_control's runners, which have episodes of their own."""
    of_pixels: ClassVar[dict[str, Settings]] = {"cpu": {}, "cuda": {}}
    """What differs where the actor sees pixels, by kind of device."""
    widths: ClassVar[tuple[str, ...]] = ("hidden",)
    """Names of the fields that are widths of layers."""
    shows_states: ClassVar[bool] = False
    """Whether the environment in which it trains must show its states."""

    task: str
    """The task, an id or the file or module of a class and its name, with a colon between."""
    protocol: Literal["playground", "dm_control"] = "playground"
    """Settings of the solver and of the reset."""
    device: str = "cpu"
    """Where physics and networks live."""
    seed: int = within(SEED, 0)
    """Decides every random draw of the run."""
    out: Path = Path("runs")
    """Folder in which the run's own folder is made."""

    init: str = ""
    """A policy file, a run folder or the id of a shipped policy, whose weights the networks begin with; else drawn."""
    sim: Sim = AS_THE_TASK
    """Settings of the simulation that replace those of the task, such as ``{"iterations": 20}``."""
    options: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    """Settings of the task's own, such as the motion that it tracks."""
    randomize: bool = True
    """Whether numbers of the model vary as the task says."""
    from_pixels: bool = False
    """Whether the actor sees the pixels of a camera instead of the observation."""
    camera: str = ""
    """Name of the camera; the model's first without one."""
    size: tuple[int, int] = (84, 84)
    """Width and height of the pixels."""
    frame_stack: int = 3
    """How many pictures the actor sees at once."""
    strides: tuple[int, ...] = (2, 1, 1, 1)
    """Strides of the convolutions of the encoder of pixels, one for each; by default DrQ-v2's."""
    random_shift: int = within(COUNT, 0)
    """Pixels by which pictures are moved at random in gradient steps, at most and either way."""
    critic_from_pixels: bool = False
    """Whether the critic sees pixels too, instead of the observation of the task."""

    num_envs: int = 64
    """Worlds stepped together."""
    total_frames: int = 1_228_800
    """Frames to collect, over all worlds, rounded down to whole batches."""
    trials: int = 1
    """Policies that are begun, one after the other. The one with the best evaluation is trained on, the others are
    dropped; their frames count as the run's."""
    trial_fraction: float = within(Interval(0, 1, with_low=False), 0.2)
    """Fraction of total_frames that each trial takes, if there are several."""
    action_repeat: int = 4
    """Frames for which an action is held."""
    episode_length: int = within(COUNT, 400)
    """Frames after which an episode is truncated in training, 0 for the task's own length, which evaluation always
    plays. Shorter episodes practise getting up more often."""
    num_steps: int = 32
    """Steps of the policy in each world between two updates."""

    reward_scale: float = 0.05
    """Factor on the reward before returns are estimated. It keeps values in a range that the critic learns easily."""
    gamma: float = within(POSITIVE_FRACTION, 0.98)
    """Discount of a step."""
    lmbda: float = within(FRACTION, 0.95)
    """Lambda of GAE and TD(lambda)."""
    lr: float = 1e-3
    """Learning rate of Adam at the start; it falls linearly to lr * final_lr_fraction at the end."""
    final_lr_fraction: float = within(FRACTION, 0.0)
    """Learning rate at the end as a fraction of the one at the start."""
    epochs: int = 10
    """Passes over a batch."""
    minibatch_size: int = 512
    """Steps in one gradient step."""
    max_grad_norm: float = 1.0
    """Norm to which gradients are clipped."""
    norm_eps: float = within(NOT_NEGATIVE, 0.0)
    """Standard deviation that every entry of an observation is taken to have besides its own when it is normalised.
    Entries in which there is little but noise stay small."""
    hidden: tuple[int, ...] = (128, 128)
    """Widths of the hidden layers of actor and critic."""
    bf16: bool = False
    """Whether networks compute in bfloat16 on CUDA."""

    eval_interval: int = within(COUNT, 0)
    """Frames between two evaluations during training; 0 evaluates at the end only, and at that of each trial."""
    eval_episodes: int = 32
    """Episodes of an evaluation."""
    video_seconds: float = within(NOT_NEGATIVE, 10.0)
    """Length of the video of the trained policy (s); 0 makes none."""
    checkpoint_seconds: float = within(NOT_NEGATIVE, 60.0)
    """Time between two checkpoints (s)."""
    keep: int = 1
    """How many checkpoints stay. The last one does, and beside it, under the number of its frames, those before it."""
    logger: tuple[LoggerName, ...] = ("tensorboard",)
    """Where metrics go besides the run's CSV files, which are always written; csv adds nothing to them."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "task", _stored_name(self.task))
        check_choice("protocol", self.protocol, PROTOCOLS)
        check_fields(self)
        loggers = (self.logger,) if isinstance(self.logger, str) else tuple(self.logger)
        for name in loggers:
            check_choice("logger", name, get_args(LoggerName))
        object.__setattr__(self, "logger", tuple(dict.fromkeys(loggers)))
        object.__setattr__(self, "device", str(self.device))
        object.__setattr__(self, "out", Path(self.out))
        for field in (*self.widths, "strides"):
            what, value = "stride" if field == "strides" else "width", getattr(self, field)
            if not (sizes := several(value)):
                raise ValueError(f"{field} must name the {what} of at least one layer")
            object.__setattr__(self, field, tuple(check_int(f"each {what} of {field}", each) for each in sizes))
        object.__setattr__(self, "size", checked_size(self.size))
        object.__setattr__(self, "sim", checked_sim(self.sim))
        object.__setattr__(self, "options", Options(self.options))
        object.__setattr__(self, "init", self._path_of_init() if self.init else "")
        if not self.from_pixels:
            if needless := [each for each in OF_PIXELS if getattr(self, each) != getattr(TrainingConfig, each)]:
                raise ValueError(f"{needless[0]} needs from_pixels=True")
        elif self.random_shift >= min(self.size):
            raise ValueError(
                f"random_shift ({self.random_shift}) must be less than width and height of size ({self.size}): "
                "pictures would be moved out of sight"
            )
        # Whether the machine has the device is checked when the run starts.
        if not re.fullmatch(r"cpu|cuda(:\d+)?", self.device):
            raise ValueError(f"no device {self.device!r}: choose one of cpu, cuda, cuda:0, ...")
        if self.minibatch_size > self.frames_per_batch:
            raise ValueError(
                f"minibatch_size ({self.minibatch_size}) must not exceed the batch of num_envs ({self.num_envs}) * "
                f"num_steps ({self.num_steps}) = {self.frames_per_batch}: pass minibatch_size={self.frames_per_batch} "
                f"or less, or num_steps={math.ceil(self.minibatch_size / self.num_envs)} or more"
            )
        if self.trials > 1 and self.trials * self.trial_fraction >= 1.0:
            raise ValueError(
                f"trials ({self.trials}) * trial_fraction ({self.trial_fraction}) must be less than 1, so that frames "
                f"are left for the best of them: pass trial_fraction={0.5 / self.trials:.2g}, for example"
            )
        part, frames = self.shortest_part
        if frames < self.control_steps_per_batch:
            raise ValueError(
                f"{part} ({frames}) must be at least one batch of num_envs * num_steps * action_repeat "
                f"({self.control_steps_per_batch}){', or trials must be 1' if self.trials > 1 else ''}"
            )

    @property
    def label(self) -> str:
        """The name of the task for people and file systems, its id or the name of its class."""
        return label(self.task)

    def _path_of_init(self) -> str:
        path = Path(self.init).expanduser().resolve()
        if path.is_file() or is_run(path):
            return str(path)
        from torchrl_loco.policy import shipped_policies  # which imports the simulation

        return str(shipped_policies(self.protocol).get(ALIASES.get(self.init, self.init), path))

    def to_json(self) -> dict[str, Any]:
        """Returns the settings as values that JSON can hold, from which ``config_from_json`` makes them again."""
        return {"algorithm": self.algorithm, **dataclasses.asdict(self), "out": str(self.out)}

    @property
    def of_env(self) -> dict[str, Any]:
        """Arguments of the environments of the run, beside task, worlds, device, seed and protocol."""
        return arguments_of(dataclasses.asdict(self))

    @property
    def frames_per_batch(self) -> int:
        """Steps of the policy in one batch, over all worlds; frames of a :class:`torchrl_loco.RolloutCollector`."""
        return self.num_envs * self.num_steps

    @property
    def control_steps_per_batch(self) -> int:
        """Control steps in one batch, over all worlds, which is what ``total_frames`` counts."""
        return self.frames_per_batch * self.action_repeat

    @property
    def trial_frames(self) -> int:
        """Frames of each trial, if there are several."""
        return int(self.trial_fraction * self.total_frames)

    @property
    def shortest_part(self) -> tuple[str, int]:
        """The part of a run that must have at least a batch, as an expression, and its frames."""
        if self.trials == 1:
            return "total_frames", self.total_frames
        return "total_frames * trial_fraction", self.trial_frames


@dataclasses.dataclass(frozen=True)
class PPOConfig(TrainingConfig):
    """Settings of proximal policy optimization."""

    algorithm: ClassVar[str] = "ppo"
    presets: ClassVar[dict[str, Settings]] = {
        "cpu": {
            "num_envs": 128,
            "total_frames": 2_000_000,
            "action_repeat": 2,
            "epochs": 6,
            "minibatch_size": 1024,
            "video_seconds": 5.0,
        },
        "cuda": {
            "num_envs": 4096,
            "num_steps": 16,
            "total_frames": 40_000_000,
            "minibatch_size": 8192,
            "epochs": 5,
            "lr": 5e-4,
            "episode_length": 1000,
            "eval_episodes": 128,
        },
    }

    clip_epsilon: float = within(POSITIVE_FRACTION, 0.2)
    """Range of the probability ratio that is not clipped."""
    entropy_coeff: float = within(NOT_NEGATIVE, 1e-3)
    """Weight of the entropy bonus."""
    target_kl: float = within(NOT_NEGATIVE, 0.0)
    """KL divergence of a gradient step's policy from the one that collected (nats), beyond twice of which the learning
    rate falls by a third, and below half of which it rises by half (Rudin et al., 2022), within 1e-5 and 1e-2. 0 lets
    it fall with time."""
    init_std: float = 1.0
    """Standard deviation of an action at the start; before tanh, if actions are bounded."""


@dataclasses.dataclass(frozen=True)
class REPPOConfig(TrainingConfig):
    """Settings of relative entropy pathwise policy optimization."""

    algorithm: ClassVar[str] = "reppo"
    presets: ClassVar[dict[str, Settings]] = {
        "cpu": {
            "action_repeat": 2,
            "episode_length": 1000,
            "reward_scale": 0.5,
            "lr": 3e-4,
            "final_lr_fraction": 1.0,
            "epochs": 4,
            "minibatch_size": 256,
            "max_grad_norm": 0.5,
            "hidden": (256, 256),
            "max_value": 50.0,
        },
        "cuda": {
            "num_envs": 8192,
            "num_steps": 16,
            "total_frames": 100_000_000,
            "action_repeat": 1,
            "episode_length": 1000,
            "reward_scale": 1.0,
            "gamma": 0.99,
            "lr": 6e-4,
            "final_lr_fraction": 0.1,
            "epochs": 4,
            "minibatch_size": 8192,
            "max_grad_norm": 0.5,
            "hidden": (512, 512),
            "eval_interval": 5_000_000,
            "eval_episodes": 128,
        },
    }
    of_others: ClassVar[Settings] = {**TrainingConfig.of_others, "num_bins": 301}
    of_pixels: ClassVar[dict[str, Settings]] = {
        "cpu": {},
        "cuda": {
            "num_envs": 4096,
            "minibatch_size": 4096,
            "lr": 1e-3,
            "trials": 1,
            "bf16": True,
            "eval_episodes": 32,
            "strides": (2, 2, 1, 1),
            "kl_bound": 0.4,
        },
    }

    compile: bool = True
    """Whether torch.compile makes kernels of losses and acting policy on CUDA where there are no others, that is from
    pixels and where Triton does not work. The first start on a machine takes 20 to 40 s longer then."""
    kl_bound: float = 0.1
    """Bound of the KL divergence from the policy that collected the batch, in one state (nats)."""
    init_kl_weight: float = 0.01
    """Weight of the divergence at the start (its Lagrange multiplier, which is learned)."""
    min_kl_weight: float = 1e-9
    """Lower bound of the divergence's weight; the default is as good as none. The weight falls with the slope of the
    value. Once it is very small (below 0.0024 in humanoid_walk), it rises too slowly to hold the policy when the slope
    grows."""
    target_entropy: float = within(ANY, -0.5)
    """Target of the policy's entropy for each entry of an action (nats)."""
    init_temperature: float = 0.01
    """Weight of the entropy at the start (its Lagrange multiplier, which is learned)."""
    min_temperature: float = 3e-4
    """Lower bound of the entropy's weight. A much smaller weight would recover too slowly when the entropy falls."""
    num_bins: int = within(Interval(2, 2**31), 151)
    """Bins of the critic's distribution over returns."""
    min_value: float = within(ANY, 0.0)
    """Return at the center of the first bin. The critic cannot tell lower ones apart; rewards that may be negative need
    one below 0."""
    max_value: float = within(ANY, 150.0)
    """Return at the center of the last bin. Rewards in [0, 1] give returns of up to reward_scale * action_repeat /
    (1 - gamma): the critic cannot tell those above max_value apart."""
    action_bound: float = 4.0
    """Largest absolute value of an action where the task's actions are unbounded."""
    aux_coeff: float = within(NOT_NEGATIVE, 1.0)
    """Weight of the critic's auxiliary loss, the prediction of its own features at the next step."""

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("temperature", "kl_weight"):
            first, least = getattr(self, f"init_{name}"), getattr(self, f"min_{name}")
            if first < least:
                raise ValueError(f"init_{name} ({first}) must not be below min_{name} ({least})")
        if self.min_value >= self.max_value:
            raise ValueError(f"min_value ({self.min_value:g}) must be below max_value ({self.max_value:g})")


@dataclasses.dataclass(frozen=True)
class SVGConfig(TrainingConfig):
    """Settings of stochastic value gradients through a learned model.

    ``epochs`` are rounds after each batch, in which model, actor and critic make a gradient step each;
    ``minibatch_size`` is how many windows and imagined worlds one has.
    """

    algorithm: ClassVar[str] = "svg"
    widths: ClassVar[tuple[str, ...]] = ("hidden", "model_hidden", "critic_hidden")
    shows_states: ClassVar[bool] = True
    presets: ClassVar[dict[str, Settings]] = {
        "cpu": {"num_envs": 128, "num_steps": 16, "epochs": 4, "model_hidden": (256, 256)},
        "cuda": {
            "num_envs": 4096,
            "num_steps": 16,
            "total_frames": 46_000_000,
            "epochs": 14,
            "minibatch_size": 2048,
            "final_lr_fraction": 0.1,
            "average_rate": 0.005,
            "hidden": (1024, 512, 256),
            "bf16": True,
            "eval_episodes": 128,
        },
    }

    action_repeat: int = 1
    """Frames for which an action is held; no more than one."""
    reward_scale: float = 1.0
    """Factor on the reward before returns are estimated."""
    gamma: float = within(POSITIVE_FRACTION, 0.97)
    """Discount of a step."""
    compile: bool = True
    """Whether torch.compile makes kernels of what is imagined on CUDA; the first start on a machine takes a minute
    longer then."""
    horizon: int = within(Interval(2, 2**31), 8)
    """Steps that are imagined in a row, along which the actor's gradient flows."""
    window: int = 8
    """Steps that the model predicts in a row where it is fitted."""
    replay: int = 8
    """Batches that are remembered."""
    warmup: int = within(COUNT, 50)
    """Rounds at the start in which the actor stays, since what model and critic say at first would lead it astray."""
    model_hidden: tuple[int, ...] = (1024, 1024, 1024)
    """Widths of the model's layers."""
    model_lr: float = 1e-3
    """Learning rate of the model at the start; it falls as the other does."""
    critic_hidden: tuple[int, ...] = (512, 512)
    """Widths of the critic's layers."""
    target_rate: float = within(POSITIVE_FRACTION, 0.02)
    """Share by which the critic that returns are made with follows the one that learns, in a round."""
    average_rate: float = within(POSITIVE_FRACTION, 0.01)
    """Share by which the policy that is kept follows the one that learns, in a round."""
    init_std: float = 0.3
    """Standard deviation of an action, which stays; before tanh, if actions are bounded."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.window > self.replay * self.num_steps:
            raise ValueError(
                f"window ({self.window}) must not exceed the replay * num_steps = {self.replay * self.num_steps} steps "
                f"that are remembered: pass replay={math.ceil(self.window / self.num_steps)} or more"
            )
        if self.trials > 1:
            raise ValueError("trials must be 1: svg begins one policy")
        if self.action_repeat > 1:
            raise ValueError("action_repeat must be 1: svg imagines single control steps")


def _stored_name(task: Any) -> str:
    """Returns the name of a task; of one that says where its class is, with the whole path of its file."""
    # The class is looked up where it is needed: settings come from files too, whose curve is plotted without it.
    if not (isinstance(task, str) and is_place(task)):
        return task_name(task)
    source, _, name = task.rpartition(":")
    if not (source and name):
        raise ValueError(f"{task!r} names no class: write path/to/file.py:Class")
    return f"{Path(source).expanduser().resolve()}:{name}" if source.endswith(".py") else task


def check_video(purpose: str = "a video") -> None:
    """Checks that what writes videos is installed."""
    check_packages(purpose, ("imageio", "av"), "train")


def check_packages_of(config: TrainingConfig) -> None:
    """Checks that what writes a training's video and logs is installed: a video is drawn at its end."""
    if config.video_seconds > 0:
        check_video("a video (none with video_seconds=0)")
    for name in config.logger:
        if name != "csv":
            check_packages(f"the logger {name}", [name], "train" if name == "tensorboard" else name)


CONFIGS: dict[str, type[TrainingConfig]] = {config.algorithm: config for config in (PPOConfig, REPPOConfig, SVGConfig)}


def register_config(kind: type[TrainingConfig]) -> None:
    """Lets the settings of a user's algorithm be read by its name; a cell of a notebook may define them again.

    Raises:
        ValueError: the name is that of an algorithm of the package, which has other settings.
    """
    known = CONFIGS.get(kind.algorithm, kind)
    if known is not kind and known.__module__ == TrainingConfig.__module__:
        raise ValueError(
            f"{kind.__name__}.algorithm is {kind.algorithm!r}, which is {known.__name__}'s: give it a name of its own"
        )
    CONFIGS[kind.algorithm] = kind


def config_from_json(values: dict[str, Any]) -> TrainingConfig:
    """Returns the settings that :meth:`TrainingConfig.to_json` has turned into ``values``."""
    algorithm = check_choice("algorithm", values.get("algorithm"), CONFIGS)
    own = {field.name for field in dataclasses.fields(CONFIGS[algorithm])}
    retired = {"compile"} - own  # a setting of earlier revisions
    fields = {name: value for name, value in values.items() if name not in ("algorithm", *retired)}
    return CONFIGS[algorithm](**fields)


RUNNERS = ("walker", "humanoid", "cheetah", "hopper", "quadruped")  # bodies of dm_control's runners


def preset(
    task: "str | type[LocoEnv]",
    device: "torch.device | str | None" = None,
    algorithm: str | None = None,
    **overrides: Any,
) -> TrainingConfig:
    """Returns the settings for ``task`` on ``device``, with ``overrides`` on top.

    They are those of algorithm and device, tuned on the walker and the humanoid, and on CUDA the ``presets`` of the
    task's class on top: ``{"reppo": {"total_frames": 30_000_000}}``.

    Args:
        task: id of the environment, its class, or where that is: ``"path/to/file.py:Class"``.
        device: where to train; ``None`` takes CUDA if there is any.
        algorithm: "ppo", "reppo" or "svg"; ``None`` takes PPO on a CPU, and on CUDA the first of the task's
            ``presets``, REPPO if it has none.
        overrides: fields of the settings, and the task's own :attr:`torchrl_loco.LocoEnv.options`.

    Raises:
        ValueError: there is no such device, algorithm or setting, or one is out of range; the message names what is
            valid. It may be one in the ``presets`` of the class.
    """
    task, device = task_name(task, by_user=True), check_device(device)
    on_cuda = device.type == "cuda"
    own: Mapping[str, Mapping[str, Any]] = {}
    if on_cuda or task not in tasks.found():  # importing one of ours takes seconds
        cls = resolve(task)
        from torchrl_loco.envs.task import check_options  # with torch, as the class is

        check_options(cls)  # before the parser of the command line meets them
        of_training = {field.name for each in CONFIGS.values() for field in dataclasses.fields(each)}
        if taken := sorted({*of_training, "gpus", "seeds"}.intersection(cls.options)):
            raise ValueError(f"{cls.__name__}.options: {taken[0]!r} is a setting of training, too: rename it")
        where = f"in the presets of {cls.__name__}"
        for name, settings in cls.presets.items():
            of = CONFIGS[check_choice(f"algorithm {where}", name, CONFIGS)]
            for setting in settings:
                check_setting(f"setting of {name} {where}", setting, of)
        own = cls.presets if on_cuda else {}
    if algorithm is None:
        algorithm = next(iter(own), "reppo") if on_cuda else "ppo"
    kind = CONFIGS[check_choice("algorithm", algorithm, CONFIGS)]
    fields = {field.name for field in dataclasses.fields(kind)}
    if not overrides.keys() <= fields:  # only then, since importing a task takes a while
        options = {name: overrides.pop(name) for name in resolve(task).options if name in overrides}
        overrides["options"] = {**overrides.get("options", {}), **options}
    for name in overrides:
        check_setting("setting", name, kind)
    if overrides.get("options"):
        overrides["options"] = resolve(task).checked_options(overrides["options"])
    settings = {**kind.presets[device.type], **({} if is_runner(task) else kind.of_others), **own.get(algorithm, {})}
    settings |= kind.of_pixels[device.type] if (settings | overrides).get("from_pixels") else {}
    if not is_runner(task) and kind is REPPOConfig:  # returns of either sign
        settings.setdefault("min_value", -settings.get("max_value", REPPOConfig.max_value))
    return kind(task, **{"device": str(device), **settings, **overrides})


def check_setting(what: str, name: str, kind: type[TrainingConfig]) -> None:
    """Checks that a name is that of a setting; the error names the settings."""
    check_choice(what, name, [field.name for field in dataclasses.fields(kind) if field.name != "task"])


def is_runner(task: "str | type[LocoEnv]") -> bool:
    """Returns whether a task is one of dm_control's runners: their rewards lie in [0, 1], and they cannot fall."""
    name = task_name(task)
    return name in tasks.found() and tasks.found()[name].module.rpartition(".")[2] in RUNNERS


def tuning_note(config: TrainingConfig) -> str:
    """Returns a note if ``config.task`` was not tuned on the CPU by its algorithm, else an empty string."""
    tuned = config.algorithm == "ppo" and config.task in ("walker_stand", "walker_walk") and not config.from_pixels
    if config.device != "cpu" or tuned:
        return ""
    if config.from_pixels:
        return "On a CPU training from pixels was not tuned, and sees some hundred frames a second: it needs a GPU."
    return "On a CPU only walker_stand and walker_walk by ppo were tuned: other tasks need a GPU, or many more frames."
