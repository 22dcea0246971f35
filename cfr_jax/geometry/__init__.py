"""Arrays of points and motions. Nothing here is learned or read from files."""
