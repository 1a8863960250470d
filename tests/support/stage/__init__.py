"""Stages of all kinds with the same interface, conversations with them from text files, and stages as processes."""
