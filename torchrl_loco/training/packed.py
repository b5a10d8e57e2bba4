"""Steps as rows of one matrix: one kernel shuffles them, as a row costs it the same however long."""

import torch
from tensordict import TensorDict, TensorDictBase

ALIGNED = 16
"""Bytes at a multiple of which each entry of a row begins."""


class Packed:
    """A copy of steps whose entries lie one after the other in rows of bytes.

    Args:
        steps: entries of any type, batch ``(n,)``.
    """

    def __init__(self, steps: TensorDictBase) -> None:
        self._entries, end = [], 0
        for key, entry in steps.items(True, True):
            size = entry[0].numel() * entry.element_size()
            self._entries.append((key, slice(end, end + size), entry.dtype, entry.shape[1:]))
            end += -(-size // ALIGNED) * ALIGNED
        self._rows = entry.new_zeros(len(steps), end, dtype=torch.uint8)
        self.steps = self._views(self._rows)
        self.fill(steps)

    def __len__(self) -> int:
        return len(self._rows)

    def fill(self, steps: TensorDictBase) -> None:
        """Copies other steps of the same entries."""
        self.steps.update_(steps)

    def __getitem__(self, order: torch.Tensor) -> TensorDictBase:
        """Returns the steps with the numbers ``order``, as views of one new matrix."""
        return self._views(self._rows[order])

    def _views(self, rows: torch.Tensor) -> TensorDictBase:
        entries = {
            key: rows[:, columns].view(dtype).unflatten(-1, shape) if shape else rows[:, columns].view(dtype)[:, 0]
            for key, columns, dtype, shape in self._entries
        }
        return TensorDict(entries, batch_size=len(rows), device=rows.device)
