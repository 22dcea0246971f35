"""Cascading feature extraction (Hisadome & Matsui, 2021)."""
