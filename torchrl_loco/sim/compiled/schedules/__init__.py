"""How a control step is spread over threads: one a world, traced; or a group of lanes a world, in loops."""
