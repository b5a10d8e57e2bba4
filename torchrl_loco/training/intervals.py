"""Which numbers the settings of a training may be."""

from torchrl_loco.checks import ANY, COUNT, FRACTION, NOT_NEGATIVE, SEED, Interval

INTERVALS = {
    "seed": SEED,
    "eval_interval": COUNT,
    "gamma": Interval(0, 1, with_low=False, with_high=True),
    "lmbda": FRACTION,
    "trial_fraction": Interval(0, 1, with_low=False),
    "final_lr_fraction": FRACTION,
    "video_seconds": NOT_NEGATIVE,
    "checkpoint_seconds": NOT_NEGATIVE,
    "clip_epsilon": Interval(0, 1, with_low=False, with_high=True),
    "entropy_coeff": NOT_NEGATIVE,
    "target_kl": NOT_NEGATIVE,
    "target_entropy": ANY,
    "aux_coeff": NOT_NEGATIVE,
    "num_bins": Interval(2, 2**31),
    "min_value": ANY,
    "max_value": ANY,
    "episode_length": COUNT,
    "norm_eps": NOT_NEGATIVE,
    "random_shift": COUNT,
    "warmup": COUNT,
    "horizon": Interval(2, 2**31),
    "target_rate": Interval(0, 1, with_low=False, with_high=True),
    "average_rate": Interval(0, 1, with_low=False, with_high=True),
}
"""Intervals of the fields that are not simply positive."""
