"""torch.compile, as trainings use it."""

import importlib
from collections.abc import Callable
from typing import Any

import torch


def start() -> None:
    """Imports the compiler, and with it starts the processes that compile kernels: they take seconds to be ready."""
    importlib.import_module("torch._inductor.compile_fx")
    importlib.import_module("torch._inductor.async_compile").maybe_warm_pool()


def compiled(function: Callable[..., Any], what: str, **settings: Any) -> Callable[..., Any]:
    """Returns a function that torch.compile makes of another one, as a whole and for one shape, at the first call.

    Args:
        function: a function of tensors, or a module.
        what: its name in the error.
        settings: further ones of ``torch.compile``.

    Returns:
        The compiled function, which raises a ``TypeError`` if torch.compile cannot trace it.
    """

    def call(*args: Any) -> Any:
        return function(*args)

    # torch.compile limits a code object to 8 versions, which further trainings of a process would exceed.
    call.__code__ = call.__code__.replace()
    kernels = torch.compile(call, fullgraph=True, dynamic=False, **settings)

    def run(*args: Any) -> Any:
        try:
            return kernels(*args)
        except torch._dynamo.exc.Unsupported as error:
            raise TypeError(f"torch.compile cannot trace {what}; train with compile=False: {error}") from error

    return run
