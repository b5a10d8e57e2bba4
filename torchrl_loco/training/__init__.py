"""Training as parts that can be used on their own: settings, algorithms, evaluation, run folder and the loop."""

import lazy_loader

# Imported when asked for, as in torchrl_loco itself: the names are those of __init__.pyi.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
