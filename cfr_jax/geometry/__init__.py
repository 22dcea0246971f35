"""Arrays of points and motions: nothing is learned here, and nothing is read."""
