"""Both forms of the compiled step, for any model."""

import functools

import pytest
from for_each import for_each

from torchrl_loco.sim.compiled import step

FORMS = {"traced": 31, "lanes": 0}
"""Most degrees of freedom that are traced."""


def in_both_forms(test):
    """Returns a test of a ``form`` that runs in one and then in the other."""

    @functools.wraps(test)
    def in_form(form, **fixtures):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(step, "TRACED_DOFS", FORMS[form])
            step.texts.clear()
            test(form=form, **fixtures)

    return for_each("form", FORMS)(in_form)
