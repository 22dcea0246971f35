"""Merges many scans of one thing: finds the pose of each scan and makes one cloud of them all.

Within this folder, a scan is centered at its centroid, and lengths are in the caller's unit
(`scans`). The pose of a scan maps it into the model's frame. An edge maps its source onto its
target.
"""
