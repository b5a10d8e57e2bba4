"""Several values in one test."""

import functools
import inspect


def for_each(names, values=(), **of_devices):
    """Returns a decorator by which a test runs for each of several values, as one test; a failure says for which.

    Its fixtures are the same for all of them; torch's random numbers begin anew.

    Args:
        names: the arguments, as for pytest's parametrize.
        values: one for each run, or one tuple for each if there are several arguments; or the fixture that holds them.
        of_devices: further ones by the type of the device that the test is run for.
    """
    names = names.split(", ") if isinstance(names, str) else names
    needed = [values] * isinstance(values, str) + ["device"] * bool(of_devices)

    def decorator(test):
        parameters = inspect.signature(test).parameters

        @functools.wraps(test)
        def test_all(**fixtures):
            import torch  # not in the process that distributes tests

            given = {name: value for name, value in fixtures.items() if name in parameters}
            rows = fixtures[values] if isinstance(values, str) else values
            more = of_devices[str(fixtures["device"]).partition(":")[0]] if of_devices else ()
            for row in (*rows, *more):
                arguments = dict(zip(names, row if len(names) > 1 else [row], strict=True))
                torch.manual_seed(0)
                try:
                    test(**given, **arguments)
                except BaseException as error:
                    error.add_note("with " + ", ".join(f"{name}={value!r}" for name, value in arguments.items()))
                    raise

        taken = dict.fromkeys([*(name for name in parameters if name not in names), *needed])
        kind = inspect.Parameter.KEYWORD_ONLY
        test_all.__signature__ = inspect.Signature([inspect.Parameter(name, kind) for name in taken])
        return test_all

    return decorator
