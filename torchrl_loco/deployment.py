"""What a policy's file tells of its task and robot, so that a program can play it without this package."""

from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np

from torchrl_loco.config import arguments_of
from torchrl_loco.registry import resolve

if TYPE_CHECKING:
    from torchrl_loco.policy import Policy


def why_not(policy: "Policy") -> str:
    """Returns why the file of a policy cannot tell how to play it, an empty string if it can."""
    if names := policy.info.get("transforms"):
        return f"the policy was trained behind {', '.join(names)}"
    try:
        resolve(policy.info["task"])
    except (ValueError, OSError, ImportError) as error:
        return f"its task is not at hand: {error}"
    return ""


def of_robot(policy: "Policy") -> tuple[dict[str, Any], dict[str, Any]]:
    """Returns what the file of a policy tells of its task and robot, and the reference that it follows, if any.

    Nothing where :func:`why_not` says why.

    Returns:
        The facts by name. ``observation``, names and sizes of its terms in their order, none where they have no names;
        ``history``, how many of the last ones are joined, the newest last; ``action_offset`` and ``action_scale``
        ``(nu,)``, by which the controls are ``offset + scale * action``, unless the task has another way;
        ``actuators``, their names; ``joints``, those of the joints that they move, empty for a tendon; ``stiffness``,
        ``damping`` and ``force_limit`` of position actuators, 0 and ``None`` for others; ``home``, the home pose
        ``(nq,)``; ``physics_timestep`` of the training (s); ``mjcf``, the model as text, with six digits, unless it
        needs further files; ``cases``, their control steps by name, if the task has any; and whatever else
        :meth:`torchrl_loco.LocoEnv.facts` holds, such as ``velocity``. And the tables of the reference by name.
    """
    if why_not(policy):
        return {}, {}
    from torchrl_loco.envs.hooks import own_hooks
    from torchrl_loco.sim import models

    cls, spec = resolve(policy.info["task"]), specification(policy.info["task"])
    m = spec.compile()
    low, high = m.actuator_ctrlrange.T
    env = cls(
        1, "cpu", 0, policy.info["protocol"], **{**arguments_of(policy.info), "engine": "mujoco"}, compile_hooks=False
    )  # tells the terms
    terms, cases, reference = env.observation_layout["observation"], env.cases(), dict(env.reference())
    env.close()
    scaled = {"action_offset": (0.5 * (low + high)).tolist(), "action_scale": (0.5 * (high - low)).tolist()}
    facts = {
        "observation": [{"term": name, "size": size} for name, size in terms.items()],
        "history": cls.history.get("observation", 1),
        **({} if "control" in own_hooks(cls) else scaled),
        **_actuators(m),
        "home": models.home_pose(m).tolist(),
        "physics_timestep": env.config.sim_dt,
        **_text(spec),
        **({"cases": dict(cases)} if cases else {}),
        **cls.facts(m, policy.info),
    }
    return facts, reference


def specification(task: str) -> mujoco.MjSpec:
    """Returns the model of a task, to be compiled.

    Raises:
        ValueError: there is no such task, or its model is no valid MJCF.
        OSError: there is no such file.
        ImportError: the file or module of the task raises an error.
    """
    from torchrl_loco.envs.task import folder_of
    from torchrl_loco.sim import models

    cls = resolve(task)
    return models.specification(cls.model, folder_of(cls))


def _actuators(m: mujoco.MjModel) -> dict[str, Any]:
    """Returns names, joints, gains (N m/rad, N m s/rad) and limits (N m) of a model's actuators."""
    of_joint = np.isin(m.actuator_trntype, (int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT)))
    servo = (m.actuator_biastype == int(mujoco.mjtBias.mjBIAS_AFFINE)) & (m.actuator_biasprm[:, 1] < 0)
    limited = m.actuator_forcelimited.astype(bool)
    return {
        "actuators": [m.actuator(i).name for i in range(m.nu)],
        "joints": [m.joint(int(m.actuator_trnid[i, 0])).name if of_joint[i] else "" for i in range(m.nu)],
        "stiffness": np.where(servo, -m.actuator_biasprm[:, 1], 0.0).tolist(),
        "damping": np.where(servo, -m.actuator_biasprm[:, 2], 0.0).tolist(),
        "force_limit": [float(m.actuator_forcerange[i, 1]) if limited[i] else None for i in range(m.nu)],
    }


def _text(spec: mujoco.MjSpec) -> dict[str, str]:
    """Returns the MJCF of a model, unless it cannot be compiled without further files, such as meshes."""
    text = spec.to_xml()
    try:
        mujoco.MjModel.from_xml_string(text)
    except ValueError:
        return {}
    return {"mjcf": text}
