"""``python -m torchrl_loco``: the command line."""

from torchrl_loco.cli import main

raise SystemExit(main())
