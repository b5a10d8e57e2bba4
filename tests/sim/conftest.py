import pytest

from torchrl_loco.sim.compiled import step


@pytest.fixture(autouse=True)
def texts_anew():
    """Tests here change constants of the compiled step."""
    step.texts.clear()
    yield
    step.texts.clear()


@pytest.fixture(params=[31, 0], ids=["traced", "lanes"])
def form(request, monkeypatch):
    """Takes one of the two forms of the compiled step for any model."""
    monkeypatch.setattr(step, "TRACED_DOFS", request.param)
    return "traced" if request.param else "lanes"
