"""The frame from slice to slice."""
