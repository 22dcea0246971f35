"""Training: a pure step, and everything around it; start at `loop.run`."""
