"""Training: a pure step, and all that stands around it; `loop.run` is the way in."""
