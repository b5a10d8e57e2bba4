"""The tasks: a folder for each body, with its model, its tasks and their settings.

A task is a class in whose name is that of its folder: ``WalkerWalk`` in ``walker`` has the id ``walker_walk``,
``Go1Velocity`` in ``velocity`` the id ``go1_velocity``.
What those of robots share is in ``robots``.
"""

import ast
import functools
import re
from pathlib import Path
from typing import NamedTuple


class Task(NamedTuple):
    """Where the class of a task is, and what it asks for."""

    module: str
    name: str
    summary: str  # the first line of its docstring
    has_options: bool  # whether a class of its module declares options


@functools.cache
def found() -> dict[str, Task]:
    """Returns the tasks in the folders by id, read without importing them: torch and Warp take seconds."""
    tasks = {}
    for path in sorted(Path(__file__).parent.glob("*/__init__.py")):
        folder = path.parent.name
        body, environments = folder.title().replace("_", ""), {"LocoEnv"}
        module = ast.parse(path.read_text(encoding="utf-8"))
        targets = [target for node in ast.walk(module) if isinstance(node, ast.Assign) for target in node.targets]
        has_options = any(isinstance(target, ast.Name) and target.id == "options" for target in targets)
        for node in module.body:
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith(f"{__name__}."):
                environments |= {name.name for name in node.names}
            if isinstance(node, ast.ClassDef) and environments & {
                base.id for base in node.bases if isinstance(base, ast.Name)
            }:
                environments.add(node.name)
                if node.name != body and body in node.name:
                    id = re.sub("(?<!^)(?=[A-Z])", "_", node.name).lower()
                    summary = (ast.get_docstring(node) or "").partition("\n")[0]
                    tasks[id] = Task(f"{__name__}.{folder}", node.name, summary, has_options)
    return tasks
