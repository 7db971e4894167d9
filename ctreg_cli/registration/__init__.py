"""Spots and rods in, pose and its covariance out."""
