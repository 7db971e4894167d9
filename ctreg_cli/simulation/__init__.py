"""Slices whose truth is known."""
