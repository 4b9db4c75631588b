"""How the threads of a parallel loop wait for each other; imported before PyTorch, which reads it once."""

import os

# By default a thread that is done spins until the slowest one is. On cores that other programs use this takes
# the time away from it, and small loops take several times as long: `docs/performance.md` has the figures.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
