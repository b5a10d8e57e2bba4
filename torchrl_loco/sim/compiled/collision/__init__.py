"""Which geoms may touch, with which parameters, and how the shapes of a pair do."""
