"""Local refinement: a motion that is nearly right, made precise."""
