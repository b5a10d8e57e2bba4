"""The task of each body that is measured. Peers import it in environments of their own, so it imports nothing."""

TASKS = {
    "walker": "walker_walk",
    "humanoid": "humanoid_walk",
    "cheetah": "cheetah_run",
    "hopper": "hopper_hop",
    "quadruped": "quadruped_walk",
    "Go1": "go1_velocity",
    "G1": "g1_velocity",
}
RUNNERS = list(TASKS)[:5]
"""The bodies of dm_control."""
MJLAB = {
    "go1_velocity": "Mjlab-Velocity-Flat-Unitree-Go1",
    "g1_velocity": "Mjlab-Velocity-Flat-Unitree-G1",
    "go1_rough": "Mjlab-Velocity-Rough-Unitree-Go1",
    "g1_tracking": "Mjlab-Tracking-Flat-Unitree-G1",
}
"""mjlab's names of those of our tasks that it has and whose training is measured."""


def playground_name(body: str) -> str:
    """Returns the name of a body's task in MuJoCo Playground, which has no quadruped."""
    return TASKS[body].title().replace("_", "")
