"""Arrays: NPY and NPZ, and the bare float32 rows of Velodyne scans."""
