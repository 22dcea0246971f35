"""Many pairs: read ahead, registered in batches, and resumed after an interruption.

The modules that only list and count pairs (`jobs`, `journal`, `checked_lines`, `sharding`) do not
import JAX.
"""
