"""Memory that Warp kernels and torch share."""

from typing import Any

import torch
import warp as wp


class Buffer:
    """An array of zeros on a device, as Warp and as torch see it. Its address never changes, so graphs can record it.

    Args:
        shape: its shape.
        dtype: its Warp type.
        device: where it lives.

    Attributes:
        warp: what kernels read and write.
        torch: a view of the same memory. It always holds the current values: clone what you want to keep.
    """

    def __init__(self, shape: int | tuple[int, ...], dtype: Any, device: wp.Device) -> None:
        self.warp: wp.array = wp.zeros(shape, dtype=dtype, device=device)
        self.torch: torch.Tensor = wp.to_torch(self.warp)

    def rows(self) -> "list[Buffer]":
        """Returns the rows as buffers that share this one's memory."""
        rows = []
        for i in range(len(self.torch)):
            row = object.__new__(Buffer)
            row.warp, row.torch = self.warp[i], self.torch[i]
            rows.append(row)
        return rows
