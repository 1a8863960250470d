"""`polysight`: the command line. It parses, and calls one function, mostly of `polysight.jobs`; it computes nothing.

`main.FAMILIES` says which module adds which commands; only the family of the command that was asked for is imported.
Options that several commands share are in `options`.
"""
