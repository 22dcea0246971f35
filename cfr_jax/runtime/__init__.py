"""Used by all other folders: atomic files, progress, compiled programs, optional libraries."""
