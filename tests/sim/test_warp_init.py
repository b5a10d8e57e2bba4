"""Warp starts without a word where there is no CUDA, unless something is wrong."""

import os

import torch
import warp as wp

from torchrl_loco.sim.warp_init import init_warp


def test_of_what_warp_says_only_the_missing_driver_is_left_out(monkeypatch, capfd):
    line = b"Warp CUDA warning: Could not find or load the NVIDIA CUDA driver. GPU execution will not be available.\n"
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    monkeypatch.setattr(wp, "init", lambda: os.write(2, line + b"Warp error: no compiler\n"))
    init_warp.__wrapped__()
    os.write(2, b"after\n")
    assert capfd.readouterr().err == "Warp error: no compiler\nafter\n"
