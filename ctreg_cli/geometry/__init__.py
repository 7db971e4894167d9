"""Rods, slice planes, poses: pure arrays; knows no image and no file."""
