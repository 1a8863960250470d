"""Stages with one interface, written dialogues, and a host at the emulated UNO."""
