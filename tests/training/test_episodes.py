"""Returns of the episodes that end in training, against a loop over worlds and steps."""

import torch
from for_each import for_each

from torchrl_loco.training.episodes import WINDOW, Episodes


def by_hand(reward, done, terminated, *, from_start, action_repeat, full_length):
    """Returns number, sum of returns and sum of lengths of the whole episodes that end."""
    found = []
    for rewards, ends, falls in zip(reward.tolist(), done.tolist(), terminated.tolist(), strict=True):
        total, steps, whole = 0.0, 0, from_start
        for r, end, fell in zip(rewards, ends, falls, strict=True):
            total, steps = total + r, steps + action_repeat
            if end:
                if whole:
                    as_it_is = fell and steps <= full_length
                    found.append((1, total if as_it_is else total * full_length / steps, steps))
                total, steps, whole = 0.0, 0, True
    return [sum(row[i] for row in found) for i in range(3)]


@for_each("from_start", [True, False])
def test_sums_are_those_of_a_loop(from_start):
    """Over batches of several lengths, in one of which no episode ends; some are longer than the task's own."""
    torch.manual_seed(0)
    worlds, lengths = 7, (5, 1, 9, 4, 12)
    reward = torch.randn(worlds, sum(lengths))
    done = torch.rand(worlds, sum(lengths)) < 0.3
    done[:, 6:15] = False
    terminated = done & (torch.rand(worlds, sum(lengths)) < 0.5)
    episodes = Episodes(worlds, "cpu", action_repeat=3, full_length=40, from_start=from_start)
    parts = zip(*(x.split(lengths, dim=1) for x in (reward, done, terminated)), strict=True)
    sums = torch.stack([episodes.add(*part) for part in parts]).sum(0)
    expected = by_hand(reward, done, terminated, from_start=from_start, action_repeat=3, full_length=40)
    assert expected[0] > 10
    torch.testing.assert_close(sums, torch.tensor(expected))


def test_means_are_over_the_last_hundred_episodes_in_whole_batches():
    episodes = Episodes(1, "cpu", 1, 10, from_start=True)
    for value in range(10):
        episodes.take(40, 40.0 * value, 40.0)
        assert episodes.count == min(40 * (value + 1), 120) >= min(WINDOW, 40 * (value + 1))
        episodes.take(0, 0.0, 0.0)
    assert episodes.metrics(0.0, 10) == {"return": (7 + 8 + 9) / 3, "episode_length": 1.0, "episodes": 120}
    episodes.take(1000, 5000.0, 1000.0)
    assert (episodes.count, episodes.metrics(0.0, 10)["return"]) == (1000, 5.0)
