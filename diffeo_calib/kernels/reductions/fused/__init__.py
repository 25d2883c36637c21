"""Kernel sums in one loop, compiled for the processor at first use: symbols.py, loops.py write it, native.py compiles."""
