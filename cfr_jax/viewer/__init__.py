"""Pictures of a registration: an interactive HTML page, a PNG, and a Rerun recording."""

from cfr_jax.viewer.layers import CloudLayer, write_layers
from cfr_jax.viewer.page import write_page
from cfr_jax.viewer.picture import write_picture
from cfr_jax.viewer.recording import write_recording
from cfr_jax.viewer.scene import Scene

__all__ = ["CloudLayer", "Scene", "write_layers", "write_page", "write_picture", "write_recording"]
