"""Many scans of one thing in, the pose of each and one merged cloud out.

Within this room a scan is centered at its centroid, and lengths are in units of the scans' common
radius (`scans`): the pose of a scan maps it into the model's frame, an edge maps its source onto
its target.
"""
