"""Mutation testing: `make mutants` changes the code at random places, and counts how many changes the tests notice.

`draw` draws the changes, `coverage` finds the tests that execute each changed statement, and `judge` runs these tests
against the changed code. This folder has no tests.
"""
