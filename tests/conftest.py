"""One thread for these small problems: waiting for a second one costs more than it brings on a busy machine.

Set before torch and numpy are imported, and for the processes that tests start.
"""

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")
