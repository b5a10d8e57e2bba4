"""Warp starts without a word where there is no CUDA, unless something is wrong."""

import os
import threading
from pathlib import Path

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


def test_threads_have_one_precompiled_header_beside_the_kernels(monkeypatch, tmp_path):
    init_warp()
    monkeypatch.setattr(wp.config, "kernel_cache_dir", str(tmp_path))  # where no kernel is cached
    folders = []

    def compiled(value):
        @wp.kernel(enable_backward=False, module="unique")
        def fill(out: wp.array[int]):
            out[wp.tid()] = wp.static(value)

        out = wp.zeros(1, dtype=int, device="cpu")
        wp.launch(fill, 1, outputs=[out], device="cpu")
        assert out.numpy() == value
        folders.append(wp._src.context.runtime.get_clang_pch_dir())

    threads = [threading.Thread(target=compiled, args=[value]) for value in (3, 4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(folders) == 2
    assert len({*folders}) == 1
    assert [*Path(folders[0]).glob("*.pch")]
    assert Path(folders[0]).parent == tmp_path
