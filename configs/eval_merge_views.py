"""Merges of 12 depth views around open CAD shapes (`tools/make_views.py` makes them)."""

from cfr_jax.evaluation.multiway.config import MergeConfig


def get_config() -> MergeConfig:
    """Views in no order, turned by up to 45 degrees about each axis."""
    return MergeConfig(
        title="Twelve views around open CAD shapes",
        data={"kind": "views", "path": "data/views"},
    )
