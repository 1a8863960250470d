"""The published method, plainly: what the instrument's processing is measured against.

The steps, sizes and number formats of the authors' public code and of its notebooks' settings, written anew for one
core with NumPy and SciPy; no line is theirs. `docs/benchmarks.md` says how its time compares with their code's.
"""
