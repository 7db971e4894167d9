"""Slices and the spots in them; knows no rod."""
