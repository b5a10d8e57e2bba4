"""The task of each body that is measured. Peers import it in environments of their own, so it imports nothing."""

TASKS = {
    "walker": "walker_walk",
    "humanoid": "humanoid_walk",
    "cheetah": "cheetah_run",
    "hopper": "hopper_hop",
    "quadruped": "quadruped_walk",
}


def playground_name(body: str) -> str:
    """Returns the name of a body's task in MuJoCo Playground, which has no quadruped."""
    return TASKS[body].title().replace("_", "")
