"""C++ of what a world stores: statements in the order in which they are needed, and rows written as a whole.

Where a row of a world is contiguous, a thread that writes it number by number reaches a sector of memory for each, and
a warp 32 of them. So the threads of a warp write their rows together, through shared memory, which halves the time of
a part (H100); reads gain nothing. Where worlds are neighbours in memory, or a warp is not full, each thread is alone.
"""

from collections.abc import Sequence

import torch

from torchrl_loco.envs.fusion.nodes import MOST_NUMBERS, TYPES, WHERE, CannotFuse, Node
from torchrl_loco.sim.compiled.step import WARP
from torchrl_loco.sim.world_func import BLOCK_DIM

LEAST_TOGETHER, WIDEST = 4, 64  # numbers of a row that are worth writing together, and the longest piece of a row

ROWS = f"""
#ifdef __CUDA_ARCH__
__shared__ float rows_of_warps[{BLOCK_DIM // WARP}][{WARP * (WIDEST + 1)}];
float* const rows = rows_of_warps[threadIdx.x / {WARP}];
const int lane = threadIdx.x % {WARP};
const bool full = __activemask() == 0xffffffffu;
#define WRITE_ROW(numbers, at, count, step) \\
  if (full) __syncwarp(); \\
  _Pragma("unroll") for (int i = 0; i < count; ++i) rows[lane * (count | 1) + i] = numbers[i]; \\
  if (full) {{ \\
    __syncwarp(); \\
    _Pragma("unroll 8") for (int i = 0; i < count; ++i) {{ \\
      const int place = {WARP} * i + lane, row = place / count, column = place % count; \\
      (at)[(row - lane) * step + column] = rows[row * (count | 1) + column]; \\
    }} \\
  }} else for (int i = 0; i < count; ++i) (at)[i] = rows[lane * (count | 1) + i];
#else
#define WRITE_ROW(numbers, at, count, step) for (int i = 0; i < count; ++i) (at)[i] = numbers[i];
#endif"""

Store = tuple[Node, Node]  # a number in memory, and what is written there


class Source:
    """C++ of stores: the statements of one world, which find the tensors ``used`` in ``args.p0``, ``args.p1``, ..."""

    def __init__(self, stores: list[Store], tensors: Sequence[torch.Tensor]) -> None:
        self._names: dict[Node, str] = {}
        self._lines: list[str] = []
        mask = _common_mask(stores)
        late: dict[Node, list[Store]] = {}
        if mask is None:
            stores, late = _without_late(stores)
        else:
            stores = [(target, node.args[1]) for target, node in stores]
        self._needed = _needed([*(node for _, node in stores), *late, *([mask] if mask else [])])
        if len(self._needed) > MOST_NUMBERS:
            raise CannotFuse(f"it has {len(self._needed)} numbers")
        places = {node.place for node in self._needed if node.place} | {target.place for target, _ in stores}
        self.used = sorted({place[0] for place in places})
        _check_overlap(tensors, self.used, {target.place[0] for target, _ in stores})
        self._users: dict[Node, list[Node]] = {node: [] for node in self._needed}
        for node in self._needed:
            for arg in node.args:
                self._users[arg].append(node)
        if mask is None:
            value = dict(stores)
            pieces = {piece[0]: (f"out{k}", piece) for k, piece in enumerate(_pieces(list(value)))}
            follow = {target for _, piece in pieces.values() for target in piece[1:]}
            for first in value:
                if first not in follow:
                    row, piece = pieces.get(first, ("", [first]))
                    self._store([(target, value[target]) for target in piece], row)
            for condition, constants in late.items():
                self._compute(condition)
                writes = " ".join(f"{target.text} = {constant.text};" for target, constant in constants)
                self._lines.append(f"if ({self._names[condition]}) {{ {writes} }}")
        else:  # few worlds, so each thread for itself
            self._compute(mask)
            self._lines.append(f"if (!{self._names[mask]}) return;")
            for store in stores:
                self._store([store])
        self.text = "\n".join([ROWS, *_pointers(tensors, places), *self._lines, ""])

    def _store(self, piece: list[Store], row: str = "") -> None:
        """Appends statements that store a number, or a piece of a row by the name ``row``."""
        for target, node in piece:
            self._compute(node)
            if target in self._needed:  # the old value, which is used later
                self._compute(target)
        values = [self._names[node] for _, node in piece]
        first = piece[0][0]
        if not row:
            self._lines.append(f"{first.text} = {values[0]};")
            return
        index, start, step = first.place
        self._lines.append(f"const float {row}[] = {{{', '.join(values)}}};")
        self._lines.append(f"WRITE_ROW({row}, p{index}_{step} + {start}, {len(piece)}, {step})")

    def _compute(self, node: Node) -> None:
        """Appends statements for a node and its parts, each once."""
        stack = [node]
        while stack:
            node = stack[-1]
            waiting = [arg for arg in node.args if arg not in self._names]
            if node in self._names or waiting:
                stack += reversed(waiting)
                if not waiting:
                    stack.pop()
                continue
            stack.pop()
            if node.number is not None:
                self._names[node] = node.text
            else:
                text = node.text.format(*(self._names[arg] for arg in node.args)) if node.args else node.text
                self._names[node] = f"t{len(self._names)}"
                self._lines.append(f"const {TYPES[node.dtype]} {self._names[node]} = {text};")
            stack += [user for user in self._users[node] if self._reduces(user)]

    def _reduces(self, node: Node) -> bool:
        """Returns whether a node is best computed as soon as it can be: a flag takes less room than what it is of."""
        if node in self._names or any(arg not in self._names for arg in node.args):
            return False
        users = self._users[node]
        return node.dtype == torch.bool or (bool(users) and all(user.dtype == torch.bool for user in users))


def _common_mask(stores: list[Store]) -> Node | None:
    """Returns the condition under which anything is written, if there is one: other worlds have nothing to do."""
    masks = {node.args[0] if node.text == WHERE and node.args[2] is target else None for target, node in stores}
    return masks.pop() if len(masks) == 1 else None


def _without_late(stores: list[Store]) -> tuple[list[Store], dict[Node, list[Store]]]:
    """Returns stores, and by condition what replaces many of them by a constant: that can wait for the condition."""
    late: dict[Node, list[Store]] = {}
    for target, node in stores:
        if node.text == WHERE and node.args[1].number is not None:
            late.setdefault(node.args[0], []).append((target, node.args[1]))
    late = {condition: constants for condition, constants in late.items() if len(constants) >= LEAST_TOGETHER}
    targets = {target for constants in late.values() for target, _ in constants}
    return [(target, node.args[2] if target in targets else node) for target, node in stores], late


def _needed(nodes: list[Node]) -> dict[Node, None]:
    """Returns nodes and their parts, in a fixed order."""
    found, stack = dict[Node, None](), list(nodes)
    while stack:
        node = stack.pop()
        if node not in found:
            found[node] = None
            stack += node.args
    return found


def _pieces(targets: list[Node]) -> list[list[Node]]:
    """Returns pieces of rows that are worth writing together: neighbours in memory."""
    rows: dict[tuple[int, int], list[Node]] = {}
    for target in targets:
        if target.dtype == torch.float32 and target.place[2] > 1:  # at 1 the worlds are neighbours
            rows.setdefault((target.place[0], target.place[2]), []).append(target)
    pieces: list[list[Node]] = []
    for row in rows.values():
        row.sort(key=lambda target: target.place[1])
        for target in row:
            last = pieces[-1][-1].place if pieces else None
            follows = last == (target.place[0], target.place[1] - 1, target.place[2])
            if not follows or len(pieces[-1]) == WIDEST:
                pieces.append([])
            pieces[-1].append(target)
    return [piece for piece in pieces if len(piece) >= LEAST_TOGETHER]


def _pointers(tensors: Sequence[torch.Tensor], places: set[tuple[int, int, int]]) -> list[str]:
    """Returns statements that find the rows of a world."""
    lines = []
    for index, step in sorted({(place[0], place[2]) for place in places}):
        kind = f"{TYPES[tensors[index].dtype]}*"
        lines.append(f"{kind} const p{index}_{step} = reinterpret_cast<{kind}>(args.p{index}) + world * {step}LL;")
    return lines


def _check_overlap(tensors: Sequence[torch.Tensor], used: list[int], written: set[int]) -> None:
    """Checks that what is written is read nowhere else."""

    def ends(index: int) -> tuple[int, int]:
        first, tensor = tensors[index].data_ptr(), tensors[index]
        span = 1 + sum((size - 1) * step for size, step in zip(tensor.shape, tensor.stride(), strict=True))
        return first, first + span * tensor.element_size() * bool(tensor.numel())

    for one in written:
        first, last = ends(one)
        if any(start < last and first < end for start, end in (ends(index) for index in used if index != one)):
            raise CannotFuse("a tensor that is written shares memory with another")
