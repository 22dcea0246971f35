"""HDF5 files that users hand over, read by a process of its own (`reading`, `child`)."""
