"""Boards under native control in virtual time."""
