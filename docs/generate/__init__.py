"""What the site takes from the package instead of repeating it."""

import shutil
from pathlib import Path

from generate import benchmarks, bodies, fields, rewards, tasks
from generate.markdown import write
from torchrl_loco.policy import shipped_policies

DOCS = Path(__file__).parent.parent
OUT = DOCS / "generated"
NOTEBOOKS = DOCS.parent / "notebooks"


def everything() -> None:
    """Writes all that pages include to docs/generated, and leaves alone what has not changed."""
    fragments = OUT / "fragments"
    for name in tasks.RUNNERS:  # not for the plug-ins that happen to be installed
        write(fragments / f"{name}_properties.md", tasks.properties(name, benchmarks.training(name)))
        write(fragments / f"{name}_reward.md", rewards.formula(name))
        write(fragments / f"{name}_policy.md", tasks.shipped_policy(name))
    for name in shipped_policies("playground"):
        tasks.picture(name, OUT / "pictures" / f"{name}.webp")
    for body in tasks.CLASSES:
        write(fragments / f"{body}_observation.md", bodies.observation_table(body))
        write(fragments / f"{body}_action.md", bodies.action_table(body))
        write(fragments / f"{body}_protocols.md", tasks.protocols(body))
    write(fragments / "velocity_weights.md", tasks.velocity_weights())
    write(fragments / "fields.md", fields.fields())
    write(fragments / "notebooks.md", notebooks(NOTEBOOKS, OUT / "notebooks"))


def notebooks(source: Path, target: Path) -> str:
    """Returns the table of contents of the notebooks, which are copied to where Sphinx finds them."""
    shutil.rmtree(target, ignore_errors=True)
    if not source.is_dir():
        return "There are none in this copy of the repository.\n"
    shutil.copytree(source, target, ignore=shutil.ignore_patterns("[!a-zA-Z]*", "runs"))
    lines = (source / "README.md").read_text().splitlines()
    table = "\n".join(line for line in ["", *lines] if not line or line.startswith(("|", "In Colab")))
    table = table.replace("](", "](/generated/notebooks/").replace("/generated/notebooks/https", "https")
    entries = "\n".join(f"generated/notebooks/{path.stem}" for path in sorted(source.glob("*.ipynb")))
    return f"{table}\n```{{toctree}}\n:hidden:\n\n{entries}\n```\n"
