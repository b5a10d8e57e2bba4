"""The fields of the model that can vary, as a table."""

from generate.markdown import table
from torchrl_loco.envs.vary import FIELDS

MUST = {
    "finite": "",
    "positive": "positive",
    "not negative": "not negative",
    "rising": "lower below upper",
    "inertia": "positive, none above the sum of the others",
}


def fields() -> str:
    """Returns the table: name, what has it, what it is, unit, what must be true."""
    rows = []
    for name, field in FIELDS.items():
        size = f", {field.size} numbers" if field.size > 1 else ""
        rows.append([f"`{name}`", (field.of or "model") + size, field.meaning, field.unit, MUST[field.valid]])
    return table(["field", "of a", "what it is", "unit", "must be"], rows)
