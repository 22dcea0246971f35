"""Fits and measures confidences: trials, the fit, reliability."""
