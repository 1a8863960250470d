"""The command line `polysight`: it parses the options and calls one function, in most cases of `polysight.jobs`.

`main.FAMILIES` lists the commands that each module adds; only the module of the given command is imported. Options that
several commands share are in `options`.
"""
