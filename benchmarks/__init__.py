"""Cases, peers, measurements and their results."""

import time

STARTED = time.monotonic()
"""When the process began, before the imports that take seconds."""
