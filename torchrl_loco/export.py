"""Policies for programs without this package: as ONNX, or as a program of torch.export."""

import copy
import io
import json
import logging
import math
import warnings
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import torch
from torch import nn

import torchrl_loco
from torchrl_loco import storage
from torchrl_loco.checks import check_output_file, check_packages
from torchrl_loco.config import SimConfig, arguments_of, sim_config, sim_of
from torchrl_loco.envs.hooks import own_hooks
from torchrl_loco.envs.task import definer, folder_of
from torchrl_loco.policy import Policy, check_terms, difference, random_observations
from torchrl_loco.registry import resolve
from torchrl_loco.sim import models
from torchrl_loco.sim.corners import stand_on_corners
from torchrl_loco.sim.simulation import integrator

SUFFIXES = {"onnx": ".onnx", "torch": ".pt2"}  # formats and the suffixes of their files

TOLERANCE = 1e-5
"""Largest difference from the policy's own actions, a fraction of those above 1, that an exported policy may have."""

BATCH_SIZES = (1, 2, 1000)  # batches of random observations on which they are compared


def export_policy(policy: Policy, path: Path) -> float:
    """Writes a policy, with its normalisation of observations, as a file that needs none of this package.

    What is written takes ``observation``, float32 of shape ``(batch, n)`` for any batch, and gives ``action``, float32
    of shape ``(batch, m)``, in [-1, 1] unless the task's actions are unbounded. Of a policy that sees, ``observation``
    is pixels, uint8 of shape ``(batch, height, width, channels)``. Before the file is written, it is compared with the
    policy, on the CPU and on random observations that reach beyond those of the training. Information travels with it:
    task, protocol, sizes, bounds of an action, the time between two control steps (s), for how many of them an action
    is held, and all of ``policy.info``; as ``metadata_props`` in ONNX, in the extra file ``metadata.json`` with
    torch.export. So do the terms of the observation where it has names, how actions become controls, and what is known
    of the robot: :func:`torchrl_loco.export.of_robot`.

    Of a task that follows a reference the file takes ``time_step`` too, int64 ``(batch,)``, a frame of it, and gives
    rows of the tables of :meth:`torchrl_loco.LocoEnv.reference` beside the action.

    Args:
        policy: the policy, on any device.
        path: a new file; ``.onnx`` or ``.pt2`` chooses the format.

    Returns:
        The largest difference of an entry of an action from the policy's own, as a fraction of those above 1.

    Raises:
        ValueError: the file exists, its folder does not, its suffix is none of the valid ones, or the policy does not
            fit its task.
        TypeError: the policy does not begin by normalising observations.
        ImportError: a package of the extra "onnx" is missing; the message says how to install it.
        RuntimeError: that is more than 1e-5, and than twice the policy's own rounding in float32; nothing is written.
    """
    path = check_output_file("path", path, tuple(SUFFIXES.values()))
    if path.suffix == ".onnx":
        check_packages("exporting as ONNX", ("onnx", "onnxscript", "onnxruntime"), "onnx")
    of_task, reference = of_robot(policy)
    original = _Network(policy, reference)
    observations = random_observations(original.layers, max(BATCH_SIZES), 4.0)  # some are clipped
    expected = original.layers(observations)
    info = policy.info
    facts = {
        "task": info["task"],
        "protocol": info["protocol"],
        "observation_size": math.prod(observations.shape[1:]),
        **({"observation_shape": list(observations.shape[1:])} if observations.ndim > 2 else {}),
        "action_size": expected.shape[-1],
        "action_low": -1.0 if policy.is_bounded else None,
        "action_high": 1.0 if policy.is_bounded else None,
        "control_timestep": info.get("control_timestep") or _control_timestep(info),
        "action_repeat": info["action_repeat"],
        "torchrl_loco": torchrl_loco.__version__,
        "info": info,
        **of_task,
    }
    content, play = (_as_onnx if path.suffix == ".onnx" else _as_program)(original, observations[:2], facts)
    error = max(difference(play(observations[:size]), expected[:size]) for size in BATCH_SIZES)
    if not error <= TOLERANCE:  # true for NaN too
        rounding = difference(copy.deepcopy(original.layers).double()(observations.double()), expected)
        if not error <= (allowed := max(TOLERANCE, 2.0 * rounding)):
            raise RuntimeError(
                f"the exported policy differs by {error:.1e} from the original, whose own rounding in float32 is "
                f"{rounding:.1e}; more than {allowed:.0e} is refused, and nothing was written"
            )
    storage.replace_file(path, content)
    return error


class _Network(nn.Module):
    """The network of a policy on the CPU, and the reference that it follows, tables ``(frames, ...)`` by name, if any.

    Its arguments have the names that exported policies have for them.
    """

    def __init__(self, policy: Policy, reference: Mapping[str, torch.Tensor]) -> None:
        super().__init__()
        self.layers, self.names = copy.deepcopy(policy.module).cpu().requires_grad_(False).eval(), tuple(reference)
        for name, table in reference.items():
            self.register_buffer(name, table)

    def forward(self, observation: torch.Tensor, time_step: torch.Tensor | None = None) -> Any:
        """Returns the actions ``(batch, m)`` for observations ``(batch, n)``.

        With ``time_step``, int64 ``(batch,)``, a tuple of them and of these rows of each table, within the table.
        """
        actions = self.layers(observation)
        if time_step is None:
            return actions
        frame = time_step.clamp(0, len(getattr(self, self.names[0])) - 1)
        return actions, *(getattr(self, name)[frame] for name in self.names)


def _inputs(network: _Network, observations: torch.Tensor) -> dict[str, torch.Tensor]:
    """Returns the inputs of a network by name; of a reference the first frame."""
    of_reference = {"time_step": torch.zeros(len(observations), dtype=torch.int64)} if network.names else {}
    return {"observation": observations, **of_reference}


Exported = tuple[bytes, Callable[[torch.Tensor], torch.Tensor]]
"""A file's content, and what it computes when it is loaded."""


def _as_program(network: _Network, example: torch.Tensor, facts: dict[str, Any]) -> Exported:
    inputs = _inputs(network, example)
    shapes = {name: {0: torch.export.Dim("batch")} for name in inputs}
    program = torch.export.export(network, tuple(inputs.values()), dynamic_shapes=shapes)
    file = io.BytesIO()
    torch.export.save(program, file, extra_files={"metadata.json": json.dumps(facts, indent=2)})
    content = file.getvalue()
    loaded = torch.export.load(io.BytesIO(content)).module()

    def play(observations: torch.Tensor) -> torch.Tensor:
        found = loaded(*_inputs(network, observations).values())
        return found[0] if network.names else found

    return content, play


def _as_onnx(network: _Network, example: torch.Tensor, facts: dict[str, Any]) -> Exported:
    import onnxruntime

    inputs, log = _inputs(network, example), logging.getLogger("torch.onnx")
    level = log.level
    log.setLevel(logging.ERROR)  # it warns of operators of packages that are not there
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # torch's own deprecations
            program = torch.onnx.export(
                network,
                tuple(inputs.values()),
                input_names=list(inputs),
                output_names=["action", *network.names],
                dynamic_shapes={name: {0: "batch"} for name in inputs},
                dynamo=True,
                verbose=False,
            )
    finally:
        log.setLevel(level)
    assert program is not None
    words = {name: fact if isinstance(fact, str) else json.dumps(fact) for name, fact in facts.items()}
    program.model.metadata_props.update(words)
    content = program.model_proto.SerializeToString()
    session = onnxruntime.InferenceSession(content, providers=["CPUExecutionProvider"])

    def play(observations: torch.Tensor) -> torch.Tensor:
        of_them = {name: values.numpy() for name, values in _inputs(network, observations).items()}
        (actions,) = session.run(["action"], of_them)
        return torch.from_numpy(actions)

    return content, play


# What a file tells of task and robot.


def why_not(policy: Policy) -> str:
    """Returns why the file of a policy cannot tell how to play it, an empty string if it can."""
    if names := policy.info.get("transforms"):
        return f"the policy was trained behind {', '.join(names)}"
    try:
        resolve(policy.info["task"])
    except (ValueError, OSError, ImportError) as error:
        return f"its task is not at hand: {error}"
    return ""


def of_robot(policy: Policy) -> tuple[dict[str, Any], dict[str, Any]]:
    """Returns what the file of a policy tells of its task and robot, and the reference that it follows, if any.

    Nothing where :func:`why_not` says why.

    Returns:
        The facts by name. ``observation``, names and sizes of its terms in their order, none where they have no names;
        ``history``, how many of the last ones are joined, the newest last; ``action_offset`` and ``action_scale``
        ``(nu,)``, by which the controls are ``offset + scale * action``, unless the task has another way;
        ``actuators``, their names; ``joints``, those of the joints that they move, empty for a tendon; ``stiffness``
        and ``damping`` of position actuators, 0 for others, and ``force_limit`` of those that have one either way,
        else ``None``, the lesser where they differ, all three before a gear; ``home``, the home pose ``(nq,)``;
        ``physics_timestep`` of the training (s); ``mjcf``, the model as it is stepped, with its time step, integrator
        and contacts, as text with six digits, unless it needs further files; ``cases``, their control steps by name, if
        the task has any; and whatever else :meth:`torchrl_loco.LocoEnv.facts` holds, such as ``velocity``. And the
        tables of the reference by name.

    Raises:
        ValueError: the task's observations or actions are not those of the policy.
    """
    if why_not(policy):
        return {}, {}
    cls = resolve(policy.info["task"])
    env = cls(
        1, "cpu", 0, policy.info["protocol"], **{**arguments_of(policy.info), "engine": "mujoco"}, compile_hooks=False
    )  # tells the terms
    terms, cases, reference = env.observation_layout.get(policy.in_keys[0], {}), env.cases(), dict(env.reference())
    env.close()
    seen, layers = random_observations(policy.module, 1, 1.0), copy.deepcopy(policy.module).cpu()
    sizes = tuple(seen.shape[1:]), layers(seen).shape[-1]
    asked = tuple(env.observation_spec[policy.in_keys[0]].shape[1:]), env.action_spec.shape[-1]
    if sizes != asked:
        raise ValueError(
            f"the policy has observations of shape {sizes[0]} and {sizes[1]} actions, {policy.info['task']} has "
            f"{asked[0]} and {asked[1]}: it was edited since the training, or it is another task"
        )
    check_terms(policy.info.get("terms", ()), terms, policy.info["task"])
    spec = _stepped(models.specification(cls.model, folder_of(cls)), env.config)
    m = spec.compile()
    low, high = m.actuator_ctrlrange.T
    scaled = {"action_offset": (0.5 * (low + high)).tolist(), "action_scale": (0.5 * (high - low)).tolist()}
    facts = {
        "observation": [{"term": name, "size": size} for name, size in terms.items()],
        "history": cls.history.get(policy.in_keys[0], 1),
        **({} if "control" in own_hooks(cls) else scaled),
        **_actuators(m),
        "home": models.home_pose(m).tolist(),
        "physics_timestep": env.config.sim_dt,
        **_text(spec),
        **({"cases": dict(cases)} if cases else {}),
        **cls.facts(m, policy.info),
    }
    control, told = (cls.__mro__.index(definer(cls, name)) for name in ("control", "facts"))
    if control < told:  # the facts are of the controls of a class above
        facts = {name: fact for name, fact in facts.items() if name not in scaled}
    return facts, reference


def _control_timestep(info: Mapping[str, Any]) -> float:
    """Returns that of a policy's task: older files, and checkpoints, do not say it."""
    return sim_config(resolve(info["task"]).config, info["protocol"], 1, sim_of(info)).ctrl_dt


def _stepped(spec: mujoco.MjSpec, config: SimConfig) -> mujoco.MjSpec:
    """Returns a model as an environment with these settings steps it."""
    if config.solids_on_terrain == "spheres":
        stand_on_corners(spec)
    if config.contacts == "ground":
        models.touch_ground_only(m := spec.compile())
        for geom in spec.geoms:
            geom.contype, geom.conaffinity = int(m.geom_contype[geom.id]), int(m.geom_conaffinity[geom.id])
        for pair in spec.pairs:
            pair.margin = float(m.pair_margin[pair.id])
    spec.option.timestep, spec.option.integrator = config.sim_dt, integrator(config)
    return spec


def _actuators(m: mujoco.MjModel) -> dict[str, Any]:
    """Returns names, joints, gains (N m/rad, N m s/rad) and limits (N m) of a model's actuators."""
    of_joint = np.isin(m.actuator_trntype, (int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT)))
    servo = (m.actuator_biastype == int(mujoco.mjtBias.mjBIAS_AFFINE)) & (m.actuator_biasprm[:, 1] < 0)
    least = np.where(m.actuator_forcelimited[:, None], m.actuator_forcerange * [-1.0, 1.0], np.inf).min(axis=1)
    for i in np.flatnonzero(of_joint):  # joints may have a limit, too
        joint = m.joint(int(m.actuator_trnid[i, 0]))
        if m.jnt_actfrclimited[joint.id] and m.actuator_gear[i, 0]:
            of_gear = m.jnt_actfrcrange[joint.id] * [-1.0, 1.0] / abs(m.actuator_gear[i, 0])
            least[i] = min(least[i], of_gear.min())
    return {
        "actuators": [m.actuator(i).name for i in range(m.nu)],
        "joints": [m.joint(int(m.actuator_trnid[i, 0])).name if of_joint[i] else "" for i in range(m.nu)],
        "stiffness": np.where(servo, -m.actuator_biasprm[:, 1], 0.0).tolist(),
        "damping": np.where(servo, 0.0 - m.actuator_biasprm[:, 2], 0.0).tolist(),
        "force_limit": [float(limit) if np.isfinite(limit) else None for limit in least],
    }


def _text(spec: mujoco.MjSpec) -> dict[str, str]:
    """Returns the MJCF of a model, unless it cannot be compiled without further files, such as meshes."""
    files = [part.file for part in (*spec.meshes, *spec.textures, *spec.hfields, *spec.skins)]
    files += [file for texture in spec.textures for file in texture.cubefiles]
    return {} if any(files) else {"mjcf": spec.to_xml()}
