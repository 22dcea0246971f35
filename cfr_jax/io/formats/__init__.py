"""One file per format, bytes in and points out."""
