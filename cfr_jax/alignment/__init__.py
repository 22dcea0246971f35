"""A user's two clouds in; the motion between them, and how far to trust it, out."""
