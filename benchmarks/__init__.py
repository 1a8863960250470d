"""Speed and accuracy of the instrument on simulated data, compared with a simple method or with the truth.

`measure` has the rules of timing and the tables, `data` the simulated rows and scans, `published` the published method
as a peer. docs/benchmarks.md has the results.
"""
