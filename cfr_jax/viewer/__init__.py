"""Pictures of a registration: one HTML page to turn it in, one PNG to print."""

from cfr_jax.viewer.page import write_page
from cfr_jax.viewer.picture import write_picture
from cfr_jax.viewer.scene import Scene

__all__ = ["Scene", "write_page", "write_picture"]
