"""Mutation testing: `make mutants` changes the code at random places, and sees whether a test notices.

`draw` draws the changes, `reach` finds the tests that come to each, `judge` runs these against it. No tests are here.
"""
