"""Ways to merge many scans, side by side on sets of scans with known poses."""
