"""Poses from measured motions: the graph, its wrong edges, and what hangs together."""
