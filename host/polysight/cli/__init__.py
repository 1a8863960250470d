"""`polysight`: the command line. It parses, and calls `polysight.jobs`; nothing is computed here.

`main.FAMILIES` says which module adds which commands; only the family of the command that was asked for is imported.
Options that several commands share are in `options`.
"""
