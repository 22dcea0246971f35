"""Takes a user's two clouds and finds the motion between them, and how far to trust it."""
