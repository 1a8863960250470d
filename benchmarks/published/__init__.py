"""The published method in plain form: the peer of the instrument's processing.

The steps, sizes and number formats of the authors' public code and of its notebooks' settings, rewritten for one
core with NumPy and SciPy; no line is theirs. `docs/benchmarks.md` says how its time compares with their code's.
"""
