"""Cases, peers, measurements and their results."""
