"""What tests are run for."""

from torchrl_loco import registry

OTHERS = {"velocity", "rough", "tracking"}
TASKS = [task for task in registry.OURS if OTHERS.isdisjoint(task.split("_"))]  # nor those of plug-ins
"""Those of dm_control; test_velocity.py, test_rough.py and test_tracking.py are for the robots."""
PROTOCOLS = ("playground", "dm_control")
ENGINES = ("compiled", "mujoco_warp")
COMPILED = ("walker_run", "humanoid_run", "cheetah_run", "hopper_hop")
"""A task of each body that both engines can step, for what does not depend on the task."""
KINDS = (
    ("walker_run", "playground", "compiled"),
    ("quadruped_run", "dm_control", "compiled"),
    ("walker_run", "dm_control", "mujoco_warp"),
    ("walker_unsteady", "playground", "compiled"),
)
"""A task of each kind: traced; by lanes, with activations; with MuJoCo-Warp; with hooks."""
BODIES = (*COMPILED, "quadruped_run")
"""A task of each body."""
COARSE = {"sim_dt": 0.0125}
"""Two physics steps in a control step, for tests in which the physics does not matter: the fewer, the faster."""
STAGGERED = {"episode_length": 7, "stagger": True, "on_overflow": "ignore"}
"""Short episodes that do not end together. Coarse steps make a humanoid fly apart, with more contacts than places."""


def coarse(task):
    """The same for any task: COARSE is for the walker and the humanoid."""
    return {"sim_dt": registry.env_class(task).config.ctrl_dt / 2}


def __getattr__(name):
    """Makes what needs the classes of tasks, whose import takes seconds, when it is first asked for."""
    if name == "MODELS":  # the MJCF file of each body
        return {registry.env_class(task).body: registry.env_class(task).model for task in BODIES}
    if name == "CONFIGS":  # the settings of each body under ``playground``
        return {registry.env_class(task).body: registry.env_class(task).config for task in BODIES}
    raise AttributeError(name)
