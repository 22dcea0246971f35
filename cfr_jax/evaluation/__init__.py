"""Compares methods on the same pairs: runs them, measures errors, writes tables and figures.

Every method runs in its own process, so that a crash or a hang does not harm the others.
"""
