"""What a page is served at and how many worlds it shows; it imports nothing that takes seconds."""

from torchrl_loco.checks import Interval, check_packages

LOOPBACK = "127.0.0.1"
"""Address that this machine alone reaches."""
PORT = 8080
WORLDS = Interval(1, 64, with_high=True)
"""How many worlds a page shows."""
SHARE = Interval(0, 1, with_low=False, with_high=True)
"""Shares of the machine's CPU time that a viewer may take."""


def check_viewer() -> None:
    """Checks that the extra ``viewer`` is installed.

    Raises:
        ImportError: it is not; the message says how to install it.
    """
    check_packages("the viewer in the browser", ("viser", "mjviser"), "viewer")
