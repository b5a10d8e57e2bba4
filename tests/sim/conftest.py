import pytest

from torchrl_loco.sim.compiled import step


@pytest.fixture(autouse=True)
def texts_anew(monkeypatch):
    """Tests here change constants of the compiled step."""
    monkeypatch.setattr(step, "TRACED_DOFS", step.TRACED_DOFS)  # to be restored
    step.texts.clear()
    step.rows.clear()
    yield
    step.texts.clear()
    step.rows.clear()
