"""Weights on disk: files, cards, checkpoints of the papers' authors, and exported programs."""
