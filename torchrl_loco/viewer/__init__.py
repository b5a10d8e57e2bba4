"""A viewer in the browser: worlds side by side, live from the simulation, with what steers and explains them."""
