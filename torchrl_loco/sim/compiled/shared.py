"""The C++ that both schedules share: ``arithmetic.h``, ``laws.h`` and ``line_search.h``."""

import pathlib

FOLDER = pathlib.Path(__file__).parent
LAWS = "".join((FOLDER / f"{name}.h").read_text() + "\n" for name in ("arithmetic", "laws"))
"""Declarations, for the head of a function."""
_LINE_SEARCH = (FOLDER / "line_search.h").read_text()


def line_search(scale: str, tolerance: str, near: str, iterations: str) -> str:
    """Returns the body of the function of the line search.

    Args:
        scale: C++ expression of one over the inertia of the model.
        tolerance: of the slope, relative to it.
        near: the share of its first slope at which it may end.
        iterations: how many steps are tried, or brackets of three where ``near`` is 0 or there are at most 3.
    """
    values = {"LS_TOLERANCE": tolerance, "LS_NEAR": near, "LS_ITERATIONS": iterations, "SCALE": scale}
    text = _LINE_SEARCH
    for word, value in values.items():
        text = text.replace(word, value)
    return text
