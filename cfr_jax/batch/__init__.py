"""Many pairs: read ahead, registered in batches, resumed where they stopped.

What only names and counts pairs (`jobs`, `journal`, `sharding`) imports no JAX.
"""
