"""What tests are run for."""

from torchrl_loco import registry

TASKS = list(registry.OURS)  # not those of plug-ins that happen to be installed
PROTOCOLS = ("playground", "dm_control")
ENGINES = ("compiled", "mujoco_warp")
COMPILED = ("walker_run", "humanoid_run", "cheetah_run", "hopper_hop")
"""A task of each body that both engines can step, for what does not depend on the task."""
BODIES = (*COMPILED, "quadruped_run")
"""A task of each body."""
COARSE = {"sim_dt": 0.0125}
"""Two physics steps in a control step, for tests in which the physics does not matter: the fewer, the faster."""


def coarse(task):
    """The same for any task: COARSE is for the walker and the humanoid."""
    return {"sim_dt": registry.env_class(task).defaults.ctrl_dt / 2}
