"""Builds corpora of shapes from meshes."""
