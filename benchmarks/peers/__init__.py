"""The same step in other simulators, each in a process of its own.

A peer is a module that is run with a body and a number of worlds and prints ``{"ms": ...}``: the time of one control
step of all worlds. Those that bring another MuJoCo import nothing of torchrl_loco.
"""
