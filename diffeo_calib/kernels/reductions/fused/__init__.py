"""Kernel sums in one loop that is compiled for the processor at first use; sums.py is the backend."""
