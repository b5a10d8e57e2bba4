"""What tests are run for."""

import hook_tasks

from torchrl_loco import registry

HOOK_TASKS = ("dog_follow", "walker_backwards", "walker_blindly", "walker_unsteady")
"""Tasks in plain torch, wholly or in part."""
for _id, _class in zip(
    HOOK_TASKS,
    (hook_tasks.FollowVelocity, hook_tasks.WalkBackwards, hook_tasks.WalkBlindly, hook_tasks.Unsteady),
    strict=True,
):
    registry.register(_id, _class)


TASKS = [task for task in registry.OURS if not task.endswith("_velocity")]  # nor those of plug-ins
"""Those of dm_control; test_velocity.py is for the robots."""
PROTOCOLS = ("playground", "dm_control")
ENGINES = ("compiled", "mujoco_warp")
COMPILED = ("walker_run", "humanoid_run", "cheetah_run", "hopper_hop")
"""A task of each body that both engines can step, for what does not depend on the task."""
KINDS = (
    ("walker_run", "playground", "compiled"),
    ("humanoid_run", "dm_control", "compiled"),
    ("quadruped_run", "dm_control", "mujoco_warp"),
    ("walker_unsteady", "playground", "compiled"),
)
"""A task of each kind (traced, by lanes, with MuJoCo-Warp, with hooks), for what depends on nothing else of a task."""
BODIES = (*COMPILED, "quadruped_run")
"""A task of each body."""
MODELS = {registry.env_class(task).body: registry.env_class(task).model for task in BODIES}
"""The MJCF file of each body."""
CONFIGS = {registry.env_class(task).body: registry.env_class(task).config for task in BODIES}
"""The settings of each body under ``playground``."""
COARSE = {"sim_dt": 0.0125}
"""Two physics steps in a control step, for tests in which the physics does not matter: the fewer, the faster."""


STAGGERED = {"episode_length": 7, "stagger": True, "on_overflow": "ignore"}
"""Short episodes that do not end together. Coarse steps make a humanoid fly apart, with more contacts than places."""


def coarse(task):
    """The same for any task: COARSE is for the walker and the humanoid."""
    return {"sim_dt": registry.env_class(task).config.ctrl_dt / 2}
