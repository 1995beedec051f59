"""Questions about controllers on this plant. `python -m benchmarks` lists them."""

import os

# NumPy reads this variable when it is imported. The matrices of controllers are so small that a
# second thread only waits, and results would differ in the last digit between `--jobs 1` and
# more jobs, whose processes have one thread each.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
