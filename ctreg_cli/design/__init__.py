"""Is a frame good for poses? Degenerate sets, symmetries and the accuracy to expect, before anything is built."""
