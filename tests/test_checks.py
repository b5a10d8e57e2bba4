"""Each check of arguments: what it returns, and what it refuses."""

import dataclasses
import math
import re
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from torchrl_loco import checks


def test_integers():
    assert checks.check_int("n", np.int64(3)) == 3
    assert type(checks.check_int("n", np.int64(3))) is int
    assert [checks.check_int("n", value) for value in (1, 2**31 - 1)] == [1, 2**31 - 1]
    assert checks.check_int("seed", 0, checks.SEED) == 0
    for value in (0, -1, 2**31):
        with pytest.raises(ValueError, match=rf"n must lie in \[1, 2\*\*31\), got {value}"):
            checks.check_int("n", value)
    for value in (1.5, 2.0, math.nan, "3", None, True, np.True_, [1], 1j):
        with pytest.raises(TypeError, match="n must be an integer, got"):
            checks.check_int("n", value)


def test_numbers():
    for value in (1, 0.5, np.float32(0.5), 1e300):
        assert checks.check_float("x", value) == value
        assert type(checks.check_float("x", value)) is float
    for value in (0.0, -1.0, math.inf, math.nan):
        with pytest.raises(ValueError, match=r"x must lie in \(0, inf\)"):
            checks.check_float("x", value)
    for value in ("1.0", None, True, np.True_, 1j, [1.0]):
        with pytest.raises(TypeError, match="x must be a number, got"):
            checks.check_float("x", value)


def test_intervals():
    """Bounds that belong to them and bounds that do not, as a message shows them."""
    cases = [
        (checks.FRACTION, "[0, 1]", (0, 1), (-0.1, 1.1)),
        (checks.Interval(0, 1, with_low=False, with_high=True), "(0, 1]", (0.1, 1), (0,)),
        (checks.Interval(0, 1), "[0, 1)", (0, 0.9), (1,)),
        (checks.ANY, "(-inf, inf)", (-1e300, 0, 1e300), (math.inf, -math.inf, math.nan)),
    ]
    for interval, shown, inside, outside in cases:
        assert [checks.check_float("x", value, interval) for value in inside] == list(inside)
        for value in outside:
            with pytest.raises(ValueError, match=re.escape(f"x must lie in {shown}, got {value}")):
                checks.check_float("x", value, interval)


def test_flags():
    assert checks.check_bool("flag", np.True_) is True
    assert checks.check_bool("flag", False) is False
    for value in (0, 1, "yes", None):
        with pytest.raises(TypeError, match="flag must be True or False"):
            checks.check_bool("flag", value)


def test_choices():
    assert checks.check_choice("fruit", "plum", ["pear", "plum"]) == "plum"
    with pytest.raises(ValueError, match=r"unknown fruit 'plumb', did you mean 'plum'.*choose one of pear, plum"):
        checks.check_choice("fruit", "plumb", ["pear", "plum"])
    with pytest.raises(ValueError, match="did you mean 'damson'"):
        checks.check_choice("fruit", "damsn", ["pear", "plum"], also=["damson"])
    for value in (None, 3, ["plum"], ""):
        with pytest.raises(ValueError, match="choose one of pear, plum"):
            checks.check_choice("fruit", value, ["pear", "plum"])


@dataclasses.dataclass
class Settings:
    count: int = 1
    rate: float = 1.0
    share: float = checks.within(checks.FRACTION, 0.0)
    flag: bool = False
    name: str = ""


def test_fields():
    checks.check_fields(Settings())
    for values, error in [
        ({"count": 0}, ValueError),
        ({"count": 1.5}, TypeError),
        ({"rate": 0.0}, ValueError),
        ({"share": 1.5}, ValueError),
        ({"flag": 1}, TypeError),
    ]:
        with pytest.raises(error, match=f"{next(iter(values))} must"):
            checks.check_fields(Settings(**values))


def test_multiples():
    assert checks.check_multiple("ctrl_dt", 0.025, "sim_dt", 0.0025) == 10
    assert checks.check_multiple("ctrl_dt", 0.3, "sim_dt", 0.1) == 3
    for value in (0.003, 0.001, 0.0251, 1e-9):
        with pytest.raises(ValueError, match=r"ctrl_dt .* whole multiple of sim_dt \(0.0025\), for example 0\.0"):
            checks.check_multiple("ctrl_dt", value, "sim_dt", 0.0025)


def test_devices(monkeypatch):
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 0)
    assert checks.check_device(None) == checks.check_device(torch.device("cpu")) == torch.device("cpu")
    for value in ("cuda", "cuda:0", "tpu", "", 5, ["cpu"]):
        with pytest.raises(ValueError, match=r"on this machine.*: choose one of cpu$"):
            checks.check_device(value)
    for version, why in ((None, "torch is built without CUDA"), ("12.8", "torch is built for CUDA 12.8, but")):
        monkeypatch.setattr(torch.version, "cuda", version)
        with pytest.raises(ValueError, match=re.escape(f"no device 'cuda' on this machine ({why}")):
            checks.check_device("cuda")
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    monkeypatch.setattr(torch.cuda, "current_device", lambda: 1)
    assert checks.check_device(None) == checks.check_device("cuda") == torch.device("cuda:1")
    assert checks.check_device("cuda:0") == torch.device("cuda:0")
    with pytest.raises(ValueError, match=r"no device 'cuda:2'.*cpu, cuda:0, cuda:1"):
        checks.check_device("cuda:2")


def test_output_files(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert checks.check_output_file("out", "video.mp4", [".mp4"]) == tmp_path / "video.mp4"
    Path("there").touch()
    for value, message in [
        ("video.avi", "out must end in one of .mp4, .mov"),
        ("none/video.mp4", "folder .*none does not exist"),
    ]:
        with pytest.raises(ValueError, match=message):
            checks.check_output_file("out", value, [".mp4", ".mov"])
    with pytest.raises(ValueError, match="there already exists"):
        checks.check_output_file("out", "there")
    with pytest.raises(TypeError):
        checks.check_output_file("out", 3)


def test_runs(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"no config\.json"):
        checks.check_run(tmp_path)
    (tmp_path / "config.json").touch()
    assert checks.check_run(str(tmp_path)) == tmp_path


def test_packages(monkeypatch):
    checks.check_packages("anything", ["torch", "numpy"], "train")
    monkeypatch.setitem(sys.modules, "numpy", None)
    with pytest.raises(ImportError, match=r"^the dashboard needs numpy, nopy: pip install 'torchrl-loco\[dash\]', or"):
        checks.check_packages("the dashboard", ["torch", "numpy", "nopy"], "dash")
