"""Weights on disk: files, cards, the authors' checkpoints, exported programs."""
