"""``python -m benchmarks``: runs the benchmarks."""

from benchmarks.throughput import main

raise SystemExit(main())
