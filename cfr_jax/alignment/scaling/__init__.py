"""The factor of scale between two clouds: what it may be, what it is, and how sure that is."""
