"""What both users of Playground set."""

from mujoco_playground import dm_control_suite

TASKS = {"walker": "WalkerWalk", "humanoid": "HumanoidWalk"}


def overrides(body: str, worlds: int) -> dict[str, int]:
    """Returns room for contacts: what Playground's defaults give to 2048 worlds, for so many."""
    config = dm_control_suite.get_default_config(TASKS[body])
    return {"naconmax": config.naconmax * max(worlds, 2048) // 2048}
