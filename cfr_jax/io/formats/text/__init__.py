"""Points as text: one on a line, with or without names for the columns."""
