"""torch.compile, as trainings use it."""

from collections.abc import Callable
from typing import Any

import torch


def compiled(function: Callable[..., Any], what: str, **settings: Any) -> Callable[..., Any]:
    """Returns kernels of a whole function of tensors, which are made at its first call.

    Args:
        function: the function, or a module.
        what: it is, for the error.
        settings: further ones of ``torch.compile``.

    Returns:
        A function. It raises a ``TypeError`` where torch.compile cannot follow the function.
    """

    def call(*args: Any) -> Any:
        return function(*args)

    # Of one code object torch.compile makes 8 versions at most, and a process may train more often than that.
    call.__code__ = call.__code__.replace()
    kernels = torch.compile(call, fullgraph=True, dynamic=False, **settings)

    def run(*args: Any) -> Any:
        try:
            return kernels(*args)
        except torch._dynamo.exc.Unsupported as error:
            raise TypeError(f"torch.compile cannot follow {what}; train with compile=False: {error}") from error

    return run
