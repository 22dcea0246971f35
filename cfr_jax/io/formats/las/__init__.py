"""LAS, and LAZ, which is LAS compressed."""
