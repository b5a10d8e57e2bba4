"""C MuJoCo on one thread, as many as Warp uses on the CPU."""

import sys

from benchmarks.peers.c_mujoco import main

if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]), threads=1)
