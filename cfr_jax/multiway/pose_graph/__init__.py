"""Finds poses from measured motions: solves the graph, finds wrong edges and connected parts."""
