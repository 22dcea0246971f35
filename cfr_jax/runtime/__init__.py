"""What the rooms above stand on: atomic files, progress, compiled programs, optional libraries."""
